//! Robots, states, commands and ground of the tests and of the reference for a GPU.

#![allow(dead_code, reason = "each of its users needs a part of it")]

use polypod::config::Library;
use polypod::dynamics::{
    ActuatorNetwork, ContactSettings, Drive, Function, HeightGrid, Instruction, NetworkInput, NetworkProgram,
    Operation, Parameters, Plane, Span, State, Topology,
};
use polypod::{Sim, SimOptions};

/// Random numbers, the same on every machine.
pub struct Random(pub u64);

impl Random {
    /// A number from -1 to 1.
    pub fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 40) as f32 / (1 << 23) as f32 - 1.0
    }
}

/// A morphology of the library.
pub struct Robot {
    pub name: String,
    pub topology: Topology,
    pub nominal: Parameters<f32>,
    pub networks: Vec<ActuatorNetwork>,
}

/// All morphologies; `touching`: with contacts between the links of every robot.
pub fn library(touching: bool) -> Vec<Robot> {
    let library = Library::new(Vec::new());
    let names: Vec<String> = library.robots().unwrap().iter().map(|robot| robot.name.clone()).collect();
    assert!(names.len() >= 25, "the library has {} robots", names.len());
    let options = SimOptions {
        robots: Some(names.clone()),
        threads: Some(1),
        overrides: names.iter().map(|name| format!("robot_overrides.{name}.self_collisions={touching}")).collect(),
        ..SimOptions::new("velocity_flat_legged_play", names.len())
    };
    let sim = Sim::new(&options).unwrap();
    let morphologies = sim.morphologies().iter().zip(names);
    morphologies
        .map(|(morphology, name)| Robot {
            name,
            topology: morphology.topology.clone(),
            nominal: morphology.nominal.clone(),
            networks: Vec::new(),
        })
        .collect()
}

/// A robot above the ground, with all joints within their limits.
pub fn random_state(robot: &Robot, random: &mut Random) -> State<f32> {
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
pub fn randomise_drive(robot: &Robot, drive: &mut Drive<f32>, random: &mut Random) {
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

/// Stairs, slopes, edges and bumps around the origin.
pub fn rough_ground(random: &mut Random) -> HeightGrid {
    let size = [161, 121];
    let mut grid = HeightGrid::level([-4.0, -3.0], 0.05, size, 0.0);
    for i in 0..size[0] {
        for j in 0..size[1] {
            let stairs = 0.1 * (i / 6 % 3) as f32;
            let slope = 0.01 * (j as f32 - 60.0).abs();
            grid.set_height(i, j, stairs + slope + 0.03 * random.next());
        }
    }
    grid.note_squares();
    grid
}

/// Gives a robot springs, surfaces, delays and explicit joints; the contacts of a slope.
pub fn with_springs_on_a_slope(robot: &mut Robot) -> ContactSettings {
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
    ContactSettings { ground, iterations: 6, ..ContactSettings::default() }
}

/// Instructions of a network that is being built, and its features so far.
struct Program<'a> {
    instructions: Vec<Instruction>,
    features: usize,
    random: &'a mut Random,
}

impl Program<'_> {
    fn span(&mut self, len: usize) -> Span {
        self.features += len;
        Span { first: self.features - len, len }
    }

    fn affine(&mut self, from: Span, outputs: usize) -> Span {
        let to = self.span(outputs);
        let size = 1.5 / (from.len as f32).sqrt();
        let weights = (0..(from.len + 1) * outputs).map(|_| size * self.random.next()).collect();
        self.instructions.push(Instruction::Affine { from, to, weights });
        to
    }

    fn map(&mut self, function: Function, from: Span) -> Span {
        let to = self.span(from.len);
        self.instructions.push(Instruction::Map { function, from, to });
        to
    }

    fn combine(&mut self, operation: Operation, a: Span, b: Span) -> Span {
        let to = self.span(a.len);
        self.instructions.push(Instruction::Combine { operation, a, b, to });
        to
    }

    /// The network, whose result is the first of these features.
    fn end(self, result: Span, joints: Vec<usize>, ages: &[usize], memory: usize) -> ActuatorNetwork {
        let input = |is_velocity: bool, scale: f32| {
            ages.iter().map(move |&age| NetworkInput { is_velocity, age, scale: scale / (1 + age) as f32 })
        };
        let inputs: Vec<NetworkInput> = input(false, 1.3).chain(input(true, 0.1)).collect();
        let program =
            NetworkProgram::new(inputs.len(), self.features, memory, result.first, self.instructions).unwrap();
        ActuatorNetwork::new(joints, inputs, 9.0, program).unwrap()
    }
}

