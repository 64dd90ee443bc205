//! The grid that the articulated engine stands on is what Avian's rays see, and robots stand on
//! what it holds.

use avian3d::prelude::{SpatialQuery, SpatialQueryFilter};
use bevy_ecs::system::SystemState;
use polypod::components::{BasePose, BaseVelocity, Body, ContactForces, EnvId, EnvRng, Feet};
use polypod::dynamics::HeightGrid;
use polypod::world::{Ground, below};
use polypod::{Control, Sim, SimOptions, Simulation, SimulationOptions};

use crate::common::{self, upward_force};

/// One env per robot, at rest in the default pose, nothing random.
fn calm(task: &str) -> Sim {
    let overrides = [
        "events.reset_base.x=[0.0, 0.0]",
        "events.reset_base.y=[0.0, 0.0]",
        "events.reset_base.yaw=[0.0, 0.0]",
        "events.reset_joints.enabled=false",
        "events.physics_material.enabled=false",
        "events.add_base_mass.enabled=false",
        "events.base_com.enabled=false",
        "events.push_robot.enabled=false",
    ];
    let options = SimOptions { overrides: overrides.map(String::from).to_vec(), ..SimOptions::new(task, 8) };
    let mut sim = Sim::new(&options).unwrap();
    for mut velocity in sim.world_mut().query::<&mut BaseVelocity>().iter_mut(sim.world_mut()) {
        *velocity = BaseVelocity::default();
    }
    sim
}

fn terrain(sim: &Sim) -> HeightGrid {
    HeightGrid::clone(sim.world().resource::<Ground>().terrain.as_ref().unwrap())
}

#[test]
fn the_grid_is_what_rays_see() {
    let mut sim = calm("velocity_obstacles");
    let grid = terrain(&sim);
    let mut rng = EnvRng::new(3, 0);
    let end = [0, 1].map(|axis| grid.origin[axis] + grid.cell * (grid.size[axis] - 1) as f32);
    let mut rays: SystemState<SpatialQuery> = SystemState::new(sim.world_mut());
    let query = rays.get(sim.world()).unwrap();
    let height = |x: f32, y: f32| below(&query, [x, y], &SpatialQueryFilter::default()).unwrap().1;
    let (mut compared, mut raised, mut worst) = (0, 0, 0.0f32);
    for _ in 0..5_000 {
        let (x, y) = (rng.uniform([grid.origin[0], end[0]]), rng.uniform([grid.origin[1], end[1]]));
        let seen = height(x, y);
        // a slope steeper than 45 degrees within a cell and a half is a wall
        let pitch = 0.25 * grid.cell;
        if common::near_a_step(&height, [x, y], pitch, pitch) {
            continue;
        }
        compared += 1;
        raised += usize::from(seen > 0.01);
        worst = worst.max((grid.sample(x, y).0 - seen).abs());
    }
    println!("{compared} of 5000 places away from walls, {raised} of them raised: worst {:.3} mm", 1e3 * worst);
    assert!(compared > 4_000 && raised > 700);
    assert!(worst < 1e-3, "grid and rays differ by {worst} m");
}

/// Where robots are put down and how they are turned: `x` of the env, height of what stands there,
/// and its pitch.
struct Place {
    x: f32,
    height: f32,
    half_pitch: f32,
}

impl Place {
    fn new(sim: &Sim, x: f32) -> Self {
        let (height, [slope, _]) = terrain(sim).sample(x, 0.0);
        Self { x, height, half_pitch: -0.5 * slope.atan() }
    }

    /// `height` of the base above the surface, upright.
    fn pose(&self, height: f32) -> BasePose {
        let up = 2.0 * self.half_pitch;
        BasePose {
            position: [self.x + height * up.sin(), 0.0, self.height + height * up.cos()],
            rotation: [self.half_pitch.cos(), 0.0, self.half_pitch.sin(), 0.0],
        }
    }
}

