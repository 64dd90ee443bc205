//! A joint that is driven into its limit with all the actuator has stops there, in the air and
//! against the ground.

use polypod::{Control, Simulation, SimulationOptions};

use crate::common::{self, size};

const ENVS: usize = 16;

/// The furthest any joint gets past a limit, rad, and the share of joints that come to stand at
/// one.
///
/// Each env pushes each joint up or down with its effort limit, another combination in each.
fn furthest(robot: &str, fixed_base: bool, ground: bool) -> (f64, f64) {
    let mut options = SimulationOptions { fixed_base, ..SimulationOptions::new(robot.to_string(), ENVS) };
    if !ground {
        options.ground = None;
        options.gravity = [0.0; 3];
    }
    let mut sim = Simulation::new(&options).unwrap();
    let (joints, range, effort) = (sim.num_joints(), sim.joint_range(), sim.effort_limit());
    let torque: Vec<f64> = (0..ENVS * joints)
        .map(|i| {
            let (env, joint) = (i / joints, i % joints);
            effort[joint].min(1e3) * f64::from(common::noise(7, env, 0, joint)).signum()
        })
        .collect();
    let mut worst = 0.0f64;
    let steps = size(400, 4000);
    let mut held = 0;
    for step in 0..steps {
        sim.step(&Control { torque: Some(&torque), ..Control::default() }, 1).unwrap();
        for q in sim.qpos().chunks(sim.nq()) {
            for (x, [low, high]) in q[sim.nq() - joints..].iter().zip(&range) {
                worst = worst.max(low - x).max(x - high);
                held += usize::from(step == steps - 1 && (x - low).min(high - x) < 1e-2);
            }
        }
    }
    (worst, held as f64 / (ENVS * joints) as f64)
}

#[test]
fn limits_hold() {
    for robot in common::ROBOTS {
        for (fixed_base, ground, name) in
            [(true, false, "base fixed, in the air"), (false, false, "free in space"), (false, true, "on the ground")]
        {
            let (worst, held) = furthest(robot, fixed_base, ground);
            println!(
                "{robot}, {name}: {:.3} mrad past a limit; {:.0} % of the joints at one",
                1e3 * worst,
                100.0 * held
            );
            assert!(held > 0.02, "{robot}, {name}: hardly a joint reaches a limit");
            assert!(worst < 2e-3, "{robot}, {name}: a joint is {worst} rad past its limit");
        }
    }
}
