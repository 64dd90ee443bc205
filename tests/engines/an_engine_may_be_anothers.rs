//! A plugin brings its own engine, which a task names: blocks of robots in, blocks of robots out.

use bevy_app::{App, Plugin};
use polypod::blocks::BlockList;
use polypod::components::{BasePose, BaseVelocity, EnvId, JointState, JointTargets};
use polypod::dynamics::Parameters;
use polypod::engine::{DivergenceRecord, Engine, EngineFactory, EngineSetup, RobotSlices, Run};
use polypod::systems::{PolypodPlugins, add_engine};
use polypod::workers::Workers;
use polypod::{Error, Sim, SimOptions};

use crate::common::{assert_all_same, step};

/// Bases go on with their velocity, less a drag by their mass that grows with the steps made;
/// joints are at their targets at once.
struct Kinematic {
    dt: f32,
    masses: Vec<f32>,
    steps: Vec<u32>,
}

impl Engine for Kinematic {
    fn upload(&mut self, env: usize, parameters: &Parameters<f32>) {
        self.masses[env] = parameters.total_mass();
    }

    fn step(&mut self, workers: &Workers, robots: BlockList<RobotSlices<'_>>, run: Run) -> Vec<DivergenceRecord> {
        let (dt, masses) = (self.dt, &self.masses);
        robots.zip_envs(&mut self.steps[..]).for_each_chunk(workers, |block| {
            let (robots, steps) = block.rows;
            for (i, env) in block.envs.enumerate() {
                let (pose, velocity) = (&mut robots.poses[i], &mut robots.velocities[i]);
                for _ in 0..run.steps {
                    steps[i] += 1;
                    for axis in 0..2 {
                        velocity.linear[axis] -= dt * velocity.linear[axis] * steps[i] as f32 / masses[env];
                        pose.position[axis] += dt * velocity.linear[axis];
                    }
                }
                robots.joints[i].position.copy_from_slice(&robots.targets[i].history[0]);
                robots.joints[i].velocity.fill(0.0);
            }
        });
        Vec::new()
    }

    fn save(&self) -> Result<Vec<Vec<u8>>, String> {
        Ok(self.steps.iter().map(|steps| steps.to_le_bytes().to_vec()).collect())
    }

    fn check(&self, envs: &[Vec<u8>]) -> Result<(), String> {
        let fits = envs.len() == self.steps.len() && envs.iter().all(|bytes| bytes.len() == 4);
        if fits { Ok(()) } else { Err("other counts".into()) }
    }

    fn load(&mut self, envs: &[Vec<u8>]) -> Result<(), String> {
        self.check(envs)?;
        self.steps = envs.iter().map(|bytes| u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]])).collect();
        Ok(())
    }
}

struct KinematicFactory;

impl EngineFactory for KinematicFactory {
    fn make(&self, setup: &EngineSetup) -> Result<Box<dyn Engine>, Error> {
        let envs = setup.blocks.num_envs();
        Ok(Box::new(Kinematic { dt: setup.task.sim.dt as f32, masses: vec![0.0; envs], steps: vec![0; envs] }))
    }
}

struct KinematicPlugin;

impl Plugin for KinematicPlugin {
    fn build(&self, app: &mut App) {
        add_engine(app, "kinematic", KinematicFactory);
    }
}

fn options(engine: &str, task: &str, threads: usize) -> SimOptions {
    SimOptions {
        robots: Some(vec!["unitree_go2".into(), "anymal_d".into(), "spot".into()]),
        threads: Some(threads),
        seed: 5,
        overrides: vec![format!("physics.engine={engine}"), "terminations={}".into()],
        ..SimOptions::new(task, 130)
    }
}

fn kinematic(task: &str, threads: usize) -> Result<Sim, Error> {
    let mut app = App::empty();
    app.insert_resource(options("kinematic", task, threads)).add_plugins((PolypodPlugins, KinematicPlugin));
    Sim::from_app(app)
}

#[test]
fn a_task_runs_on_it() {
    let mut sim = kinematic("velocity_flat", 1).unwrap();
    let bases = |sim: &mut Sim| {
        let world = sim.world_mut();
        let mut bases = vec![([0.0; 3], [0.0; 3]); 130];
        for (env, pose, velocity) in world.query::<(&EnvId, &BasePose, &BaseVelocity)>().iter(world) {
            bases[env.0 as usize] = (pose.position, velocity.linear);
        }
        bases
    };
    let before = bases(&mut sim);
    step(&mut sim, 0);
    let after = bases(&mut sim);
    for ((position, velocity), (new_position, new_velocity)) in before.iter().zip(&after) {
        for axis in 0..2 {
            // a push may have come in between, and the drag is small
            let way = new_position[axis] - position[axis];
            assert!((way - 0.02 * new_velocity[axis]).abs() < 2e-3, "{way} m at {} m/s", velocity[axis]);
        }
        assert_eq!(position[2], new_position[2]);
    }
    let world = sim.world_mut();
    let mut moved = 0;
    for (joints, targets) in world.query::<(&JointState, &JointTargets)>().iter(world) {
        assert_eq!(joints.position, targets.history[0]);
        moved += 1;
    }
    assert_eq!(moved, 130);
}

#[test]
fn it_keeps_the_promises() {
    let (mut one, mut three) = (kinematic("velocity_flat", 1).unwrap(), kinematic("velocity_flat", 3).unwrap());
    for t in 0..20 {
        step(&mut one, t);
        step(&mut three, t);
    }
    assert_all_same(&mut one, &mut three, "of three threads");
    let snapshot = one.snapshot().unwrap();
    let mut again = kinematic("velocity_flat", 1).unwrap();
    again.restore(&snapshot).unwrap();
    for t in 20..40 {
        step(&mut one, t);
        step(&mut again, t);
    }
    assert!(one.snapshot().unwrap() == again.snapshot().unwrap(), "after a restore");
    // bytes of another engine change nothing
    let mut other = Sim::new(&options("articulated", "velocity_flat", 1)).unwrap();
    assert!(other.restore(&snapshot).is_err());
}

#[test]
fn what_it_cannot_do_and_names_of_none_are_refused() {
    let error = kinematic("velocity_flat_variation", 1).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("events.body_variation") && error.contains("the engine kinematic"), "{error}");
    let turning = |engine: &str| {
        let mut options = options(engine, "velocity_flat", 1);
        options.overrides.push("scene.ground.torsional_friction=0.01".into());
        Sim::new(&options).map(|_| ()).map_err(|error| error.to_string())
    };
    turning("articulated").unwrap();
    let error = turning("avian").unwrap_err();
    assert!(error.contains("physics.engine: the engine avian has no torsional"), "{error}");
    let error = turning("articulatd").unwrap_err();
    assert!(error.contains("physics.engine: there is no engine `articulatd`"), "{error}");
    assert!(error.contains("did you mean `articulated`?"), "{error}");
    let error = turning("kinematic").unwrap_err();
    assert!(error.contains("known engines: articulated, auto, avian"), "{error}");
}
