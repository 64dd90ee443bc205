//! The dynamics algorithms agree with one another, with the model's own kinematics and with numeric
//! derivatives, for the built-in robots and for random trees, in f32 and f64.
//!
//! `inverse_dynamics` is the independent witness: Newton's and Euler's equations in ordinary
//! vectors, link by link, share nothing with the mass matrix, its factors and the spatial algebra
//! of a step.

use glam::{DMat3, DQuat, DVec3};
use polypod::dynamics::{Dynamics, Scalar, State, Workspace};
use proptest::prelude::*;

use crate::common::size;
use crate::trees::{Case, ask, fixed_cases, largest, largest_difference, moving_robot, state_as, to_f64, tree};

const GRAVITY: [f64; 3] = [1.5, -2.0, -9.0];

/// `difference` is rounding at this `scale`.
fn close(what: &str, difference: f64, scale: f64, tolerance: f64) -> Result<(), TestCaseError> {
    prop_assert!(difference <= tolerance * scale, "{what}: {difference:e} at the scale {scale:e}");
    Ok(())
}

fn matrix_vector(m: &[f64], v: &[f64]) -> Vec<f64> {
    m.chunks_exact(v.len()).map(|row| row.iter().zip(v).map(|(a, b)| a * b).sum()).collect()
}

/// Magnitude of a sum of products before it cancels.
fn magnitude(m: &[f64], v: &[f64]) -> f64 {
    m.chunks_exact(v.len()).map(|row| row.iter().zip(v).map(|(a, b)| (a * b).abs()).sum()).fold(0.0, f64::max)
}

fn identities<S: Scalar>(case: &Case, tolerance: f64) -> Result<(), TestCaseError> {
    let topology = case.topology();
    let (parameters, state) = (case.parameters_as::<S>(), case.state_as::<S>());
    let mut work = Workspace::new(topology);
    let body = &mut Dynamics { topology, parameters: &parameters, state: &state, gravity: GRAVITY, work: &mut work };
    let nv = Dynamics::<S>::num_dofs(topology);
    prop_assert_eq!(nv, case.force.len());
    let force: Vec<S> = case.force.iter().map(|&x| S::splat(x)).collect();
    let qvel = case.qvel();

    let m = to_f64(&S::mass_matrix(body));
    let bias = to_f64(&S::bias_force(body));
    let caused = S::forward_dynamics(body, &force);
    let factor = &body.work.factor;
    let base_diagonal = if topology.floating { &factor.base_root[..] } else { &[] };
    let mut diagonal = factor.root.iter().chain(base_diagonal).flatten().map(|d| d.lane(0));
    prop_assert!(diagonal.all(|d| d > 0.0 && d.is_finite()), "the mass matrix is not positive definite");
    let force = to_f64(&force);

    // rounding is relative to the terms of the equation of motion, which may cancel
    let scale = magnitude(&m, &to_f64(&caused)) + largest(&bias) + largest(&force);
    let back = to_f64(&S::inverse_dynamics(body, &caused));
    close("RNEA(ABA(force)) = force", largest_difference(&back, &force), scale, tolerance)?;
    let sum: Vec<f64> = matrix_vector(&m, &to_f64(&caused)).iter().zip(&bias).map(|(a, b)| a + b).collect();
    close("M qacc + bias = force", largest_difference(&sum, &force), scale, tolerance)?;

    let zero = vec![S::zero(); nv];
    let still = to_f64(&S::inverse_dynamics(body, &zero));
    close("bias = RNEA(0)", largest_difference(&still, &bias), largest(&bias), tolerance)?;
    let columns: Vec<Vec<f64>> = (0..nv)
        .map(|i| {
            let mut unit = zero.clone();
            unit[i] = S::one();
            let moved = to_f64(&S::inverse_dynamics(body, &unit));
            moved.iter().zip(&still).map(|(a, b)| a - b).collect()
        })
        .collect();
    let scale = largest(&m) + largest(&bias);
    for i in 0..nv {
        let column: Vec<f64> = (0..nv).map(|r| m[r * nv + i]).collect();
        close("column of M = RNEA difference", largest_difference(&columns[i], &column), scale, tolerance)?;
        for r in 0..nv {
            prop_assert_eq!(m[r * nv + i], m[i * nv + r]);
        }
    }

    // momentum and kinetic energy by the mass matrix
    let with_rotors = matrix_vector(&m, &qvel);
    let (kinetic, _) = S::energy(body);
    let by_matrix = 0.5 * with_rotors.iter().zip(&qvel).map(|(p, v)| p * v).sum::<f64>();
    let scale = magnitude(&m, &qvel) * qvel.iter().map(|v| v.abs()).sum::<f64>();
    close("2 T = qvel M qvel", (kinetic.lane(0) - by_matrix).abs(), scale, tolerance)?;
    if topology.floating {
        let (linear, angular) = S::momentum(body);
        let (linear, angular) =
            (DVec3::from_array(linear.map(|x| x.lane(0))), DVec3::from_array(angular.map(|x| x.lane(0))));
        let [w, x, y, z] = state.rotation.map(|x| x.lane(0));
        let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w));
        let arm = DVec3::from_array(S::center_of_mass(body).map(|x| x.lane(0)))
            - DVec3::from_array(state.position.map(|x| x.lane(0)));
        let about_base = rotation.transpose() * (angular + arm.cross(linear));
        let mut momentum = linear.to_array().to_vec();
        momentum.extend(about_base.to_array());
        close("momentum", largest_difference(&momentum, &with_rotors[..6]), magnitude(&m, &qvel), tolerance)?;
    }

    // links: the last one, and a few on the way
    for link in (0..topology.num_links()).rev().step_by(7) {
        let point = [0.1, -0.2, 0.3].map(S::splat);
        let jacobian = to_f64(&S::jacobian(body, link, &[S::zero(); 3]));
        let (linear, angular) = S::link_velocity(body, link);
        let velocity = to_f64(&[linear, angular].concat());
        let scale = magnitude(&jacobian, &qvel) + 1e-3;
        close(
            "J qvel = link velocity",
            largest_difference(&matrix_vector(&jacobian, &qvel), &velocity),
            scale,
            tolerance,
        )?;
        let jacobian = to_f64(&S::jacobian(body, link, &point));
        let (_, rotation) = S::link_pose(body, link);
        let rotation = DMat3::from_cols_array_2d(&rotation.map(|row| row.map(|x| x.lane(0)))).transpose();
        let arm = rotation * DVec3::from_array(point.map(|x| x.lane(0)));
        let carried = DVec3::from_slice(&velocity) + DVec3::from_slice(&velocity[3..]).cross(arm);
        let difference = largest_difference(&matrix_vector(&jacobian, &qvel)[..3], &carried.to_array());
        close("J qvel = velocity of a link's point", difference, magnitude(&jacobian, &qvel) + 1e-3, tolerance)?;
    }
    Ok(())
}

