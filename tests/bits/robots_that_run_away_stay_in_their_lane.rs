//! A robot in a pack does what it does alone, bit for bit, however fast it runs away and whatever
//! its neighbours do: what is done to a lane because another lane needs it changes nothing, at any
//! speed.

use polypod::config::Library;
use polypod::dynamics::lanes::Simd;
use polypod::dynamics::{
    ContactSettings, ControlStep, Drive, Kernels, Parameters, Report, State, StepSettings, Topology, WithKernels,
    Workspace, with_kernels,
};
use polypod::morphology::MorphologyModel;

use crate::common::noise;

const STEPS: usize = 8;
const DECIMATION: usize = 2;

/// Simulation of one body, and the place where its joints begin.
struct Body {
    topology: Topology,
    parameters: Parameters<f32>,
    stance: Vec<f32>,
}

fn spot() -> Body {
    let robot = MorphologyModel::new(&Library::new(Vec::new()).robot("spot").unwrap()).unwrap();
    let parameters = Parameters::from_scalars(&robot.topology, &robot.nominal);
    Body { topology: robot.topology.clone(), parameters, stance: robot.stance.default_position.to_vec() }
}

/// A robot near the ground whose base and joints move about this fast.
fn start(body: &Body, seed: u64, env: usize, speed: f32) -> State<f32> {
    let mut state = State::zeros(&body.topology);
    let mut slot = 0;
    let mut draw = || {
        slot += 1;
        noise(seed, env, 0, slot)
    };
    state.position = [draw(), draw(), 0.1f32.mul_add(draw(), 0.5)];
    let q = [1.0, 0.3 * draw(), 0.3 * draw(), draw()];
    let norm = q.iter().map(|x| x * x).sum::<f32>().sqrt();
    state.rotation = q.map(|x| x / norm);
    state.linear_velocity = [(); 3].map(|()| speed * draw());
    state.angular_velocity = [(); 3].map(|()| speed * draw());
    for (j, &position) in body.stance.iter().enumerate() {
        state.joint_position[j] = 0.3f32.mul_add(draw(), position);
        state.joint_velocity[j] = speed * draw();
    }
    state
}

struct Pack<L: Kernels> {
    parameters: Parameters<L>,
    drive: Drive<L>,
    state: State<L>,
    report: Report<L>,
    work: Workspace<L>,
}

impl<L: Kernels> Pack<L> {
    /// Lane `i` begins as `of(i)`.
    fn new<'a>(body: &Body, of: impl Fn(usize) -> &'a State<f32>) -> Self {
        let topology = &body.topology;
        let mut drive = Drive::zeros(topology, 2);
        for targets in &mut drive.targets {
            targets.iter_mut().zip(&body.stance).for_each(|(x, &q)| *x = L::splat(f64::from(q)));
        }
        let mut state = State::zeros(topology);
        for lane in 0..L::LANES {
            let from = of(lane);
            let lists: [(&mut [L], &[f32]); 6] = [
                (&mut state.position, &from.position),
                (&mut state.rotation, &from.rotation),
                (&mut state.linear_velocity, &from.linear_velocity),
                (&mut state.angular_velocity, &from.angular_velocity),
                (&mut state.joint_position, &from.joint_position),
                (&mut state.joint_velocity, &from.joint_velocity),
            ];
            for (to, from) in lists {
                to.iter_mut().zip(from).for_each(|(to, &from)| to.set_lane_f32(lane, from));
            }
        }
        Self {
            parameters: Parameters::from_scalars(topology, &body.parameters),
            drive,
            state,
            report: Report::zeros(topology, DECIMATION),
            work: Workspace::new(topology),
        }
    }

    fn step(&mut self, topology: &Topology, settings: &StepSettings) {
        ControlStep {
            topology,
            settings,
            terrain: None,
            parameters: &self.parameters,
            nominal: None,
            drive: &self.drive,
            substeps: 0..settings.decimation,
            state: &mut self.state,
            report: &mut self.report,
            work: &mut self.work,
        }
        .run();
    }

    /// All that a step leaves in a lane. IEEE 754 leaves the bits of a NaN open: all of them are
    /// one.
    fn bits(&self, lane: usize) -> Vec<u32> {
        let Self { state, report, .. } = self;
        let lists = [
            &state.position,
            &state.rotation[..],
            &state.linear_velocity,
            &state.angular_velocity,
            &state.joint_position,
            &state.joint_velocity,
            state.impulse.as_flattened(),
            &state.bound_impulse,
            &report.joint_effort,
            &report.joint_acceleration,
            report.body_force.as_flattened(),
            &report.demands,
            report.site_position.as_flattened(),
            report.site_velocity.as_flattened(),
        ];
        let numbers = lists.into_iter().chain(report.normal_force.iter().map(|force| &force[..])).flatten();
        numbers.map(|x| x.lane_f32(lane)).map(|x| if x.is_nan() { f32::NAN.to_bits() } else { x.to_bits() }).collect()
    }
}

/// Steps robots at many speeds in packs and alone, in a pack of nothing but themselves, even beyond
/// the step that breaks them; how many broke.
fn step_packed_and_alone<L: Kernels>(body: &Body, name: &str) -> usize {
    let mut broken = 0;
    for gravity in [-9.81, -1e6] {
        for magnitude in [-1, 1, 2, 3, 4, 5, 6, 7, 9, 12, 18, 24, 30, 36] {
            let seed = 3;
            let speed = 10f32.powi(magnitude);
            let settings = StepSettings {
                dt: 0.005,
                decimation: DECIMATION,
                gravity: [0.0, 0.0, gravity],
                contact: ContactSettings::default(),
            };
            // every fourth robot is healthy, and its links and joints are near other things than
            // its neighbours'
            let starts: Vec<_> =
                (0..L::LANES).map(|i| start(body, seed, i, if i % 4 == 3 { 0.3 } else { speed })).collect();
            let mut pack = Pack::<L>::new(body, |lane| &starts[lane]);
            let mut alone: Vec<_> = starts.iter().map(|start| Pack::<L>::new(body, |_| start)).collect();
            for step in 0..STEPS {
                pack.step(&body.topology, &settings);
                for (lane, alone) in alone.iter_mut().enumerate() {
                    alone.step(&body.topology, &settings);
                    let bits = alone.bits(lane);
                    let what = format!("{name}, gravity {gravity}, speed {speed:e}, step {step}, lane {lane}");
                    assert!(bits == alone.bits(0), "{what}: the lane matters");
                    assert!(bits == pack.bits(lane), "{what}: the neighbours matter");
                    broken += usize::from(step + 1 == STEPS && bits.contains(&f32::NAN.to_bits()));
                }
            }
        }
    }
    broken
}

struct PackedAndAlone<'a>(&'a Body, &'a str);

impl WithKernels for PackedAndAlone<'_> {
    type Output = usize;

    fn run<L: Kernels>(self) -> usize {
        step_packed_and_alone::<L>(self.0, self.1)
    }
}

#[test]
fn neighbours_change_nothing_at_any_speed() {
    let body = spot();
    for simd in Simd::available() {
        let broken = with_kernels(simd.token().unwrap(), PackedAndAlone(&body, simd.name()));
        assert!(broken > 50, "only {broken} robots of {} ran away to the end", simd.name());
    }
}