/// Robots put down at a place hold their default pose for some control steps. Per robot: pose of
/// the base, height of the lowest foot, and contact forces as a share of the weight.
fn stand(task: &str, place: &Place, steps: usize) -> Vec<(BasePose, f32, f64)> {
    let mut sim = calm(task);
    for mut pose in sim.world_mut().query::<&mut BasePose>().iter_mut(sim.world_mut()) {
        *pose = place.pose(pose.position[2]);
    }
    let actions = vec![0.0; sim.batch().actions.len()];
    for _ in 0..steps {
        sim.step(&actions).unwrap();
        let fallen: Vec<usize> = (0..8).filter(|&env| sim.batch().terminated[env]).collect();
        assert!(fallen.is_empty(), "robots {fallen:?} fell at {} m of {task}", place.x);
    }
    let world = sim.world_mut();
    let mut robots: Vec<_> = world
        .query::<(&EnvId, &BasePose, &ContactForces, &Body, &Feet)>()
        .iter(world)
        .map(|(env, pose, forces, body, feet)| {
            let up = upward_force(forces);
            let lowest = feet.position.iter().map(|p| p[2]).fold(f32::MAX, f32::min);
            (env.0, (*pose, lowest, up / f64::from(body.0.total_mass()) / 9.81))
        })
        .collect();
    robots.sort_by_key(|(env, _)| *env);
    robots.into_iter().map(|(_, robot)| robot).collect()
}

#[test]
fn robots_stand_on_a_box_as_on_the_ground() {
    let sim = calm("velocity_obstacles");
    let flat = stand("velocity_flat_universal", &Place { x: 0.0, height: 0.0, half_pitch: 0.0 }, 200);
    let boxed = stand("velocity_obstacles", &Place::new(&sim, 3.75), 200);
    for ((robot, (low, low_foot, _)), (high, high_foot, weight)) in sim.morphologies().iter().zip(flat).zip(boxed) {
        let (name, rise) = (robot.name(), high.position[2] - low.position[2]);
        println!("{name}: base {rise:.5} m higher on the box, {weight:.4} of the weight");
        assert!((rise - 0.2).abs() < 1e-3, "{name} does not stand as on the ground");
        assert!((high_foot - low_foot - 0.2).abs() < 1e-3, "{name}'s feet are not on the box");
        assert!((weight - 1.0).abs() < 0.02, "{name} weighs {weight} times its weight");
    }
}

#[test]
fn a_ramp_is_a_plane_of_its_slope() {
    const STEPS: usize = 25;
    let sim = calm("velocity_obstacles");
    let place = Place::new(&sim, 2.25);
    let ramp = stand("velocity_obstacles", &place, STEPS);
    let pitch = 2.0 * f64::from(place.half_pitch);
    for (robot, (there, _, _)) in sim.morphologies().iter().zip(ramp) {
        let name = robot.name();
        let options = SimulationOptions {
            ground: Some([pitch.sin(), 0.0, pitch.cos()]),
            friction: [0.8, 0.6],
            threads: Some(1),
            ..SimulationOptions::new(name.to_string(), 1)
        };
        let mut plane = Simulation::new(&options).unwrap();
        let mut qpos = plane.default_qpos().to_vec();
        let start = place.pose(robot.stance.spawn_height);
        let offset = [place.x, 0.0, place.height].map(f64::from);
        for i in 0..3 {
            qpos[i] = f64::from(start.position[i]) - offset[i];
        }
        qpos[3..7].copy_from_slice(&start.rotation.map(f64::from));
        plane.set_state(None, Some(&qpos), None).unwrap();
        let targets = qpos[7..].to_vec();
        plane.step(&Control { targets: Some(&targets), ..Control::default() }, 4 * STEPS).unwrap();
        let here = plane.qpos();
        let apart = (0..3).map(|i| (f64::from(there.position[i]) - offset[i] - here[i]).powi(2)).sum::<f64>().sqrt();
        let moved = (0..3).map(|i| (qpos[i] - here[i]).powi(2)).sum::<f64>().sqrt();
        println!("{name}: {:.3} mm from where it is on the plane, {:.1} mm from the start", 1e3 * apart, 1e3 * moved);
        assert!(apart < 1e-3, "{name} is {apart} m from where it is on a plane of the ramp's slope");
    }
}