/// The state after a time `t` of uniform motion at the present `qvel`.
fn moved(case: &Case, qvel: &[f64], t: f64) -> State<f64> {
    let mut state = state_as::<f64>(case.topology(), &case.state);
    let joints = if case.topology().floating {
        let [w, x, y, z] = state.rotation;
        let turn = DQuat::from_scaled_axis(DVec3::from_slice(&qvel[3..6]) * t);
        let q = DQuat::from_xyzw(x, y, z, w) * turn;
        state.rotation = [q.w, q.x, q.y, q.z];
        for i in 0..3 {
            state.position[i] += qvel[i] * t;
        }
        &qvel[6..]
    } else {
        qvel
    };
    for (q, v) in state.joint_position.iter_mut().zip(joints) {
        *q += v * t;
    }
    state
}

/// Central difference of fourth order.
fn derivative<const N: usize>(step: f64, f: impl Fn(f64) -> [f64; N]) -> [f64; N] {
    let [a, b, c, d] = [f(-2.0 * step), f(-step), f(step), f(2.0 * step)];
    std::array::from_fn(|i| (a[i] - d[i] + 8.0 * (c[i] - b[i])) / (12.0 * step))
}

fn derivatives(case: &Case) -> Result<(), TestCaseError> {
    let topology = case.topology();
    let parameters = &case.articulation.parameters;
    let qvel = case.qvel();
    // the error of the difference is (rate x step)^4 / 30 plus rounding over rate x step: best near
    // 1e-3
    let rate: f64 = 1.0 + qvel.iter().map(|v| v.abs()).sum::<f64>();
    let step = 1e-3 / rate;
    let pose = |link: usize, t: f64| {
        let (position, r) =
            ask(topology, parameters, &moved(case, &qvel, t), GRAVITY, |body| f64::link_pose(body, link));
        (position, DMat3::from_cols_array_2d(&r).transpose())
    };
    for link in (0..topology.num_links()).rev().step_by(7) {
        let (linear, angular) = ask(topology, parameters, &case.state, GRAVITY, |body| f64::link_velocity(body, link));
        let by_difference = derivative(step, |t| pose(link, t).0);
        let reach = largest(&pose(link, 0.0).0) + 1.0;
        close(
            "d position / dt = link velocity",
            largest_difference(&by_difference, &linear),
            rate * reach,
            DERIVATIVE,
        )?;
        let spin = derivative(step, |t| pose(link, t).1.to_cols_array());
        let spin = DMat3::from_cols_array(&spin) * pose(link, 0.0).1.transpose();
        let by_difference = [spin.y_axis.z, spin.z_axis.x, spin.x_axis.y];
        close("d rotation / dt = angular velocity", largest_difference(&by_difference, &angular), rate, DERIVATIVE)?;
    }

    // the model's kinematics, in the URDF's frames
    let [w, x, y, z] = case.state.rotation;
    let base = polypod::robot::Pose {
        rotation: DMat3::from_quat(DQuat::from_xyzw(x, y, z, w)),
        translation: DVec3::from_array(case.state.position),
    };
    for (link, expected) in case.model.forward_kinematics(&case.state.joint_position).into_iter().enumerate() {
        let expected = base * expected;
        let (position, rotation) = pose(link, 0.0);
        let rotation = rotation * case.articulation.align[link];
        prop_assert!(
            (DVec3::from_array(position) - expected.translation).length() < 1e-12 * (topology.num_links() as f64)
        );
        prop_assert!(rotation.abs_diff_eq(expected.rotation, 1e-12 * topology.num_links() as f64));
    }

    // at rest the bias force is the gradient of the potential energy
    let mut rest = case.clone();
    rest.state.linear_velocity = [0.0; 3];
    rest.state.angular_velocity = [0.0; 3];
    rest.state.joint_velocity.fill(0.0);
    let gravity_force = ask(topology, parameters, &rest.state, GRAVITY, f64::bias_force);
    let (_, potential) = ask(topology, parameters, &rest.state, GRAVITY, f64::energy);
    let scale = largest(&gravity_force) + potential.abs();
    for i in 0..gravity_force.len() {
        let mut unit = vec![0.0; gravity_force.len()];
        unit[i] = 1.0;
        let [slope] =
            derivative(1e-3, |t| [ask(topology, parameters, &moved(&rest, &unit, t), GRAVITY, f64::energy).1]);
        close("dV / dq = bias at rest", (slope - gravity_force[i]).abs(), scale, DERIVATIVE)?;
    }

    // the work of the applied force is the change of energy
    let qacc = ask(topology, parameters, &case.state, GRAVITY, |body| f64::forward_dynamics(body, &case.force));
    let rate = rate + qacc.iter().map(|a| a.abs().sqrt()).sum::<f64>();
    let [power] = derivative(1e-3 / rate, |t| {
        let mean: Vec<f64> = qvel.iter().zip(&qacc).map(|(v, a)| v + 0.5 * t * a).collect();
        let mut state = moved(case, &mean, t);
        let end: Vec<f64> = qvel.iter().zip(&qacc).map(|(v, a)| v + t * a).collect();
        let joints = if topology.floating {
            state.linear_velocity = [end[0], end[1], end[2]];
            state.angular_velocity = [end[3], end[4], end[5]];
            &end[6..]
        } else {
            &end[..]
        };
        state.joint_velocity.copy_from_slice(joints);
        let (kinetic, potential) = ask(topology, parameters, &state, GRAVITY, f64::energy);
        [kinetic + potential]
    });
    let given: f64 = case.force.iter().zip(&qvel).map(|(f, v)| f * v).sum();
    let (kinetic, potential) = ask(topology, parameters, &case.state, GRAVITY, f64::energy);
    let scale = (kinetic + potential.abs()) * rate + largest(&case.force) * rate;
    close("power of the force = d energy / dt", (power - given).abs(), scale, DERIVATIVE)
}

