//! A passive double pendulum keeps its energy up to an error of first order in the step, and loses
//! it to joint damping at the rate that damping has.

use std::path::PathBuf;

use glam::{DMat3, DVec3};
use polypod::dynamics::{Dynamics, Parameters, Scalar, State, Topology, Workspace};
use polypod::robot::{Articulation, Joint, JointKind, Link, Model, Pose};

use crate::passive::move_freely;

const GRAVITY: [f64; 3] = [0.0, 0.0, -9.81];

/// Two rods of 0.5 m on a fixed base, the second one turning about a skew axis.
fn double_pendulum(damping: f64) -> Articulation {
    let rod = |name: &str, mass: f64| Link {
        name: name.into(),
        mass,
        com: DVec3::new(0.0, 0.0, -0.25),
        inertia: DMat3::from_diagonal(DVec3::new(mass / 48.0, mass / 48.0, mass * 1e-4)),
        merged: Vec::new(),
    };
    let joint = |name: &str, parent: usize, below: f64, axis: DVec3| Joint {
        name: name.into(),
        kind: JointKind::Continuous,
        parent,
        origin: Pose::from_translation(DVec3::new(0.0, 0.0, -below)),
        axis,
        lower: f64::NEG_INFINITY,
        upper: f64::INFINITY,
        effort: f64::INFINITY,
        velocity: f64::INFINITY,
        damping,
        friction: 0.0,
        armature: 0.002,
    };
    let model = Model {
        name: "double_pendulum".into(),
        source: PathBuf::new(),
        links: vec![rod("base", 1.0), rod("upper", 1.5), rod("lower", 0.7)],
        joints: vec![joint("shoulder", 0, 0.0, DVec3::Y), joint("elbow", 1, 0.5, DVec3::new(0.28, 0.96, 0.0))],
        bodies: Vec::new(),
        locked: Vec::new(),
        warnings: Vec::new(),
    };
    Articulation::new(&model, false, &[], None)
}

fn start(topology: &Topology) -> State<f64> {
    let mut state = State::zeros(topology);
    state.joint_position = vec![1.2, 0.5];
    state
}

fn energy(topology: &Topology, parameters: &Parameters<f64>, state: &State<f64>) -> f64 {
    let mut work = Workspace::new(topology);
    let (kinetic, potential) =
        f64::energy(&mut Dynamics { topology, parameters, state, gravity: GRAVITY, work: &mut work });
    kinetic + potential
}

#[test]
fn semi_implicit_euler_is_of_first_order() {
    let Articulation { topology, parameters, .. } = double_pendulum(0.0);
    let before = energy(&topology, &parameters, &start(&topology));
    let errors: Vec<f64> = (0..5)
        .map(|halvings| {
            let steps = 500 << halvings;
            let mut state = start(&topology);
            move_freely(&topology, &parameters, &mut state, GRAVITY, 1.0 / steps as f64, steps);
            energy(&topology, &parameters, &state) - before
        })
        .collect();
    let orders: Vec<f64> = errors.windows(2).map(|e| (e[0] / e[1]).abs().log2()).collect();
    println!("energy errors after 1 s {errors:?} J, orders {orders:.3?}");
    assert!(orders.iter().all(|order| (order - 1.0).abs() < 0.05), "{orders:?}, errors {errors:?}");
    // at 2 ms, of about 6.5 J that swing (measured: 0.017 J)
    assert!(errors[0].abs() < 0.05, "{errors:?}");
}

#[test]
fn damping_takes_what_it_should() {
    let damping = 0.05;
    let Articulation { topology, parameters, .. } = double_pendulum(damping);
    let balance = |steps: usize| {
        let mut state = start(&topology);
        let before = energy(&topology, &parameters, &state);
        let (dt, mut dissipated, mut last) = (2.0 / steps as f64, 0.0, before);
        for step in 1..=steps {
            move_freely(&topology, &parameters, &mut state, GRAVITY, dt, 1);
            dissipated += dt * damping * state.joint_velocity.iter().map(|v| v * v).sum::<f64>();
            if step % (steps / 10) == 0 {
                let now = energy(&topology, &parameters, &state);
                assert!(now < last, "gained energy at {} s", step as f64 * dt);
                last = now;
            }
        }
        (before - last, dissipated)
    };
    let [(coarse_lost, coarse), (lost, dissipated)] = [balance(2000), balance(4000)];
    let order = ((coarse_lost - coarse) / (lost - dissipated)).abs().log2();
    println!("lost {lost:.4} J, damping took {dissipated:.4} J, order of the difference {order:.3}");
    assert!(lost > 1.0, "lost {lost} J");
    assert!((lost - dissipated).abs() < 0.01 * lost, "lost {lost} J, damping took {dissipated} J");
    assert!((order - 1.0).abs() < 0.1, "order {order}");
}
