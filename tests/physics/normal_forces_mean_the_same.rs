//! The normal force on a foot is the part of the contact force along the ground's normal, on both
//! engines: on a slope it is no vertical force.

use bevy_ecs::prelude::*;
use polypod::components::{BasePose, ContactForces, EnvOrigin, Feet, Robot};
use polypod::world::Ground;
use polypod::{Sim, SimOptions};

/// Rise over run.
const SLOPE: f64 = 0.18;
/// Distance for slopes of the ground, m.
const STEP: f32 = 0.01;

/// Sums over half a second of the feet's normal forces, of the parts of their contact forces along
/// the ground's normal, and of their vertical forces, of a robot that stands on a slope.
fn forces(engine: &str) -> [f64; 3] {
    let kind = format!(
        "{{name = \"slope\", type = \"hf_pyramid_slope\", proportion = 1.0, slope_range = [{SLOPE}, {SLOPE}], \
         platform_width = 1.0, border_width = 0.25}}"
    );
    let overrides = [
        "scene.terrain.num_rows=1".to_string(),
        "scene.terrain.num_cols=1".into(),
        "scene.terrain.max_init_terrain_level=0".into(),
        "scene.terrain.difficulty_range=[1.0, 1.0]".into(),
        format!("scene.terrain.sub_terrains=[{kind}]"),
        format!("physics.engine={engine}"),
        "robot_material.static_friction=2.0".into(),
        "robot_material.dynamic_friction=2.0".into(),
        "observations.enable_noise=false".into(),
    ];
    let off =
        ["push_robot", "add_base_mass", "base_com", "physics_material", "base_external_force_torque", "reset_joints"];
    let options = SimOptions {
        robots: Some(vec!["anymal_d".into()]),
        threads: Some(1),
        overrides: overrides.into_iter().chain(off.map(|event| format!("events.{event}.enabled=false"))).collect(),
        ..SimOptions::new("velocity_rough", 1)
    };
    let mut sim = Sim::new(&options).unwrap();
    let ground = sim.world().resource::<Ground>().clone();
    let world = sim.world_mut();
    let origin = *world.query::<&EnvOrigin>().single(world).unwrap();
    let mut pose = world.query_filtered::<&mut BasePose, With<Robot>>().single_mut(world).unwrap();
    // on the side that falls towards +x, along the slope's own direction
    let (x, y) = (2.0, 0.0);
    let mut height = [0.0];
    ground.heights_at(&origin, std::iter::once([x, y]), &mut height);
    let mut level = [0.0];
    ground.heights_at(&origin, std::iter::once([0.0, 0.0]), &mut level);
    let half = 0.5 * SLOPE.atan();
    pose.position = [x, y, pose.position[2] + height[0] - level[0] + 0.02];
    pose.rotation = [half.cos() as f32, 0.0, half.sin() as f32, 0.0];
    let actions = vec![0.0; sim.batch().actions.len()];
    let mut sums = [0.0; 3];
    for step in 0..75 {
        sim.step(&actions).unwrap();
        let world = sim.world_mut();
        let (forces, feet) = world.query::<(&ContactForces, &Feet)>().single(world).unwrap();
        if step < 50 {
            continue;
        }
        for foot in 0..feet.position.len() {
            let [x, y, _] = feet.position[foot];
            let around = [[x + STEP, y], [x - STEP, y], [x, y + STEP], [x, y - STEP]];
            let mut heights = [0.0; 4];
            ground.heights_at(&origin, around.into_iter(), &mut heights);
            let slope = |ahead: f32, behind: f32| f64::from((ahead - behind) / (2.0 * STEP));
            let up = [-slope(heights[0], heights[1]), -slope(heights[2], heights[3]), 1.0];
            let length = up.iter().map(|x| x * x).sum::<f64>().sqrt();
            let force = forces.feet[foot].map(f64::from);
            let along: f64 = up.iter().zip(force).map(|(n, f)| n * f / length).sum();
            let normal = f64::from(forces.feet_normal[forces.feet_normal.len() - forces.feet.len() + foot]);
            for (sum, x) in sums.iter_mut().zip([normal, along, force[2]]) {
                *sum += x;
            }
        }
    }
    sums
}

#[test]
fn on_a_slope_they_are_no_vertical_forces() {
    for engine in ["articulated", "avian"] {
        let [normal, along, vertical] = forces(engine);
        println!("{engine}: normal {normal:.1}, along the normal {along:.1}, vertical {vertical:.1}");
        assert!((normal / along - 1.0).abs() < 0.01, "{engine}: {normal} N s, and {along} along the normal");
        assert!((normal / vertical - 1.0).abs() > 0.02, "{engine}: the slope is too gentle to tell");
    }
}