/// Rounding may add up along the longest chain: one unit roundoff for each of 64 links, relative to
/// the size of the terms before they cancel. (Measured: 17 in f32, 12 in f64.)
const F32: f64 = 64.0 * f32::EPSILON as f64 / 2.0;
/// See `F32`.
const F64: f64 = 64.0 * f64::EPSILON / 2.0;
/// Numeric derivatives are good to this, relative to the size of what is differentiated times its
/// rate.
const DERIVATIVE: f64 = 1e-10;

proptest! {
    #![proptest_config(fixed_cases(size(128, 1280)))]

    #[test]
    fn trees_in_f64(case in tree(1..=64, any::<bool>())) {
        identities::<f64>(&case, F64)?;
    }

    #[test]
    fn trees_in_f32(case in tree(1..=64, any::<bool>())) {
        identities::<f32>(&case, F32)?;
    }

    #[test]
    fn robots_in_f64(case in moving_robot()) {
        identities::<f64>(&case, F64)?;
    }

    #[test]
    fn robots_in_f32(case in moving_robot()) {
        identities::<f32>(&case, F32)?;
    }

    #[test]
    fn trees_move_at_their_velocity(case in tree(1..=64, any::<bool>())) {
        derivatives(&case)?;
    }

    #[test]
    fn robots_move_at_their_velocity(case in moving_robot()) {
        derivatives(&case)?;
    }
}
