//! Writes what the kernels of `polypod-dynamics` make of blocks of robots, for a comparison on a
//! machine with a GPU: `tools/device_bits.py` reads the file there, where Rust is not needed.
//!
//! ```bash
//! cargo run --release --package polypod-cuda --example reference -- target/reference.bin
//! ```
//!
//! The file is a list of arrays, each with its name, `scene/robot/array`. The state and the report
//! after each control step are there as checksums, those after the last step as tiles.

#[path = "../tests/scenes/mod.rs"]
mod scenes;

use std::fs::File;
use std::io::{self, BufWriter, Write};

use polypod::dynamics::{
    ActuatorNetwork, ContactFriction, ContactSettings, ControlStep, Drive, HeightGrid, LinkForce, NetworkStep,
    Parameters, Report, State, StepSettings, Terrain, Workspace,
};
use polypod_cuda::{Block, Heights, Parts, Scene};
use scenes::{
    Random, Robot, library, random_state, randomise_drive, reference_robots, rough_ground, with_networks,
    with_springs_on_a_slope,
};

/// Robots of a block: two warps.
const ENVS: usize = 64;
/// Control steps with one drive.
const STEPS_OF_DRIVE: usize = 10;

/// A list of named arrays.
struct Arrays<W> {
    out: W,
    prefix: String,
}

impl<W: Write> Arrays<W> {
    fn write(&mut self, name: &str, kind: u8, words: impl ExactSizeIterator<Item = [u8; 4]>) -> io::Result<()> {
        let name = format!("{}/{name}", self.prefix);
        self.out.write_all(&u32::try_from(name.len()).map_err(io::Error::other)?.to_le_bytes())?;
        self.out.write_all(name.as_bytes())?;
        self.out.write_all(&[kind])?;
        self.out.write_all(&(words.len() as u64).to_le_bytes())?;
        words.into_iter().try_for_each(|word| self.out.write_all(&word))
    }

    fn floats(&mut self, name: &str, numbers: &[f32]) -> io::Result<()> {
        self.write(name, b'f', numbers.iter().map(|x| x.to_le_bytes()))
    }

    fn integers(&mut self, name: &str, numbers: &[i32]) -> io::Result<()> {
        self.write(name, b'i', numbers.iter().map(|x| x.to_le_bytes()))
    }
}

/// The checksum of zip files over the little-endian bytes of words.
fn crc32(words: impl IntoIterator<Item = u32>) -> u32 {
    let mut table = [0u32; 256];
    for (i, entry) in table.iter_mut().enumerate() {
        *entry = (0..8).fold(i as u32, |c, _| if c & 1 == 1 { 0xEDB8_8320 ^ (c >> 1) } else { c >> 1 });
    }
    let bytes = words.into_iter().flat_map(u32::to_le_bytes);
    !bytes.fold(!0u32, |c, byte| table[((c ^ u32::from(byte)) & 0xFF) as usize] ^ (c >> 8))
}

/// Bits of a number. The payload of a NaN is not promised: all have the bits of one.
fn bits(number: &f32) -> u32 {
    if number.is_nan() { f32::NAN.to_bits() } else { number.to_bits() }
}

/// A block of robots and the ground below them.
struct Run<'a> {
    robot: &'a Robot,
    contact: ContactSettings,
    terrain: Option<&'a HeightGrid>,
    link_forces: &'a [(usize, bool)],
    /// Control steps that are compared.
    steps: usize,
    /// The robots that read separate parameters: the last ones.
    separate: usize,
}

