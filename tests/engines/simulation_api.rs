//! `Simulation` from Rust: shapes, errors, and a state that is what was set.

use std::path::{Path, PathBuf};

use polypod::config::ConfigErrorKind;
use polypod::simulation::Precision;
use polypod::{Control, Error, Simulation, SimulationOptions};

fn urdf(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/urdf").join(format!("{name}.urdf"))
}

fn options(name: &str, num_envs: usize) -> SimulationOptions {
    SimulationOptions::new(urdf(name).display().to_string(), num_envs)
}

fn simulation(name: &str, num_envs: usize) -> Simulation {
    Simulation::new(&options(name, num_envs)).unwrap()
}

fn stand() -> Control<'static> {
    Control { targets: Some(&[0.0]), kp: Some(&[300.0]), kd: Some(&[8.0]), ..Control::default() }
}

#[test]
fn arrays_have_one_row_per_env() {
    let mut sim = simulation("biped", 5);
    sim.step(&stand(), 3).unwrap();
    assert_eq!((sim.num_joints(), sim.num_links(), sim.nq(), sim.nv()), (6, 7, 13, 12));
    assert_eq!((sim.qpos().len(), sim.qvel().len()), (5 * 13, 5 * 12));
    assert_eq!((sim.contact_forces().len(), sim.joint_torque().len()), (5 * 7 * 3, 5 * 6));
    let (poses, velocities) = (sim.link_pose(), sim.link_velocity());
    assert_eq!((poses.position.len(), poses.quaternion.len()), (5 * 7 * 3, 5 * 7 * 4));
    assert_eq!((velocities.linear.len(), velocities.angular.len()), (5 * 7 * 3, 5 * 7 * 3));
    assert_eq!((sim.mass_matrix().len(), sim.bias_force().len()), (5 * 12 * 12, 5 * 12));
    assert_eq!(sim.jacobian("left_foot", [0.0; 3]).unwrap().len(), 5 * 6 * 12);
    assert_eq!(sim.time(), 3.0 * sim.dt());
}

#[test]
fn one_row_serves_all_envs() {
    let mut sim = simulation("biped", 4);
    let mut row = sim.default_qpos().to_vec();
    row[2] = 3.0;
    sim.set_state(None, Some(&row), None).unwrap();
    sim.set_state(Some(&[1, 3]), None, Some(&[0.5; 12])).unwrap();
    assert!(sim.qpos().chunks(13).all(|q| q[2] == 3.0));
    let speeds: Vec<f64> = sim.qvel().chunks(12).map(|v| v[0]).collect();
    assert_eq!(speeds, [0.0, 0.5, 0.0, 0.5]);
}

#[test]
fn wrong_arguments_are_named() {
    let mut sim = simulation("biped", 2);
    let message = |error: Error| error.to_string();
    let error = message(sim.set_state(None, Some(&[0.0; 12]), None).unwrap_err());
    assert!(error.contains("qpos: 12 numbers") && error.contains("2 x 13"), "{error}");
    let error = message(sim.step(&Control { torque: Some(&[0.0; 5]), ..Control::default() }, 1).unwrap_err());
    assert!(error.contains("torque: 5 numbers"), "{error}");
    let both = Control { torque: Some(&[0.0]), ..stand() };
    assert!(message(sim.step(&both, 1).unwrap_err()).contains("pass one of them"));
    let error = message(sim.set_gains(Some(&[2]), Some(&[1.0]), None).unwrap_err());
    assert!(error.contains("no env 2"), "{error}");
    match sim.set_mass(None, "left_fot", &[1.0]).unwrap_err() {
        Error::Config(error) => {
            assert_eq!(error.kind, ConfigErrorKind::UnknownName);
            assert!(error.remedy.contains("left_foot"), "{error}");
        }
        other => panic!("{other}"),
    }
    let unknown = Simulation::new(&SimulationOptions::new("no_such_robot", 1)).err().unwrap();
    assert!(matches!(unknown, Error::Config(_)), "{unknown}");
    let missing = Simulation::new(&options("no_such_file", 1)).err().unwrap();
    assert!(matches!(missing, Error::Robot(_)), "{missing}");
}

