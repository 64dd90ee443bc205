//! Throws a ball at a robot, in Avian's world: `cargo run --release --example thrown_ball`.

use avian3d::prelude::{Collider, LinearVelocity, Mass, Position, Restitution, RigidBody};
use bevy_math::Vec3;
use polypod::components::EnvId;
use polypod::mirrors::LinkMirrors;
use polypod::{Error, Sim, SimOptions};

fn main() -> Result<(), Error> {
    let mut options = SimOptions::new("velocity_flat_play", 16);
    options.robots = Some(vec!["anymal_d".into()]);
    options.overrides.push("physics.mirror_links=true".into());
    let mut sim = Sim::new(&options)?;
    let env = EnvId(3);
    let origin = sim.world().resource::<LinkMirrors>().origin(env).unwrap_or_default();
    let (at, velocity) = (origin + Vec3::new(0.0, 2.0, 0.6), Vec3::new(0.0, -4.0, 1.0));
    let shape = (RigidBody::Dynamic, Collider::sphere(0.1), Mass(0.5), Restitution::new(0.8));
    let ball = sim.world_mut().spawn((env, shape, Position(at), LinearVelocity(velocity))).id();
    let actions = vec![0.0; sim.batch().actions.len()];
    for step in 1..=50 {
        sim.step(&actions)?;
        if step % 10 == 0
            && let Some(at) = sim.world().get::<Position>(ball)
        {
            println!("{:.1} s: {:.2} m from the env's origin", 0.02 * f64::from(step), at.0 - origin);
        }
    }
    Ok(())
}
