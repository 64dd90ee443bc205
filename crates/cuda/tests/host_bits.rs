//! The text of the device, compiled for the host, gives the bits of the kernels of
//! `polypod-dynamics`: all robots of the library fall onto the ground and move about on it, and
//! state and report are compared after each physics step.

mod scenes;

use std::collections::BTreeSet;

use polypod::dynamics::{
    ActuatorNetwork, ContactFriction, ContactSettings, ControlStep, Drive, HeightGrid, Instruction, LinkForce,
    NetworkInput, NetworkProgram, NetworkStep, Parameters, Report, Span, State, StepSettings, Terrain, Topology,
    Workspace,
};
use polypod_cuda::{Block, Heights, Scene, Unsupported};
use polypod_cuda_host::{OwnText, step_by_threads, step_on_host};
use scenes::{
    Random, Robot, library, random_state, randomise_drive, rough_ground, with_networks, with_springs_on_a_slope,
};

/// Robots of a block.
const ENVS: usize = 3;
/// Robots that step with the text of their morphology alone, each with another number of joints.
const WITH_OWN_TEXT: usize = 3;

fn bits<'a>(numbers: impl IntoIterator<Item = &'a f32>) -> Vec<u32> {
    numbers.into_iter().map(|x| x.to_bits()).collect()
}

