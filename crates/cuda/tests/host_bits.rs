//! The text of the device, compiled for the host, gives the bits of the kernels of
//! `polypod-dynamics`: all robots of the library fall onto the ground and move about on it, and
//! state and report are compared after each physics step.

use polypod::config::Library;
use polypod::dynamics::{
    ContactFriction, ContactSettings, ControlStep, Drive, LinkForce, Parameters, Plane, Report, State, StepSettings,
    Topology, Workspace,
};
use polypod::{Sim, SimOptions};
use polypod_cuda::{Block, Scene};

/// Robots of a block.
const ENVS: usize = 3;

struct Random(u64);

impl Random {
    /// A number from -1 to 1.
    fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 40) as f32 / (1 << 23) as f32 - 1.0
    }
}

/// A morphology of the library.
struct Robot {
    name: String,
    topology: Topology,
    nominal: Parameters<f32>,
}

fn library() -> Vec<Robot> {
    let library = Library::new(Vec::new());
    let names: Vec<String> = library.robots().unwrap().iter().map(|robot| robot.name.clone()).collect();
    assert!(names.len() >= 25, "the library has {} robots", names.len());
    let options = SimOptions {
        robots: Some(names.clone()),
        threads: Some(1),
        ..SimOptions::new("velocity_flat_legged_play", names.len())
    };
    let sim = Sim::new(&options).unwrap();
    let morphologies = sim.morphologies().iter().zip(names);
    morphologies
        .map(|(morphology, name)| {
            let mut topology = morphology.topology.clone();
            // links of one robot do not touch each other on the device yet
            let colliders = topology.colliders.clone();
            topology.set_pairs(colliders, &[]);
            Robot { name, topology, nominal: morphology.nominal.clone() }
        })
        .collect()
}

fn random_state(robot: &Robot, random: &mut Random) -> State<f32> {
    let mut state = State::zeros(&robot.topology);
    state.position = [random.next(), random.next(), 0.5 + 0.3 * random.next()];
    let q: [f32; 4] = [1.0, 0.5 * random.next(), 0.5 * random.next(), random.next()];
    let norm = q.iter().map(|x| x * x).sum::<f32>().sqrt();
    state.rotation = q.map(|x| x / norm);
    state.linear_velocity = std::array::from_fn(|_| random.next());
    state.angular_velocity = std::array::from_fn(|_| 2.0 * random.next());
    for j in 0..robot.topology.num_joints() {
        let (lower, upper) = (robot.nominal.lower[j].max(-1.5), robot.nominal.upper[j].min(1.5));
        state.joint_position[j] = lower + (upper - lower) * (0.5 + 0.5 * random.next());
        state.joint_velocity[j] = 2.0 * random.next();
    }
    state
}

/// Commands that change in each control step; now and then they ask for more than motors can give.
fn randomise_drive(robot: &Robot, drive: &mut Drive<f32>, random: &mut Random) {
    for age in (1..drive.targets.len()).rev() {
        drive.targets[age] = drive.targets[age - 1].clone();
    }
    for j in 0..robot.topology.num_joints() {
        drive.targets[0][j] = 1.2 * random.next();
        drive.delay[j] = (3.0 * random.next()).abs().floor();
        drive.feedforward[j] = 20.0 * random.next().powi(3);
    }
    drive.base_force = std::array::from_fn(|_| 60.0 * random.next().powi(5));
    drive.base_torque = std::array::from_fn(|_| 10.0 * random.next().powi(5));
    for force in &mut drive.link_forces {
        force.acts = f32::from(random.next() > 0.0);
        force.point = std::array::from_fn(|_| 0.1 * random.next());
        force.force = std::array::from_fn(|_| 20.0 * random.next());
        force.torque = std::array::from_fn(|_| random.next());
    }
}

fn bits<'a>(numbers: impl IntoIterator<Item = &'a f32>) -> Vec<u32> {
    numbers.into_iter().map(|x| x.to_bits()).collect()
}

