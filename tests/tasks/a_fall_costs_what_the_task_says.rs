//! `is_terminated` is 1 in the step in which an episode fails and 0 in all others, at a time-out
//! too.

use polypod::Sim;

use crate::common::{busy, step};

const STEPS: usize = 150;

/// Two robots of different reward sets on the universal rough task, whose episodes are shorter than
/// the test.
fn sim(weight: f64) -> Sim {
    let mut options = busy(&["anymal_d", "unitree_go1"], 48);
    options.task = "velocity_rough_universal".into();
    let sets = ["anymal", "unitree"].map(|set| format!("rewards.{set}.is_terminated.weight={weight:?}"));
    options.overrides.extend(sets);
    options.overrides.push("sim.episode_length_s=1.0".into());
    options.overrides.push("events.push_robot.velocity_range=[-8.0, 8.0]".into()); // over they go
    Sim::new(&options).unwrap()
}

#[test]
fn only_in_the_step_of_the_fall() {
    let (mut free, mut priced) = (sim(0.0), sim(-200.0));
    let (mut falls, mut time_outs) = (0, 0);
    for t in 0..STEPS {
        step(&mut free, t);
        step(&mut priced, t);
        let (free, priced) = (free.batch(), priced.batch());
        assert_eq!(free.terminated, priced.terminated);
        for env in 0..free.rewards.len() {
            let cost = f64::from(free.rewards[env]) - f64::from(priced.rewards[env]);
            let expected = if free.terminated[env] { 200.0 * 0.02 } else { 0.0 };
            assert!((cost - expected).abs() < 1e-5, "step {t}, env {env}: {cost}, not {expected}");
            falls += usize::from(free.terminated[env]);
            time_outs += usize::from(free.truncated[env]);
        }
    }
    assert!(falls > 10 && time_outs > 10, "{falls} falls and {time_outs} time-outs");
}
