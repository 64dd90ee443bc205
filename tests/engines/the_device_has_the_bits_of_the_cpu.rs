//! The engine `cuda` has the bits of the engine on the CPU. The host stands for the card: it steps
//! the text of the device, compiled as C, behind the same engine.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use bevy_app::App;
use polypod::components::{BaseVelocity, Body, ConstraintImpulses, EnvId, LinkForce, LinkForces};
use polypod::engine::OnDevice;
use polypod::systems::{PolypodPlugins, add_engine};
use polypod::{Error, Sim, SimOptions};
use polypod_cuda::{Device, DeviceBlock, DeviceError, Exchange, Shape};
use polypod_cuda_host::Host;

use crate::common::driven::driven;
use crate::common::{ROBOTS, assert_all_same, busy, ended, size, sprung, step, turning};

/// A host that fails after some control steps of blocks. Every second block is back late: the first
/// question after a start is answered with no.
#[derive(Default)]
struct Failing {
    left: Arc<AtomicUsize>,
    blocks: AtomicUsize,
}

struct FailingBlock {
    block: Box<dyn DeviceBlock>,
    left: Arc<AtomicUsize>,
    is_late: bool,
    asked: bool,
}

impl Device for Failing {
    fn name(&self) -> &str {
        "failing"
    }

    fn allocate(&self, shape: Shape) -> Result<Box<dyn DeviceBlock>, DeviceError> {
        let is_late = self.blocks.fetch_add(1, Ordering::Relaxed) % 2 == 1;
        Ok(Box::new(FailingBlock {
            block: Host::default().allocate(shape)?,
            left: self.left.clone(),
            is_late,
            asked: false,
        }))
    }
}

impl DeviceBlock for FailingBlock {
    fn shape(&self) -> &Shape {
        self.block.shape()
    }

    fn exchange(&mut self) -> Exchange<'_> {
        self.block.exchange()
    }

    fn set_parameters(
        &mut self,
        common: &[f32],
        own: u32,
        tiles: &[f32],
        changed: &[usize],
    ) -> Result<(), DeviceError> {
        self.block.set_parameters(common, own, tiles, changed)
    }

    fn start(&mut self) -> Result<(), DeviceError> {
        self.asked = false;
        self.block.start()
    }

    fn contacts_if_done(&mut self) -> Result<Option<usize>, DeviceError> {
        if self.is_late && !std::mem::replace(&mut self.asked, true) {
            return Ok(None);
        }
        let lost = DeviceError::Call { call: "contacts_if_done", text: "lost".into() };
        let left = self.left.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |left| left.checked_sub(1));
        left.map_err(|_| lost)?;
        self.block.contacts_if_done()
    }
}

fn sim_with(mut options: SimOptions, name: &'static str, engine: OnDevice) -> Result<Sim, Error> {
    options.overrides.push(format!("physics.engine={name}"));
    let mut app = App::empty();
    app.insert_resource(options).add_plugins(PolypodPlugins);
    add_engine(&mut app, name, engine);
    Sim::from_app(app)
}

fn sim_on(
    options: SimOptions,
    open: impl Fn() -> Result<Arc<dyn Device>, DeviceError> + Send + Sync + 'static,
) -> Result<Sim, Error> {
    sim_with(options, "cuda", OnDevice::new(open))
}

fn on_host(options: SimOptions) -> Sim {
    sim_on(options, || Ok(Arc::new(Host::default()))).unwrap()
}

/// Both engines make the same steps, to the last bit of their snapshots, which hold the impulses of
/// all contacts too.
fn compare(options: SimOptions, steps: usize, least_ended: usize, what: &str) {
    let (mut cpu, mut host) = (Sim::new(&options).unwrap(), on_host(options));
    let mut all_ended = 0;
    for t in 0..steps {
        step(&mut cpu, t);
        step(&mut host, t);
        all_ended += ended(&cpu);
        assert_all_same(&mut cpu, &mut host, &format!("{what}, step {t}"));
    }
    assert!(all_ended >= least_ended, "{what}: {all_ended} episodes ended");
    assert!(cpu.snapshot().unwrap() == host.snapshot().unwrap(), "{what}: a component differs");
}

#[test]
fn in_a_flat_task_with_resets_pushes_and_randomisation() {
    let mut options = turning(busy(&ROBOTS, 70));
    options.threads = Some(2);
    compare(options, size(90, 400), 70, "flat");
}

