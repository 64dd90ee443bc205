//! Links of a robot that may touch each other do not pass through each other, and what pushes them
//! apart is internal.

use polypod::config::Library;
use polypod::dynamics::math::Spatial;
use polypod::dynamics::{
    ContactSettings, ControlStep, Drive, Parameters, Report, Scalar, State, StepSettings, Topology, Workspace,
};
use polypod::morphology::MorphologyModel;
use polypod::robot::Role;

use crate::common;

fn robot(name: &str) -> MorphologyModel {
    MorphologyModel::new(&Library::new(Vec::new()).robot(name).unwrap()).unwrap()
}

/// One robot in `f64`, floating in space.
struct Body {
    topology: Topology,
    parameters: Parameters<f64>,
    state: State<f64>,
    drive: Drive<f64>,
    report: Report<f64>,
    work: Workspace<f64>,
}

impl Body {
    fn new(robot: &MorphologyModel, self_collision: bool) -> Self {
        let mut topology = robot.topology.clone();
        if !self_collision {
            topology.set_pairs(topology.colliders.clone(), &[]);
        }
        let mut state = State::zeros(&topology);
        for (q, &start) in state.joint_position.iter_mut().zip(&robot.stance.default_position) {
            *q = f64::from(start);
        }
        Self {
            parameters: Parameters::from_scalars(&topology, &robot.nominal),
            state,
            drive: Drive::zeros(&topology, 2),
            report: Report::zeros(&topology, 1),
            work: Workspace::new(&topology),
            topology,
        }
    }

    fn step(&mut self) {
        let contact = ContactSettings { ground: None, ..ContactSettings::default() };
        let settings = StepSettings { dt: 0.005, decimation: 1, gravity: [0.0; 3], contact };
        ControlStep {
            topology: &self.topology,
            settings: &settings,
            terrain: None,
            parameters: &self.parameters,
            nominal: None,
            drive: &self.drive,
            substeps: 0..1,
            state: &mut self.state,
            report: &mut self.report,
            work: &mut self.work,
        }
        .run();
    }

    /// The deepest overlap of any pair of `pairs`, m.
    fn overlap(&mut self, pairs: &Topology) -> f64 {
        let still = vec![0.0; pairs.num_joints()];
        let mut work = Workspace::new(pairs);
        f64::forward_kinematics(
            pairs,
            &self.parameters,
            &self.state.joint_position,
            &still,
            &Spatial::zero(),
            &mut work,
        );
        f64::place_colliders(pairs, &self.parameters, &mut work);
        (0..pairs.pairs.len()).map(|p| -f64::pair_gap(pairs, &work, p)).fold(0.0, f64::max)
    }
}

/// Targets that cross the legs: redrawn every half second from the whole range of the joints.
fn random_target(body: &Body, seed: u64, step: usize, joint: usize) -> f64 {
    let (low, high) = (body.parameters.lower[joint].max(-3.0), body.parameters.upper[joint].min(3.0));
    low + (high - low) * 0.5 * (1.0 + f64::from(common::noise(seed, 0, step / 100, joint)))
}

/// The deepest overlap of all steps, and of those in which the links have had 0.4 s to come to
/// rest, m.
fn deepest(robot: &MorphologyModel, self_collision: bool, seed: u64) -> [f64; 2] {
    let mut body = Body::new(robot, self_collision);
    let mut deepest = [0.0f64; 2];
    for step in 0..2000 {
        for joint in 0..robot.topology.num_joints() {
            let target = random_target(&body, seed, step, joint);
            body.drive.targets.iter_mut().for_each(|targets| targets[joint] = target);
        }
        body.step();
        let overlap = body.overlap(&robot.topology);
        deepest[0] = deepest[0].max(overlap);
        if step % 100 >= 80 {
            deepest[1] = deepest[1].max(overlap);
        }
    }
    deepest
}

#[test]
fn links_stay_apart() {
    for name in common::ROBOTS {
        let robot = robot(name);
        if !robot.config.self_collisions {
            assert!(robot.topology.pairs.is_empty(), "{name} has pairs although its config wants none");
            continue;
        }
        let worst = |self_collision: bool| {
            (0..3)
                .map(|seed| deepest(&robot, self_collision, seed))
                .fold([0.0f64; 2], |worst, deepest| [worst[0].max(deepest[0]), worst[1].max(deepest[1])])
        };
        let (with, without) = (worst(true), worst(false));
        println!(
            "{name}: {} pairs; deepest overlap {:.1} mm, at rest {:.2} mm; without self-collision {:.1} and {:.1} mm",
            robot.topology.pairs.len(),
            1e3 * with[0],
            1e3 * with[1],
            1e3 * without[0],
            1e3 * without[1]
        );
        assert!(without[1] > 0.05, "{name}: the targets never make links meet");
        assert!(with[0] < 0.01, "{name}: links pass {} m into each other", with[0]);
        assert!(with[1] < 0.003, "{name}: links rest {} m inside each other", with[1]);
    }
}

#[test]
fn self_collision_changes_no_momentum() {
    let robot = robot("anymal_c");
    let mut body = Body::new(&robot, true);
    let mut hits = 0;
    for step in 0..1000 {
        for joint in 0..robot.topology.num_joints() {
            let target = random_target(&body, 1, step, joint);
            body.drive.targets.iter_mut().for_each(|targets| targets[joint] = target);
        }
        body.step();
        let net: [f64; 3] = std::array::from_fn(|i| body.report.body_force.iter().map(|force| force[i]).sum());
        let largest = body.report.normal_force[0].iter().copied().fold(0.0, f64::max);
        hits += usize::from(largest > 1.0);
        assert!(net.iter().all(|x| x.abs() < 1e-9 * (1.0 + largest)), "internal forces add up to {net:?} N");
    }
    assert!(hits > 20, "links met in {hits} steps only");
}

/// A thigh meets the trunk where the makers' rounded shells are, and not where the corners of a box
/// around them would be.
#[test]
fn thighs_swing_clear_of_the_trunk() {
    const INWARDS: f64 = 0.4; // rad
    for name in ["anymal_d", "anymal_c", "anymal_b"] {
        let robot = robot(name);
        for slot in robot.slots.iter().filter(|slot| slot.slot.role == Role::Haa) {
            let hip = slot.slot.to_string();
            let flexion = robot.slots.iter().find(|other| other.slot.to_string() == hip.replace("HAA", "HFE")).unwrap();
            for swing in [-0.4, 0.0, 0.4] {
                let mut body = Body::new(&robot, true);
                let inwards = if hip.starts_with('L') { -INWARDS } else { INWARDS };
                body.state.joint_position[slot.joint()] += f64::from(slot.sign) * inwards;
                body.state.joint_position[flexion.joint()] += swing;
                let overlap = body.overlap(&robot.topology);
                assert!(overlap == 0.0, "{name}: {hip} inwards by {INWARDS} rad and swung by {swing} rad, {overlap} m");
            }
        }
    }
}
