//! After a reset the robot is above the ground, and all that follows from its state is that of the
//! new state.

use polypod::components::{BasePose, BaseVelocity, Body, EnvId, EnvOrigin, Feet, JointState, Morphology};
use polypod::config::JointPositionMode;
use polypod::dynamics::math::{Spatial, add, mul_vec, mul_vec_transposed, quat_to_mat};
use polypod::dynamics::{ContactSettings, Parameters, Plane, Scalar, State, Workspace, point_motion};
use polypod::morphology::{Morphologies, MorphologyModel};
use polypod::systems::StateField;
use polypod::world::Ground;
use polypod::{Autoreset, Sim, SimOptions};

use crate::common;

/// Joint positions over wide ranges, joints and base at random velocities.
fn shake(sim: &mut Sim) {
    for robot in &mut sim.world_mut().resource_mut::<Morphologies>().0 {
        let reset = &mut robot.config.reset;
        match reset.joint_position.mode {
            JointPositionMode::Scale => reset.joint_position.range = [0.5, 1.5],
            JointPositionMode::Offset => reset.joint_position.range = [-0.5, 0.5],
        }
        reset.joint_velocity.range = [-2.0, 2.0];
        reset.base_velocity.range = [-1.0, 1.0];
    }
}

/// The state of every robot in double precision, with its numbers and what the simulation says of
/// its feet.
fn robots(sim: &mut Sim) -> Vec<(usize, Parameters<f64>, State<f64>, Feet, EnvOrigin)> {
    let models: Vec<MorphologyModel> = sim.morphologies().to_vec();
    let world = sim.world_mut();
    let mut origins: Vec<_> = world.query::<(&EnvId, &EnvOrigin)>().iter(world).map(|(env, o)| (*env, *o)).collect();
    origins.sort_by_key(|(env, _)| *env);
    let mut query = world.query::<(&EnvId, &Morphology, &Body, &BasePose, &BaseVelocity, &JointState, &Feet)>();
    let mut all: Vec<_> = query
        .iter(world)
        .map(|(env, tag, body, pose, velocity, joints, feet)| {
            let model = &models[usize::from(tag.0)];
            let mut state = State::<f64>::zeros(&model.topology);
            let wide = |x: &[f32]| x.iter().map(|&x| f64::from(x)).collect::<Vec<f64>>();
            state.position = pose.position.map(f64::from);
            state.rotation = pose.rotation.map(f64::from);
            state.linear_velocity = velocity.linear.map(f64::from);
            state.angular_velocity = velocity.angular.map(f64::from);
            state.joint_position = wide(&joints.position);
            state.joint_velocity = wide(&joints.velocity);
            let parameters = Parameters::from_scalars(&model.topology, &body.0);
            (*env, (usize::from(tag.0), parameters, state, feet.clone(), origins[env.0 as usize].1))
        })
        .collect();
    all.sort_by_key(|(env, _)| *env);
    all.into_iter().map(|(_, robot)| robot).collect()
}

/// Largest distance of the feet from where forward kinematics has them, m, and difference of their
/// velocities, m/s.
fn foot_errors(sim: &mut Sim) -> (f64, f64) {
    let models: Vec<MorphologyModel> = sim.morphologies().to_vec();
    let (mut place, mut speed) = (0.0f64, 0.0f64);
    for (kind, parameters, state, feet, _) in robots(sim) {
        let topology = &models[kind].topology;
        let rotation = quat_to_mat(&state.rotation);
        let base = Spatial { ang: state.angular_velocity, lin: mul_vec_transposed(&rotation, &state.linear_velocity) };
        let mut work = Workspace::new(topology);
        let (q, v) = (&state.joint_position, &state.joint_velocity);
        f64::forward_kinematics(topology, &parameters, q, v, &base, &mut work);
        for (s, &link) in topology.sites.iter().enumerate() {
            let (at, motion) = point_motion(&work.links[link], &parameters.site_position[s]);
            let (at, motion) = (add(&state.position, &mul_vec(&rotation, &at)), mul_vec(&rotation, &motion));
            for k in 0..3 {
                place = place.max((at[k] - f64::from(feet.position[s][k])).abs());
                speed = speed.max((motion[k] - f64::from(feet.velocity[s][k])).abs());
            }
        }
    }
    (place, speed)
}

/// Least distance of any contact candidate of each robot from the plane, m.
fn least_gaps(sim: &mut Sim) -> Vec<(usize, f64)> {
    let models: Vec<MorphologyModel> = sim.morphologies().to_vec();
    let settings = ContactSettings { ground: Some(Plane::level(0.0)), ..ContactSettings::default() };
    robots(sim)
        .into_iter()
        .map(|(kind, parameters, state, ..)| {
            let topology = &models[kind].topology;
            let mut work = Workspace::new(topology);
            let gaps = f64::candidate_gaps(topology, &parameters, &settings, &state, &mut work);
            (kind, gaps.into_iter().fold(f64::INFINITY, f64::min))
        })
        .collect()
}

#[test]
fn feet_are_where_the_new_state_has_them() {
    let mut sim = Sim::new(&SimOptions::new("velocity_flat_legged", common::size(48, 480))).unwrap();
    assert!(foot_errors(&mut sim).0 < 1e-5, "the first reset");
    shake(&mut sim);
    sim.reset(None, None).unwrap();
    let (place, speed) = foot_errors(&mut sim);
    println!("worst {place:.1e} m, {speed:.1e} m/s");
    assert!(place < 1e-5 && speed < 1e-4);
    let moving =
        robots(&mut sim).iter().all(|(_, _, _, feet, _)| feet.velocity.iter().flatten().any(|v| v.abs() > 0.01));
    assert!(moving, "feet of robots that move do so");
}

