//! Ranges of commands and weights of rewards change as the curriculum says: in each env by its own
//! episodes, or from a control step on; after a restore, on any share and on any thread as well.

use polypod::components::{Command, CurriculumProgress, EnvId};
use polypod::morphology::Morphologies;
use polypod::systems::{CompiledTask, Logs};
use polypod::{Sim, SimOptions};

use crate::common::{self, assert_all_same, env_bits, step};

const ENVS: usize = 24;

const LINES: &str = r#"
[curriculum.action_rate]
term = "modify_reward_weight"
term_name = "action_rate_l2"
weight = -0.5
num_steps = 10
[curriculum.late]
term = "modify_reward_weight"
term_name = "dof_vel"
weight = -0.25
num_steps = 20
[curriculum.command_curriculum]
reward_terms = ["is_alive"]
threshold = 0.3
step = 0.25
lin_vel_x = [-3.0, 1.5]
[curriculum.commands_vel]
velocity_stages = [{ step = 15, lin_vel_y = [-2.0, 2.0] }, { step = 30, ang_vel_z = [0.0, 0.5] }]

[rewards.unitree]
is_alive = { weight = 1.0 }
dof_vel = { term = "joint_vel_l2", weight = 0.0 }
"#;

fn options(name: &str) -> SimOptions {
    let overrides = ["sim.episode_length_s=0.2", "commands.base_velocity.rel_standing_envs=0.0"].map(String::from);
    SimOptions {
        robots: Some(vec!["unitree_go1".into(), "unitree_a1".into()]),
        overrides: overrides.into(),
        seed: 5,
        threads: Some(1),
        ..SimOptions::new(common::extended_task(name, "velocity_flat", LINES), ENVS)
    }
}

fn progress(sim: &mut Sim) -> Vec<CurriculumProgress> {
    let world = sim.world_mut();
    let mut all: Vec<_> = world.query::<(&EnvId, &CurriculumProgress)>().iter(world).collect();
    all.sort_by_key(|(env, _)| **env);
    all.into_iter().map(|(_, progress)| *progress).collect()
}

fn curves(sim: &mut Sim) -> std::collections::BTreeMap<String, f64> {
    sim.world_mut().resource_scope(|world, mut logs: bevy_ecs::prelude::Mut<Logs>| {
        logs.take(world.resource::<CompiledTask>(), world.resource::<Morphologies>())
    })
}

#[test]
fn weights_change_at_their_step() {
    let mut sim = Sim::new(&options("weights")).unwrap();
    let weight = |sim: &Sim, name: &str, step: u64| {
        sim.task().rewards[0].iter().find(|term| term.name == name).unwrap().weight_at(step)
    };
    let of = |step| (weight(&sim, "action_rate_l2", step), weight(&sim, "dof_vel", step));
    assert_eq!([9, 10, 19, 20].map(of), [(-0.01, 0.0), (-0.5, 0.0), (-0.5, 0.0), (-0.5, -0.25)]);
    // an episode of ten steps: the first ends at step 10, of which the last step has the new weight
    (0..10).for_each(|t| step(&mut sim, t));
    let first = curves(&mut sim);
    (10..20).for_each(|t| step(&mut sim, t));
    let second = curves(&mut sim);
    assert_eq!(first["Curriculum/unitree_go1/action_rate"], f64::from(-0.5_f32));
    assert_eq!((first["Curriculum/unitree_go1/late"], second["Curriculum/unitree_go1/late"]), (0.0, -0.25));
    let reward = |curves: &std::collections::BTreeMap<String, f64>, name: &str| {
        curves[&format!("Episode_Reward/unitree_go1/{name}")]
    };
    assert!(reward(&second, "action_rate_l2") < 3.0 * reward(&first, "action_rate_l2"));
    assert_eq!(reward(&first, "dof_vel"), 0.0);
    assert!(reward(&second, "dof_vel") < 0.0);
}