#[test]
fn a_snapshot_belongs_to_its_simulation() {
    let mut sim = simulation("biped", 3);
    sim.set_gains(Some(&[1]), Some(&[200.0]), Some(&[9.0])).unwrap();
    sim.step(&stand(), 50).unwrap();
    let snapshot = sim.snapshot().unwrap();
    let mut other = Simulation::new(&SimulationOptions { threads: Some(1), ..options("biped", 3) }).unwrap();
    other.restore(&snapshot).unwrap();
    for sim in [&mut sim, &mut other] {
        sim.step(&Control { targets: Some(&[0.1]), ..Control::default() }, 50).unwrap();
    }
    assert!(sim.snapshot().unwrap() == other.snapshot().unwrap());
    let double = SimulationOptions { precision: Precision::Double, ..options("biped", 3) };
    for options in [options("biped", 4), options("cart", 3), double] {
        let error = Simulation::new(&options).unwrap().restore(&snapshot).unwrap_err();
        assert!(matches!(error, Error::Snapshot(_)), "{error}");
    }
}

#[test]
fn numbers_given_again_change_no_bit() {
    let make = || Simulation::new(&SimulationOptions::new("unitree_a1", 20)).unwrap();
    let mut sims = [make(), make()];
    // from here on each env has a separate value
    let limits = sims[1].effort_limit();
    sims[1].set_effort_limit(None, &limits).unwrap();
    for t in 0..200 {
        let targets: Vec<f64> = (0..20 * 12).map(|i| f64::sin(0.1 * f64::from(t) + f64::from(i))).collect();
        let [(plain, plain_torque), (given, given_torque)] = sims.each_mut().map(|sim| {
            sim.step(&Control { targets: Some(&targets), ..Control::default() }, 1).unwrap();
            (sim.qpos(), sim.joint_torque())
        });
        assert!(plain == given && plain_torque == given_torque, "step {t}");
    }
    assert!(sims[0].contact_forces().iter().any(|&force| force != 0.0));
    assert!(sims[0].joint_torque().iter().any(|&torque| torque != 0.0));
}

#[test]
fn a_fixed_base_has_joints_only_and_feels_no_ground() {
    let fixed = SimulationOptions { fixed_base: true, ..options("biped", 1) };
    let mut sim = Simulation::new(&fixed).unwrap();
    assert!(!sim.is_floating());
    assert_eq!((sim.nq(), sim.nv()), (6, 6));
    sim.step(&Control::default(), 1).unwrap();
    // the torso reaches through the ground, which does not matter to what cannot move; the legs do
    // feel it
    let forces = sim.contact_forces();
    assert_eq!(forces[..3], [0.0; 3]);
    assert!(forces[3..].iter().any(|&f| f != 0.0));
}

#[test]
fn forces_may_be_given_per_joint_or_per_degree_of_freedom() {
    let sim = simulation("biped", 2);
    let torque = [1.0, -2.0, 3.0, -4.0, 5.0, -6.0];
    let full: Vec<f64> = [0.0; 6].into_iter().chain(torque).collect();
    let of_joints = sim.forward_dynamics(&torque).unwrap();
    assert_eq!(of_joints, sim.forward_dynamics(&full).unwrap());
    assert_eq!(of_joints, sim.forward_dynamics(&full.repeat(2)).unwrap());
    let back = sim.inverse_dynamics(&of_joints).unwrap();
    for (found, expected) in back.iter().zip(full.iter().cycle()) {
        assert!((found - expected).abs() < 1e-9, "{found} is not {expected}");
    }
}

#[test]
fn numbers_that_cannot_be_computed_with_are_named() {
    let error = |options: SimulationOptions| Simulation::new(&options).err().unwrap().to_string();
    for normal in [[1e-300, 0.0, 0.0], [1e300, 1e300, 0.0]] {
        let message = error(SimulationOptions { ground: Some(normal), ..options("biped", 1) });
        assert!(message.starts_with("ground_normal: "), "{message}");
    }
    let message = error(SimulationOptions { dt: 1e-320, ..options("biped", 1) });
    assert!(message.starts_with("dt: ") && message.contains("1e-6"), "{message}");
}