/// A network with every instruction that has no memory: layers of many sizes, all functions.
fn perceptron(joints: Vec<usize>, ages: &[usize], random: &mut Random) -> ActuatorNetwork {
    let mut program = Program { instructions: Vec::new(), features: 2 * ages.len(), random };
    let mut x = Span { first: 0, len: 2 * ages.len() };
    let functions = [
        Function::Softsign,
        Function::Elu(0.7),
        Function::LeakyRelu(0.2),
        Function::Tanh,
        Function::Abs,
        Function::Sigmoid,
        Function::Neg,
        Function::Relu,
    ];
    for (function, width) in functions.into_iter().zip([19, 8, 5, 1, 32, 3, 16, 9]) {
        let y = program.affine(x, width);
        x = program.map(function, y);
    }
    let (one, many) = (program.affine(x, 1), program.span(9));
    program.instructions.push(Instruction::Copy { from: one, to: many });
    let values: Vec<f32> = (0..9).map(|_| 2.0 + program.random.next()).collect();
    let constant = program.span(9);
    program.instructions.push(Instruction::Constant { values, to: constant });
    let x = program.combine(Operation::Mul, many, x);
    let x = program.combine(Operation::Sub, constant, x);
    let x = program.combine(Operation::Add, x, many);
    let x = program.combine(Operation::Div, x, constant);
    let moved = program.span(9);
    program.instructions.push(Instruction::Copy { from: x, to: moved });
    // ranges that overlap
    let (from, to) = (Span { first: moved.first, len: 8 }, Span { first: moved.first + 1, len: 8 });
    program.instructions.push(Instruction::Copy { from, to });
    program.instructions.push(Instruction::Copy { from: to, to: from });
    let result = program.affine(moved, 1);
    program.end(result, joints, ages, 0)
}

/// A network of LSTM layers, each of as many units as this says.
fn recurrent(joints: Vec<usize>, layers: &[usize], random: &mut Random) -> ActuatorNetwork {
    let mut program = Program { instructions: Vec::new(), features: 2, random };
    let (mut x, mut memory) = (Span { first: 0, len: 2 }, 0);
    for &units in layers {
        let both = program.span(x.len + units);
        let (given, recalled) =
            (Span { first: both.first, len: x.len }, Span { first: both.first + x.len, len: units });
        program.instructions.push(Instruction::Copy { from: x, to: given });
        program.instructions.push(Instruction::Recall { memory, to: recalled });
        let gates = program.affine(both, 4 * units);
        x = program.span(units);
        program.instructions.push(Instruction::Cell { gates, hidden: memory, cell: memory + units, to: x });
        memory += 2 * units;
    }
    let result = program.affine(x, 1);
    program.end(result, joints, &[0], memory)
}

/// Gives a robot networks for most of its joints: perceptrons that look back, and LSTMs.
pub fn with_networks(robot: &mut Robot, random: &mut Random) {
    let joints = robot.topology.num_joints();
    let every = |step: usize, first: usize| (first..joints).step_by(step).collect::<Vec<_>>();
    robot.networks = vec![
        perceptron(every(3, 0), &[0, 1, 3], random),
        recurrent(every(3, 1), &[8, 5], random),
        perceptron(every(6, 2), &[2], random),
    ];
    for &joint in robot.networks.iter().flat_map(ActuatorNetwork::joints) {
        robot.topology.joints[joint].explicit = true;
        (robot.nominal.stiffness[joint], robot.nominal.damping[joint]) = (0.0, 0.0);
    }
}

/// A morphology of the reference task, and how it stands.
pub struct Standing {
    pub robot: Robot,
    pub position: Vec<f32>,
    pub height: f32,
}

/// The robots of the reference task, as its config has them.
pub fn reference_robots() -> Vec<Standing> {
    let options = SimOptions { threads: Some(1), ..SimOptions::new("velocity_flat_play", 8) };
    let sim = Sim::new(&options).unwrap();
    let robots = sim.morphologies().iter().zip(sim.loaded_robots());
    robots
        .map(|(morphology, loaded)| Standing {
            robot: Robot {
                name: loaded.config.name.clone(),
                topology: morphology.topology.clone(),
                nominal: morphology.nominal.clone(),
                networks: Vec::new(),
            },
            position: morphology.stance.default_position.to_vec(),
            height: morphology.stance.spawn_height,
        })
        .collect()
}