#[test]
fn with_delays_springs_and_surfaces() {
    let mut options = sprung(busy(&["unitree_go2", "anymal_d"], 40));
    options.overrides.push("events.action_delay.delay_range=[0, 6]".into());
    compare(options, 60, 30, "springs");
}

#[test]
fn with_networks_that_drive_joints() {
    let mut options = driven(70);
    options.threads = Some(2);
    let more = ["events.action_delay.enabled=true", "events.action_delay.delay_range=[0, 6]"];
    options.overrides.extend(more.map(String::from));
    compare(options, size(150, 400), 70, "networks");
}

#[test]
fn on_rough_ground_and_with_other_bodies() {
    let options = |task: &str, envs: usize| SimOptions {
        seed: 3,
        threads: Some(1),
        overrides: vec!["sim.episode_length_s=0.6".into()],
        ..SimOptions::new(task, envs)
    };
    compare(options("velocity_rough", 48), 50, 40, "rough");
    compare(options("velocity_flat_legged", 96), 50, 40, "legged");
    compare(options("velocity_flat_variation", 40), 40, 30, "variation");
}

#[test]
fn of_robots_that_lie_on_the_ground_with_more_contacts_than_lists_have_room_for() {
    let options = SimOptions { threads: Some(1), seed: 4, ..SimOptions::new("getup_flat_humanoid", 24) };
    let (mut cpu, mut host) = (Sim::new(&options).unwrap(), on_host(options));
    let mut most = 0;
    for t in 0..80 {
        step(&mut cpu, t);
        step(&mut host, t);
        let world = cpu.world_mut();
        let mut impulses = world.query::<&ConstraintImpulses>();
        most = impulses.iter(world).map(|of| of.contacts.len()).max().unwrap_or(0).max(most);
    }
    // the first lists have room for four
    assert!(most > 4, "at most {most} contacts");
    assert!(cpu.snapshot().unwrap() == host.snapshot().unwrap());
}

#[test]
fn with_forces_on_links_and_parameters_that_a_caller_sets() {
    let options = busy(&["unitree_a1"], 34);
    let (mut cpu, mut host) = (Sim::new(&options).unwrap(), on_host(options));
    for t in 0..30 {
        for sim in [&mut cpu, &mut host] {
            if t % 7 == 3 {
                let world = sim.world_mut();
                let mut forces = world.query::<(&EnvId, &mut LinkForces)>();
                for (env, mut forces) in forces.iter_mut(world) {
                    if env.0 % 3 == 0 {
                        let link = 1 + (env.0 + t as u32) % 12;
                        forces.0 = vec![LinkForce {
                            link,
                            in_world: env.0 % 2 == 0,
                            point: [0.01, 0.0, -0.05],
                            force: [8.0, -3.0, 5.0],
                            torque: [0.1, 0.2, -0.3],
                            steps: 2,
                        }];
                    }
                }
            }
            if t == 10 {
                let world = sim.world_mut();
                let mut bodies = world.query::<(&EnvId, &mut Body)>();
                for (env, mut body) in bodies.iter_mut(world) {
                    body.0.mass[1] *= 1.0 + 0.01 * env.0 as f32;
                }
            }
            step(sim, t);
        }
        assert_all_same(&mut cpu, &mut host, &format!("step {t}"));
    }
    assert!(cpu.snapshot().unwrap() == host.snapshot().unwrap());
}

#[test]
fn a_snapshot_of_one_side_goes_on_on_the_other() {
    goes_on(busy(&["unitree_a1", "spot"], 36));
    // with what networks remember
    goes_on(driven(36));
}

fn goes_on(options: SimOptions) {
    let (mut cpu, mut host) = (Sim::new(&options).unwrap(), on_host(options.clone()));
    for t in 0..25 {
        step(&mut cpu, t);
        step(&mut host, t);
    }
    let (from_cpu, from_host) = (cpu.snapshot().unwrap(), host.snapshot().unwrap());
    let (mut new_cpu, mut new_host) = (Sim::new(&options).unwrap(), on_host(options));
    new_cpu.restore(&from_host).unwrap();
    new_host.restore(&from_cpu).unwrap();
    for t in 25..50 {
        for sim in [&mut cpu, &mut new_cpu, &mut new_host] {
            step(sim, t);
        }
    }
    let expected = cpu.snapshot().unwrap();
    assert!(expected == new_cpu.snapshot().unwrap() && expected == new_host.snapshot().unwrap());
}