/// Names and bits of all numbers of a state and a report.
fn named_bits(state: &State<f32>, report: &Report<f32>) -> [(&'static str, Vec<u32>); 15] {
    [
        ("position", bits(&state.position)),
        ("rotation", bits(&state.rotation)),
        ("linear velocity", bits(&state.linear_velocity)),
        ("angular velocity", bits(&state.angular_velocity)),
        ("joint position", bits(&state.joint_position)),
        ("joint velocity", bits(&state.joint_velocity)),
        ("impulse", bits(state.impulse.as_flattened())),
        ("bound impulse", bits(&state.bound_impulse)),
        ("joint effort", bits(&report.joint_effort)),
        ("joint acceleration", bits(&report.joint_acceleration)),
        ("body force", bits(report.body_force.as_flattened())),
        ("normal force", bits(report.normal_force.iter().flatten())),
        ("touched", report.touched.iter().map(|&touched| u32::from(touched)).collect()),
        ("demands", bits(&report.demands)),
        ("sites", bits(report.site_position.as_flattened().iter().chain(report.site_velocity.as_flattened()))),
    ]
}

/// What happened in a run, so that a test sees that it met what it is about.
#[derive(Default, Debug)]
struct Met {
    contacts: usize,
    limits: usize,
    pushes: usize,
}

/// Steps the robots of a morphology on both sides and compares them after each physics step. The
/// last robot of the block reads parameters of its own.
fn compare(robot: &Robot, contact: ContactSettings, link_forces: &[(usize, bool)], steps: usize) -> Met {
    let Robot { name, topology, nominal } = robot;
    let settings = StepSettings { dt: 0.005, decimation: 4, gravity: [0.0, 0.0, -9.81], contact };
    let scene = Scene { ages: 2, link_forces, ..Scene::default() };
    let mut random = Random(name.bytes().map(u64::from).sum());
    let mut block = Block::new(topology, &settings, &scene, ENVS).unwrap();
    block.share_parameters(nominal);
    let mut parameters = vec![nominal.clone(); ENVS];
    parameters[ENVS - 1].zip_with(nominal, |own, number| *own = number * (1.0 + 0.01 * random.next()));
    block.write_parameters(ENVS - 1, &parameters[ENVS - 1]);
    let mut states: Vec<_> = (0..ENVS).map(|_| random_state(robot, &mut random)).collect();
    let mut drives = vec![Drive::zeros(topology, scene.ages); ENVS];
    for drive in &mut drives {
        drive.link_forces = link_forces.iter().map(|&key| LinkForce::zero(key)).collect();
    }
    let mut reports = vec![Report::zeros(topology, settings.decimation); ENVS];
    let mut work = Workspace::new(topology);
    let mut met = Met::default();
    states.iter().enumerate().for_each(|(env, state)| block.write_state(env, state));
    let (mut state, mut report) = (State::zeros(topology), Report::zeros(topology, settings.decimation));
    for step in 0..steps {
        for env in 0..ENVS {
            randomise_drive(robot, &mut drives[env], &mut random);
            block.write_drive(env, &drives[env]);
        }
        for substep in 0..settings.decimation {
            assert!(block.step_on_host(substep..substep + 1));
            for env in 0..ENVS {
                ControlStep {
                    topology,
                    settings: &settings,
                    terrain: None,
                    parameters: &parameters[env],
                    kind: None,
                    drive: &drives[env],
                    substeps: substep..substep + 1,
                    state: &mut states[env],
                    report: &mut reports[env],
                    work: &mut work,
                }
                .run();
                block.read_state(env, &mut state);
                block.read_report(env, &mut report);
                let pairs = named_bits(&states[env], &reports[env]).into_iter().zip(named_bits(&state, &report));
                for ((what, ours), (_, theirs)) in pairs {
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
    let mut limits = 0;
    for robot in library() {
        let met = compare(&robot, ContactSettings::default(), &[], 100);
        assert!(met.contacts > 50 && met.pushes > 10, "{}: {met:?}", robot.name);
        limits += usize::from(met.limits > 10);
    }
    assert!(limits > 15, "only {limits} robots were at joint limits");
}

#[test]
fn on_ground_that_resists_turning_and_gives_back_what_falls() {
    for (index, mut robot) in library().into_iter().enumerate() {
        robot.topology.friction = [ContactFriction::Torsional, ContactFriction::Rolling][index % 2];
        robot.nominal.torsional_friction = 0.02;
        robot.nominal.rolling_friction = 0.01;
        robot.nominal.restitution = 0.4;
        let met = compare(&robot, ContactSettings::default(), &[], 40);
        assert!(met.contacts > 20, "{}: {met:?}", robot.name);
    }
}

#[test]
fn with_springs_surfaces_and_forces_on_links_on_a_slope() {
    for mut robot in library() {
        let joints = robot.topology.num_joints();
        robot.topology.has_springs = true;
        robot.topology.has_surfaces = true;
        robot.topology.has_delay = true;
        robot.topology.joints.iter_mut().step_by(2).for_each(|joint| joint.explicit = true);
        robot.nominal.spring = vec![[8.0, 0.4]; joints].into();
        robot.nominal.contact_friction = vec![[0.5, 0.01, 0.0]; robot.topology.contacts.len()].into();
        robot.nominal.joint_friction.iter_mut().for_each(|friction| *friction += 0.1);
        let (s, c) = 0.2f64.sin_cos();
        let ground = Some(Plane { normal: [0.6 * s, 0.8 * s, c], offset: -0.1 });
        let contact = ContactSettings { ground, iterations: 6, ..ContactSettings::default() };
        let met = compare(&robot, contact, &[(0, true), (joints, false)], 40);
        assert!(met.contacts > 20, "{}: {met:?}", robot.name);
    }
}

#[test]
fn of_robots_that_are_fixed_or_fly() {
    for mut robot in library() {
        let no_ground = ContactSettings { ground: None, ..ContactSettings::default() };
        compare(&robot, no_ground, &[], 10);
        robot.topology.floating = false;
        compare(&robot, ContactSettings::default(), &[], 20);
    }
}