/// Names and bits of all numbers of a state, of the memory of networks and of a report.
fn named_bits(state: &State<f32>, memory: &[f32], report: &Report<f32>) -> [(&'static str, Vec<u32>); 16] {
    [
        ("position", bits(&state.position)),
        ("rotation", bits(&state.rotation)),
        ("linear velocity", bits(&state.linear_velocity)),
        ("angular velocity", bits(&state.angular_velocity)),
        ("joint position", bits(&state.joint_position)),
        ("joint velocity", bits(&state.joint_velocity)),
        ("impulse", bits(state.impulse.as_flattened())),
        ("bound impulse", bits(&state.bound_impulse)),
        ("memory", bits(memory)),
        ("joint effort", bits(&report.joint_effort)),
        ("joint acceleration", bits(&report.joint_acceleration)),
        ("body force", bits(report.body_force.as_flattened())),
        ("normal force", bits(report.normal_force.iter().flatten())),
        ("touched", report.touched.iter().map(|&touched| u32::from(touched)).collect()),
        ("demands", bits(&report.demands)),
        ("sites", bits(report.site_position.as_flattened().iter().chain(report.site_velocity.as_flattened()))),
    ]
}

/// Counts of events in a run, so that a test sees that it met its subject.
#[derive(Default, Debug)]
struct Met {
    contacts: usize,
    limits: usize,
    pushes: usize,
    pairs: usize,
    /// Whether a text of the morphology alone took part.
    own: bool,
}

/// Steps the robots of a morphology on both sides and compares them after each physics step. The
/// last robot of the block reads separate parameters. Robots take every fourth physics step by
/// several threads each. With `has_own` they take every second one with the text of their
/// morphology alone.
fn compare(
    robot: &Robot,
    contact: ContactSettings,
    terrain: Option<&HeightGrid>,
    link_forces: &[(usize, bool)],
    steps: usize,
    has_own: bool,
) -> Met {
    let Robot { name, topology, nominal, networks } = robot;
    let settings = StepSettings { dt: 0.005, decimation: 4, gravity: [0.0, 0.0, -9.81], contact };
    let heights = terrain.map(Heights::new);
    let scene = Scene { terrain: heights.as_ref(), networks, ages: 2, link_forces };
    let mut random = Random(name.bytes().map(u64::from).sum());
    let mut block = Block::new(topology, &settings, &scene, ENVS).unwrap();
    block.share_parameters(nominal);
    let tables = &block.shape().tables;
    let own = (has_own && tables.header().is_some()).then(|| OwnText::compile(tables).unwrap());
    let mut parameters = vec![nominal.clone(); ENVS];
    parameters[ENVS - 1].zip_with(nominal, |own, number| *own = number * (1.0 + 0.01 * random.next()));
    block.write_parameters(ENVS - 1, &parameters[ENVS - 1]);
    let mut states: Vec<_> = (0..ENVS).map(|_| random_state(robot, &mut random)).collect();
    let mut drives = vec![Drive::zeros(topology, scene.ages); ENVS];
    for drive in &mut drives {
        drive.link_forces = link_forces.iter().map(|&key| LinkForce::zero(key)).collect();
    }
    let mut reports = vec![Report::zeros(topology, settings.decimation); ENVS];
    let mut memories = vec![vec![0.0; ActuatorNetwork::num_remembered_by(networks)]; ENVS];
    // a workspace remembers the base's colliders from one physics step to the next
    let mut work = vec![Workspace::new(topology); ENVS];
    let mut features = Vec::new();
    let origins: Vec<[f32; 2]> = (0..ENVS).map(|_| [random.next(), random.next()]).collect();
    let mut met = Met { own: own.is_some(), ..Met::default() };
    let num_parts: usize = topology.pairs.iter().map(|pair| pair.spans.len()).sum();
    let of_pairs = topology.contacts.len()..topology.contacts.len() + num_parts;
    states.iter().enumerate().for_each(|(env, state)| block.write_state(env, state));
    let (mut state, mut report) = (State::zeros(topology), Report::zeros(topology, settings.decimation));
    let mut memory = memories[0].clone();
    for step in 0..steps {
        for env in 0..ENVS {
            randomise_drive(robot, &mut drives[env], &mut random);
            block.write_drive(env, &drives[env], origins[env]);
        }
        for substep in 0..settings.decimation {
            let substeps = substep..substep + 1;
            let stepped = match &own {
                Some(own) if substep % 2 == 1 => own.step(&mut block, substeps),
                _ if substep == 2 => step_by_threads(&mut block, substeps),
                _ => step_on_host(&mut block, substeps),
            };
            assert!(stepped);
            for env in 0..ENVS {
                if !networks.is_empty() {
                    NetworkStep {
                        topology,
                        settings: &settings,
                        networks,
                        substep,
                        state: &states[env],
                        drive: &mut drives[env],
                        memory: &mut memories[env],
                        features: &mut features,
                        work: &mut work[env],
                    }
                    .run();
                }
                ControlStep {
                    topology,
                    settings: &settings,
                    terrain: terrain.map(|grid| Terrain { grid, origin: &origins[env] }),
                    parameters: &parameters[env],
                    nominal: None,
                    drive: &drives[env],
                    substeps: substep..substep + 1,
                    state: &mut states[env],
                    report: &mut reports[env],
                    work: &mut work[env],
                }
                .run();
                let pressing = |contact: &&u32| of_pairs.contains(&(**contact as usize));
                met.pairs += states[env].pressing.iter().filter(pressing).count();
                block.read_state(env, &mut state);
                block.read_report(env, &mut report);
                block.read_memory(env, &mut memory);
                let ours = named_bits(&states[env], &memories[env], &reports[env]);
                for ((what, ours), (_, theirs)) in ours.into_iter().zip(named_bits(&state, &memory, &report)) {
                    let place = ours.iter().zip(&theirs).position(|(a, b)| a != b);
                    if let Some(at) = place {
                        let [a, b] = [ours[at], theirs[at]].map(f32::from_bits);
                        panic!(
                            "{name}, step {step}.{substep}, env {env}: {what} {at} is {a:e} and on the device {b:e}"
                        );
                    }
                }
            }
        }
        for report in &reports {
            let (bodies, rest) = report.demands.split_at(topology.num_bodies);
            met.contacts += usize::from(bodies.iter().any(|&x| x > 0.0));
            met.limits += usize::from(rest[..rest.len() - 1].iter().any(|&x| x > 0.0));
            met.pushes += usize::from(rest[rest.len() - 1] > 0.0);
        }
    }
    for state in &states {
        assert!(state.position.iter().all(|x| x.is_finite()), "{name}: the state is not finite");
    }
    met
}

#[test]
fn of_all_robots_on_a_plane() {
    let (mut limits, mut pairs) = (0, 0);
    let robots = library(true);
    let mut with_own = BTreeSet::new();
    for robot in robots {
        let joints = robot.topology.num_joints();
        let has_own = with_own.len() < WITH_OWN_TEXT && !with_own.contains(&joints);
        let met = compare(&robot, ContactSettings::default(), None, &[], 50, has_own);
        with_own.extend(met.own.then_some(joints));
        assert!(met.contacts > 0 && met.pushes > 0, "{}: {met:?}", robot.name);
        limits += usize::from(met.limits > 0);
        pairs += usize::from(met.pairs > 0);
    }
    assert_eq!(with_own.len(), WITH_OWN_TEXT, "numbers of joints of robots with own texts: {with_own:?}");
    assert!(limits > 15, "only {limits} robots were at joint limits");
    assert!(pairs > 15, "links of only {pairs} robots touched each other");
}

#[test]
fn on_ground_that_resists_turning_and_gives_back_what_falls() {
    for (index, mut robot) in library(false).into_iter().enumerate() {
        robot.topology.friction = [ContactFriction::Torsional, ContactFriction::Rolling][index % 2];
        robot.nominal.torsional_friction = 0.02;
        robot.nominal.rolling_friction = 0.01;
        robot.nominal.restitution = 0.4;
        let met = compare(&robot, ContactSettings::default(), None, &[], 15, false);
        assert!(met.contacts > 0, "{}: {met:?}", robot.name);
    }
}

#[test]
fn with_springs_surfaces_and_forces_on_links_on_a_slope() {
    for mut robot in library(false) {
        let joints = robot.topology.num_joints();
        let contact = with_springs_on_a_slope(&mut robot);
        let met = compare(&robot, contact, None, &[(0, true), (joints, false)], 15, false);
        assert!(met.contacts > 0, "{}: {met:?}", robot.name);
    }
}

#[test]
fn of_all_robots_on_rough_ground() {
    let grid = rough_ground(&mut Random(3));
    for (index, mut robot) in library(false).into_iter().enumerate() {
        robot.topology.friction = [ContactFriction::Sliding, ContactFriction::Rolling][index % 2];
        robot.nominal.rolling_friction = 0.01;
        let met = compare(&robot, ContactSettings::default(), Some(&grid), &[], 25, index == 0);
        assert!(met.contacts > 0 && met.pushes > 0, "{}: {met:?}", robot.name);
    }
}

#[test]
fn of_robots_that_are_fixed_or_fly() {
    for mut robot in library(false) {
        let no_ground = ContactSettings { ground: None, ..ContactSettings::default() };
        compare(&robot, no_ground, None, &[], 10, false);
        robot.topology.floating = false;
        compare(&robot, ContactSettings::default(), None, &[], 10, false);
    }
}

#[test]
fn of_robots_whose_joints_networks_drive() {
    let mut counts = BTreeSet::new();
    for (index, mut robot) in library(true).into_iter().enumerate() {
        let contact = if index % 2 == 0 { with_springs_on_a_slope(&mut robot) } else { ContactSettings::default() };
        with_networks(&mut robot, &mut Random(index as u64));
        counts.insert(robot.networks[0].joints().len());
        let met = compare(&robot, contact, None, &[], 20, index == 0);
        assert!(met.contacts > 0, "{}: {met:?}", robot.name);
        assert_eq!(met.own, index == 0);
    }
    assert!(counts.len() > 3 && counts.iter().any(|count| *count > 8), "{counts:?}");
}

/// A network whose torque is that number.
fn constant(value: f32) -> ActuatorNetwork {
    let to = Span { first: 0, len: 1 };
    let program = NetworkProgram::new(1, 1, 0, 0, vec![Instruction::Constant { values: vec![value], to }]);
    let input = NetworkInput { is_velocity: false, age: 0, scale: 1.0 };
    ActuatorNetwork::new(vec![0], vec![input], 1.0, program.unwrap()).unwrap()
}

/// Whether numbers of a state are numbers, after a control step under the torque of a network.
fn are_numbers_after(torque: f32) -> Vec<bool> {
    let robot = library(false).remove(0);
    let Robot { topology, nominal, .. } = &robot;
    let networks = [constant(torque)];
    let contact = ContactSettings::default();
    let settings = StepSettings { dt: 0.005, decimation: 4, gravity: [0.0, 0.0, -9.81], contact };
    let scene = Scene { networks: &networks, ages: 1, ..Scene::default() };
    let mut block = Block::new(topology, &settings, &scene, 1).unwrap();
    block.share_parameters(nominal);
    let mut state = random_state(&robot, &mut Random(1));
    block.write_state(0, &state);
    block.write_drive(0, &Drive::zeros(topology, 1), [0.0; 2]);
    assert!(step_by_threads(&mut block, 0..4));
    block.read_state(0, &mut state);
    state.position.iter().chain(&state.linear_velocity).map(|x| x.is_finite()).collect()
}

#[test]
fn a_torque_that_is_not_finite_breaks_the_state() {
    assert_eq!(are_numbers_after(3.0), [true; 6]);
    for torque in [f32::INFINITY, f32::NAN] {
        assert_eq!(are_numbers_after(torque), [false; 6], "{torque}");
    }
}

#[test]
fn a_block_refuses_steps_that_it_cannot_make() {
    let settings =
        StepSettings { dt: 0.005, decimation: 4, gravity: [0.0, 0.0, -9.81], contact: ContactSettings::default() };
    let topology = Topology::new(true, Vec::new(), Vec::new(), 1, Vec::new(), false);
    // without parameters, or beyond the control step
    let mut block = Block::new(&topology, &settings, &Scene::default(), 1).unwrap();
    assert!(!step_on_host(&mut block, 0..1));
    block.share_parameters(&Parameters::zeros(&topology));
    assert!(!step_on_host(&mut block, 0..5) && step_on_host(&mut block, 0..4));
    // features of a network whose places 32 bits do not count
    let to = Span { first: 1, len: 1 << 28 };
    let fill = Instruction::Copy { from: Span { first: 0, len: 1 }, to };
    let program = NetworkProgram::new(1, 1 + to.len, 0, 0, vec![fill]).unwrap();
    let input = NetworkInput { is_velocity: false, age: 0, scale: 1.0 };
    let network = ActuatorNetwork::new(vec![0], vec![input], 1.0, program).unwrap();
    let scene = Scene { networks: &[network], ..Scene::default() };
    assert_eq!(Block::new(&topology, &settings, &scene, 1).err(), Some(Unsupported::TooLarge));
    assert!(Unsupported::TooLarge.to_string().contains("smaller networks"));
}