#[test]
fn a_card_that_is_lost_costs_no_step() {
    let options = busy(&["unitree_a1", "spot"], 36);
    let mut cpu = Sim::new(&options).unwrap();
    // two blocks a step: the card fails in the eleventh step, with the second block, which is late:
    // the components of the first one are written by then
    let left = Arc::new(AtomicUsize::new(21));
    let device = left.clone();
    let mut lost =
        sim_on(options, move || Ok(Arc::new(Failing { left: device.clone(), ..Failing::default() }))).unwrap();
    for t in 0..30 {
        step(&mut cpu, t);
        step(&mut lost, t);
        assert_eq!(left.load(Ordering::Relaxed), 21usize.saturating_sub(2 * (t + 1)));
        assert_all_same(&mut cpu, &mut lost, &format!("step {t}"));
    }
    assert!(cpu.snapshot().unwrap() == lost.snapshot().unwrap());
}

#[test]
fn engines_that_take_turns_make_the_steps_of_one() {
    let options = busy(&["unitree_a1", "spot"], 36);
    let mut cpu = Sim::new(&options).unwrap();
    // a count for each block of a step: what is left says how many the device made
    let left = Arc::new(AtomicUsize::new(1000));
    let device = left.clone();
    let open = move || -> Result<Arc<dyn Device>, DeviceError> {
        Ok(Arc::new(Failing { left: device.clone(), ..Failing::default() }))
    };
    let mut both = sim_with(options.clone(), "auto", OnDevice::if_faster(open)).unwrap();
    let no_card = || Err(DeviceError::NoDriver);
    let mut without = sim_with(options, "auto", OnDevice::if_faster(no_card)).unwrap();
    let mut before = 0;
    // no block, one and both take turns of 12 steps, three times; then the fastest way goes on
    for t in 0..115 {
        for sim in [&mut cpu, &mut both, &mut without] {
            step(sim, t);
        }
        assert_all_same(&mut cpu, &mut both, &format!("step {t}"));
        // a block whose lists were too short counts twice
        let made = 1000 - left.load(Ordering::Relaxed);
        match t / 12 {
            turn @ 0..9 if turn % 3 == 0 => assert_eq!(made, before, "step {t}"),
            turn @ 0..9 => {
                assert!((turn % 3..=2 * (turn % 3)).contains(&(made - before)), "step {t}: {made}, {before}")
            }
            _ => assert!(made - before <= 4, "step {t}"),
        }
        before = made;
    }
    let expected = cpu.snapshot().unwrap();
    assert!(expected == both.snapshot().unwrap() && expected == without.snapshot().unwrap());
}

#[test]
fn a_broken_state_is_recorded_as_on_the_cpu() {
    let options = busy(&["unitree_a1"], 40);
    let (mut cpu, mut host) = (Sim::new(&options).unwrap(), on_host(options));
    for t in 0..6 {
        for sim in [&mut cpu, &mut host] {
            if t == 3 {
                let world = sim.world_mut();
                let mut bodies = world.query::<(&EnvId, &mut BaseVelocity)>();
                for (env, mut velocity) in bodies.iter_mut(world) {
                    if env.0 == 33 {
                        velocity.linear = [5e3, 0.0, 0.0];
                    }
                }
            }
            step(sim, t);
        }
        assert_all_same(&mut cpu, &mut host, &format!("step {t}"));
    }
    assert!(cpu.snapshot().unwrap() == host.snapshot().unwrap());
}

#[test]
fn a_machine_without_a_card_is_refused_by_name() {
    let without = |error: DeviceError| {
        let made = sim_on(busy(&["unitree_a1"], 2), move || Err(error.clone()));
        made.map(|_| ()).unwrap_err().to_string()
    };
    let error = without(DeviceError::NoDriver);
    assert!(error.contains("physics.engine: there is no driver") && error.contains("articulated"), "{error}");
    let error = without(DeviceError::OldDriver(10020, 11040));
    assert!(error.contains("CUDA 10.2 at most, and 11.4 is needed"), "{error}");
    let error = without(DeviceError::Memory { needed: 900, free: 80 });
    assert!(error.contains("80 MB of memory free") && error.contains("fewer envs"), "{error}");
}