#[test]
fn every_way_of_resetting_places_the_feet() {
    for autoreset in [Autoreset::SameStep, Autoreset::NextStep, Autoreset::Disabled] {
        for engine in ["articulated", "avian"] {
            let overrides = vec!["sim.episode_length_s=0.06".into(), format!("physics.engine={engine}")];
            let options = SimOptions { autoreset, overrides, ..SimOptions::new("velocity_flat", 8) };
            let mut sim = Sim::new(&options).unwrap();
            shake(&mut sim);
            let actions = vec![0.0; sim.batch().actions.len()];
            let mut resets = 0;
            for _ in 0..6 {
                sim.step(&actions).unwrap();
                if autoreset == Autoreset::Disabled {
                    let mask: Vec<bool> = (0..8).map(|env| env % 2 == 0 && sim.batch().truncated[env]).collect();
                    sim.reset(None, Some(&mask)).unwrap();
                }
                let (place, speed) = foot_errors(&mut sim);
                assert!(place < 1e-4 && speed < 1e-2, "{autoreset:?}, {engine}: {place} m, {speed} m/s");
                let world = sim.world_mut();
                resets +=
                    world.query::<&polypod::components::Episode>().iter(world).filter(|episode| episode.fresh).count();
            }
            assert!(resets >= 4, "{autoreset:?}: {resets}");
        }
    }
}

#[test]
fn no_shape_begins_nearer_to_the_ground_than_the_margin() {
    let mut sim = Sim::new(&SimOptions::new("velocity_flat_legged", common::size(240, 2400))).unwrap();
    for wide in [false, true] {
        if wide {
            shake(&mut sim);
        }
        let mut lowest = vec![f64::INFINITY; sim.morphologies().len()];
        for _ in 0..4 {
            sim.reset(None, None).unwrap();
            least_gaps(&mut sim).into_iter().for_each(|(kind, gap)| lowest[kind] = lowest[kind].min(gap));
        }
        for (model, gap) in sim.morphologies().iter().zip(lowest) {
            let margin = model.config.reset.spawn_margin;
            assert!(gap > margin - 2e-4, "{}: {gap} m, not {margin}; wide: {wide}", model.name());
        }
    }
}

#[test]
fn default_poses_are_lifted_only_where_another_shape_is_lower_than_the_feet() {
    let fixed = ["events.reset_joints.enabled=false".into()];
    let options = SimOptions { overrides: fixed.to_vec(), ..SimOptions::new("velocity_flat_legged", 24) };
    let mut sim = Sim::new(&options).unwrap();
    let models: Vec<MorphologyModel> = sim.morphologies().to_vec();
    let gaps = least_gaps(&mut sim);
    let mut kept = 0;
    for ((kind, _, state, ..), (_, gap)) in robots(&mut sim).into_iter().zip(gaps) {
        let (name, margin) = (models[kind].name(), models[kind].config.reset.spawn_margin);
        let lifted = state.position[2] - f64::from(models[kind].stance.spawn_height);
        kept += usize::from(lifted == 0.0);
        assert!(lifted == 0.0 || (gap - margin).abs() < 1e-5, "{name}: lifted by {lifted} m, {gap} m above the ground");
        assert!((0.0..0.01).contains(&lifted), "{name}: lifted by {lifted} m");
    }
    assert!(kept >= 15, "{kept} of 24 begin at the height of their stance");
}

#[test]
fn robots_begin_above_the_stairs_that_their_feet_reach() {
    // longer than the footprint that a robot is put above
    let overrides = [
        "events.body_variation={mode=\"startup\", size=[1.6, 1.6]}",
        "events.reset_base.x=[-3.0, 3.0]",
        "events.reset_base.y=[-3.0, 3.0]",
    ];
    let options = SimOptions {
        overrides: overrides.map(String::from).to_vec(),
        robots: Some(vec!["anymal_c".into(), "unitree_b2".into()]),
        ..SimOptions::new("velocity_rough", common::size(200, 2000))
    };
    let mut sim = Sim::new(&options).unwrap();
    shake(&mut sim);
    sim.reset(None, None).unwrap();
    assert!(foot_errors(&mut sim).0 < 1e-4);
    let ground = sim.world().resource::<Ground>().clone();
    let models: Vec<MorphologyModel> = sim.morphologies().to_vec();
    for (kind, _, _, feet, origin) in robots(&mut sim) {
        let radius = models[kind].roles.foot_radius[0] as f32 * 1.6;
        for (position, height) in feet.position.iter().zip(&feet.height) {
            let below = ground.height_at(&origin, [position[0], position[1]]);
            assert!((position[2] - below - height).abs() < 1e-6);
            assert!(*height > radius - 1e-3, "{}: a foot begins {} m deep", models[kind].name(), radius - height);
        }
    }
}

#[test]
fn heights_are_read_of_the_new_state() {
    let mut sim = Sim::new(&SimOptions::new("velocity_rough", 40)).unwrap();
    shake(&mut sim);
    sim.reset(None, None).unwrap();
    let columns = sim.state_width(StateField::FeetHeight);
    let (mut heights, mut places) = (vec![0.0; 40 * columns], vec![0.0; 40 * 3 * columns]);
    sim.state(StateField::FeetHeight, &mut heights).unwrap();
    sim.state(StateField::FeetPos, &mut places).unwrap();
    assert!(heights.iter().all(|height| *height > 0.01), "{heights:?}");
    assert!(places.chunks(3).all(|foot| foot[2].abs() < 3.0 && foot != [0.0; 3]));
}