#[test]
fn ranges_of_commands_change_at_their_step_and_widen_with_success() {
    let mut sim = Sim::new(&options("ranges")).unwrap();
    let mut widest = [[0.0_f32; 2]; 3];
    for t in 0..60 {
        step(&mut sim, t);
        let now = progress(&mut sim);
        assert!(now.iter().all(|progress| progress.steps == t as u64 + 1));
        let world = sim.world_mut();
        for (env, command) in world.query::<(&EnvId, &Command)>().iter(world) {
            let widening = now[env.0 as usize].widening;
            let [x, y, _] = command.velocity;
            assert!((-(1.0 + widening).min(3.0)..=(1.0 + widening).min(1.5)).contains(&x), "{x}, {widening}");
            let most = if t < 14 { 1.0 } else { 2.0 };
            assert!(y.abs() <= most, "{y} at step {t}");
            for (range, x) in widest.iter_mut().zip(command.velocity) {
                *range = [range[0].min(x), range[1].max(x)];
            }
        }
    }
    // is_alive pays all of an episode: the running mean passes 0.3 at the second one
    let now = progress(&mut sim);
    assert!(now.iter().all(|progress| progress.widening == 1.25), "{now:?}");
    assert!(now.iter().all(|progress| (progress.tracking - (1.0 - 0.8_f32.powi(6))).abs() < 1e-3), "{now:?}");
    assert!(widest[0][0] < -1.4 && widest[0][1] > 1.2 && widest[1][1] > 1.4, "{widest:?}");
    let curves = curves(&mut sim);
    // the mean over ended episodes, each with the widening that it had
    let mean = (0.25 + 0.5 + 0.75 + 1.0) / 6.0;
    assert!((curves["Curriculum/unitree_go1/lin_vel_x_max"] - (1.0 + mean)).abs() < 1e-5, "{curves:?}");
    assert!((curves["Curriculum/unitree_go1/lin_vel_x_min"] + (1.0 + mean)).abs() < 1e-5, "{curves:?}");
    assert_eq!(curves["Curriculum/unitree_go1/lin_vel_y_min"], -2.0);
    assert_eq!(curves["Curriculum/unitree_a1/ang_vel_z_max"], 0.5);
    // a seed begins again
    sim.reset(Some(5), None).unwrap();
    assert!(progress(&mut sim).iter().all(|progress| *progress == CurriculumProgress::default()));
}

#[test]
fn a_restored_curriculum_goes_on_exactly() {
    let mut sim = Sim::new(&options("restored")).unwrap();
    (0..27).for_each(|t| step(&mut sim, t));
    let snapshot = sim.snapshot().unwrap();
    let mut other = Sim::new(&SimOptions { seed: 9, threads: Some(2), ..options("restored") }).unwrap();
    other.restore(&snapshot).unwrap();
    (27..50).for_each(|t| {
        step(&mut sim, t);
        step(&mut other, t);
    });
    assert_all_same(&mut sim, &mut other, "after a restore");
    assert_eq!(progress(&mut sim), progress(&mut other));
    assert!(sim.snapshot().unwrap() == other.snapshot().unwrap());
}

#[test]
fn shares_of_the_envs_have_the_curriculum_of_the_whole() {
    let whole = options("shares");
    let mut sim = Sim::new(&whole).unwrap();
    let mut share = Sim::new(&SimOptions { share: Some(8..ENVS), ..whole }).unwrap();
    let width = sim.batch().num_actions;
    for t in 0..35 {
        let actions: Vec<f32> = (0..ENVS * width).map(|i| common::noise(1, i / width, t, i % width)).collect();
        sim.step(&actions).unwrap();
        share.step(&actions[8 * width..]).unwrap();
    }
    assert_eq!(progress(&mut sim)[8..], progress(&mut share));
    assert!(env_bits(&mut sim)[8..] == env_bits(&mut share));
}

#[test]
fn what_cannot_be_scheduled_is_refused_by_name() {
    for (lines, said) in [
        (
            "[curriculum.modify_reward_weight]\nterm_name = \"action_rat_l2\"\nweight = 1.0\nnum_steps = 3",
            "action_rate_l2",
        ),
        (
            "[curriculum.command_curriculum]\nreward_terms = [\"is_alive\"]",
            "curriculum.command_curriculum.reward_terms",
        ),
        (
            "[curriculum.command_curriculum]\nreward_terms = [\"track_lin_vel_xy_exp\", \"base_linear_velocity\"]\nlin_vel_x = [-0.5, 2.0]",
            "does not hold the command's range [-1, 1]",
        ),
        (
            "[curriculum.commands_vel]\nvelocity_stages = [{ step = 5 }, { step = 5 }]",
            "curriculum.commands_vel.velocity_stages[1].step",
        ),
        ("[curriculum.mine]\nterm = \"commands_vels\"", "did you mean `commands_vel`"),
    ] {
        let error = match Sim::new(&SimOptions::new(common::extended_task("refused", "velocity_flat", lines), 8)) {
            Err(error) => error.to_string(),
            Ok(_) => panic!("{lines} is taken"),
        };
        assert!(error.contains(said), "{error}");
    }
    let lines = "[curriculum.commands_vel]\nvelocity_stages = []";
    let task = common::extended_task("refused_too", "getup_flat", lines);
    let error = Sim::new(&SimOptions::new(task, 8)).err().unwrap().to_string();
    assert!(error.contains("curriculum.commands_vel") && error.contains("`base_velocity`"), "{error}");
}