impl Run<'_> {
    /// Steps the robots and writes their arrays.
    fn write<W: Write>(
        &self,
        arrays: &mut Arrays<W>,
        mut states: Vec<State<f32>>,
        mut next_drive: impl FnMut(usize, &mut Drive<f32>),
        random: &mut Random,
    ) -> io::Result<()> {
        let Robot { topology, nominal, networks, .. } = self.robot;
        let settings = StepSettings { dt: 0.005, decimation: 4, gravity: [0.0, 0.0, -9.81], contact: self.contact };
        let heights = self.terrain.map(Heights::new);
        let scene = Scene { terrain: heights.as_ref(), networks, ages: 2, link_forces: self.link_forces };
        let mut block = Block::new(topology, &settings, &scene, ENVS).map_err(io::Error::other)?;
        block.share_parameters(nominal);
        let mut parameters: Vec<Parameters<f32>> = vec![nominal.clone(); ENVS];
        for env in ENVS - self.separate..ENVS {
            parameters[env].zip_with(nominal, |own, number| *own = number * (1.0 + 0.01 * random.next()));
            block.write_parameters(env, &parameters[env]);
        }
        let mut drives = vec![Drive::zeros(topology, scene.ages); ENVS];
        for drive in &mut drives {
            drive.link_forces = self.link_forces.iter().map(|&key| LinkForce::zero(key)).collect();
        }
        let origins: Vec<[f32; 2]> = (0..ENVS).map(|_| [random.next(), random.next()]).collect();
        let mut reports = vec![Report::zeros(topology, settings.decimation); ENVS];
        let empty = block.clone();
        let mut work = vec![Workspace::new(topology); ENVS];
        let mut memories = vec![vec![0.0; ActuatorNetwork::num_remembered_by(networks)]; ENVS];
        let mut features = Vec::new();
        states.iter().enumerate().for_each(|(env, state)| block.write_state(env, state));
        let capacity = block.shape().capacity;
        let Parts {
            integers, numbers, parameters: tiles, common, state, grid, work: scratch, work_integers, own, ..
        } = block.parts();
        let sizes = [ENVS, own as usize, scratch.len() / ENVS, work_integers.len() / ENVS, self.steps];
        let sizes = [sizes.as_slice(), &[STEPS_OF_DRIVE, capacity]].concat();
        arrays.integers("sizes", &sizes.iter().map(|&x| x as i32).collect::<Vec<_>>())?;
        arrays.integers("integers", integers)?;
        arrays.floats("numbers", numbers)?;
        arrays.floats("parameters", tiles)?;
        arrays.floats("common", common)?;
        arrays.floats("grid", grid)?;
        arrays.floats("state", state)?;
        let mut checksums = Vec::new();
        for step in 0..self.steps {
            if step % STEPS_OF_DRIVE == 0 {
                for (env, drive) in drives.iter_mut().enumerate() {
                    next_drive(env, drive);
                    block.write_drive(env, drive, origins[env]);
                }
                arrays.floats(&format!("drive.{}", step / STEPS_OF_DRIVE), block.parts().drive)?;
            }
            for env in 0..ENVS {
                // networks add to the drive of a control step
                let mut drive = drives[env].clone();
                let at_once = if networks.is_empty() { settings.decimation } else { 1 };
                for substep in (0..settings.decimation).step_by(at_once) {
                    if !networks.is_empty() {
                        NetworkStep {
                            topology,
                            settings: &settings,
                            networks,
                            substep,
                            state: &states[env],
                            drive: &mut drive,
                            memory: &mut memories[env],
                            features: &mut features,
                            work: &mut work[env],
                        }
                        .run();
                    }
                    ControlStep {
                        topology,
                        settings: &settings,
                        terrain: self.terrain.map(|grid| Terrain { grid, origin: &origins[env] }),
                        parameters: &parameters[env],
                        nominal: None,
                        drive: &drive,
                        substeps: substep..substep + at_once,
                        state: &mut states[env],
                        report: &mut reports[env],
                        work: &mut work[env],
                    }
                    .run();
                }
            }
            let mut expected = empty.clone();
            for (env, state) in states.iter().enumerate() {
                expected.write_state(env, state);
                expected.write_memory(env, &memories[env]);
                expected.write_report(env, &reports[env]);
            }
            let Parts { state, report, .. } = expected.parts();
            checksums.push(crc32(state.iter().map(bits)) as i32);
            checksums.push(crc32(report.iter().map(bits)) as i32);
            if step + 1 == self.steps {
                arrays.floats("last.state", state)?;
                arrays.floats("last.report", report)?;
            }
        }
        arrays.integers("checksums", &checksums)
    }

    /// Robots that fall onto the ground and move about on it.
    fn write_fall<W: Write>(&self, arrays: &mut Arrays<W>) -> io::Result<()> {
        let mut random = Random(self.robot.name.bytes().map(u64::from).sum());
        let states = (0..ENVS).map(|_| random_state(self.robot, &mut random)).collect();
        let mut commands = Random(random.0 ^ 1);
        self.write(arrays, states, |_, drive| randomise_drive(self.robot, drive, &mut commands), &mut random)
    }
}

fn main() -> io::Result<()> {
    let path = std::env::args().nth(1).unwrap_or_else(|| "target/reference.bin".to_owned());
    let mut arrays = Arrays { out: BufWriter::new(File::create(&path)?), prefix: String::new() };
    let contact = ContactSettings::default();
    for robot in library(true) {
        arrays.prefix = format!("plane/{}", robot.name);
        Run { robot: &robot, contact, terrain: None, link_forces: &[], steps: 50, separate: 4 }
            .write_fall(&mut arrays)?;
    }
    let grid = rough_ground(&mut Random(3));
    for (index, mut robot) in library(false).into_iter().enumerate() {
        robot.topology.friction = [ContactFriction::Sliding, ContactFriction::Rolling][index % 2];
        robot.nominal.rolling_friction = 0.01;
        arrays.prefix = format!("rough/{}", robot.name);
        Run { robot: &robot, contact, terrain: Some(&grid), link_forces: &[], steps: 50, separate: 0 }
            .write_fall(&mut arrays)?;
    }
    for mut robot in library(true) {
        let joints = robot.topology.num_joints();
        robot.topology.friction = ContactFriction::Torsional;
        robot.nominal.torsional_friction = 0.02;
        robot.nominal.restitution = 0.4;
        let contact = with_springs_on_a_slope(&mut robot);
        arrays.prefix = format!("slope/{}", robot.name);
        Run {
            robot: &robot,
            contact,
            terrain: None,
            link_forces: &[(0, true), (joints, false)],
            steps: 20,
            separate: 0,
        }
        .write_fall(&mut arrays)?;
    }
    for (index, mut robot) in library(true).into_iter().enumerate() {
        robot.topology.has_delay = true;
        with_networks(&mut robot, &mut Random(index as u64));
        arrays.prefix = format!("nets/{}", robot.name);
        Run { robot: &robot, contact, terrain: None, link_forces: &[], steps: 20, separate: 4 }
            .write_fall(&mut arrays)?;
    }
    for standing in reference_robots() {
        let robot = &standing.robot;
        for (scene, spread) in [("stand", 0.0), ("move", 0.3)] {
            let mut random = Random(robot.name.bytes().map(u64::from).sum());
            let mut state = State::zeros(&robot.topology);
            state.position[2] = standing.height;
            state.rotation = [1.0, 0.0, 0.0, 0.0];
            state.joint_position.copy_from_slice(&standing.position);
            let drive = |_, drive: &mut Drive<f32>| {
                let targets: Vec<f32> = standing.position.iter().map(|q| q + spread * random.next()).collect();
                drive.targets.iter_mut().for_each(|of_age| of_age.copy_from_slice(&targets));
            };
            arrays.prefix = format!("{scene}/{}", robot.name);
            Run { robot, contact, terrain: None, link_forces: &[], steps: 50, separate: 0 }.write(
                &mut arrays,
                vec![state; ENVS],
                drive,
                &mut Random(5),
            )?;
        }
    }
    arrays.out.flush()?;
    println!("{path}: {} bytes", std::fs::metadata(&path)?.len());
    Ok(())
}
