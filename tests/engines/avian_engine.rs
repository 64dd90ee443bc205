//! The engine `avian`: robots stand, survive rough handling, and move as the articulated engine has
//! them; bits depend on nothing but the state.

use polypod::config::Library;
use polypod::dynamics::math::Spatial;
use polypod::dynamics::{Parameters, Scalar, Workspace};
use polypod::morphology::MorphologyModel;
use polypod::simulation::Precision;
use polypod::{Control, Simulation, SimulationOptions};

use crate::common::{ROBOTS, noise, size};

const GRAVITY: f64 = 9.81;

fn options(robot: &str, engine: &str, num_envs: usize) -> SimulationOptions {
    SimulationOptions { engine: engine.into(), threads: Some(1), ..SimulationOptions::new(robot, num_envs) }
}

fn simulation(robot: &str, engine: &str) -> Simulation {
    Simulation::new(&options(robot, engine, 1)).unwrap()
}

/// The default joint positions.
fn stance(sim: &Simulation) -> Vec<f64> {
    sim.default_qpos()[sim.nq() - sim.num_joints()..].to_vec()
}

fn hold(targets: &[f64]) -> Control<'_> {
    Control { targets: Some(targets), ..Control::default() }
}

fn most(values: impl IntoIterator<Item = f64>) -> f64 {
    values.into_iter().map(f64::abs).fold(0.0, f64::max)
}

fn is_finite(sim: &Simulation) -> bool {
    sim.qpos().iter().chain(&sim.qvel()).chain(&sim.joint_torque()).chain(&sim.contact_forces()).all(|x| x.is_finite())
}

/// z component of the base's z axis.
fn upright(sim: &Simulation) -> f64 {
    let q = sim.qpos();
    1.0 - 2.0 * (q[4] * q[4] + q[5] * q[5])
}

#[test]
fn every_robot_stands_for_ten_seconds() {
    let mut failures = Vec::new();
    for robot in ROBOTS {
        let [mut avian, mut articulated] = ["avian", "articulated"].map(|engine| simulation(robot, engine));
        let targets = stance(&avian);
        let mut drift: f64 = 0.0;
        for _ in 0..200 {
            avian.step(&hold(&targets), 10).unwrap();
            drift = drift.max(avian.link_drift()[0]);
        }
        articulated.step(&hold(&targets), 2000).unwrap();
        let weight = avian.total_mass() * GRAVITY;
        let up: f64 = avian.contact_forces().chunks(3).map(|f| f[2]).sum();
        let (ours, theirs) = (avian.joint_torque(), articulated.joint_torque());
        let off = most(ours.iter().zip(&theirs).map(|(a, b)| a - b)) / most(theirs.iter().copied());
        let (q, p) = (avian.qpos(), articulated.qpos());
        let joints = most((7..q.len()).map(|i| q[i] - p[i]));
        let speed = most(avian.qvel()[..3].iter().copied());
        println!(
            "{robot:<12} force/weight {:.5}, height {:.4} ({:+.4}) m, upright {:.5}, drift {:.3} mm, torque off {:.2} % of {:.2} N m, joints off {joints:.5} rad, speed {speed:.5} m/s, moved {:.2} {:.2} mm (articulated {:.2} {:.2} mm)",
            up / weight,
            q[2],
            q[2] - p[2],
            upright(&avian),
            1e3 * drift,
            1e2 * off,
            most(theirs.iter().copied()),
            1e3 * q[0],
            1e3 * q[1],
            1e3 * p[0],
            1e3 * p[1],
        );
        let mut check = |holds: bool, what: &str| {
            if !holds {
                failures.push(format!("{robot}: {what}"));
            }
        };
        check(is_finite(&avian), "not finite");
        check(upright(&avian) > 0.98, "not upright");
        check((up / weight - 1.0).abs() < 0.02, "forces do not add up to the weight");
        check(drift < 1e-3, "joints come apart");
        // joints that dry friction holds stop anywhere within it, and this robot's is 4 % of its
        // largest torque
        let dry_friction = if robot == "unitree_a1" { 0.2 } else { 0.0 };
        let bound = 0.03 + dry_friction / most(theirs.iter().copied());
        check(off < bound, "torques are not those of the articulated engine");
    }
    assert!(failures.is_empty(), "{failures:#?}");
}

#[test]
fn every_robot_survives_a_drop_and_random_targets() {
    for robot in ROBOTS {
        let mut sim = simulation(robot, "avian");
        let targets = stance(&sim);
        let mut start = sim.default_qpos().to_vec();
        start[2] += 0.5;
        sim.set_state(None, Some(&start), None).unwrap();
        let (mut drift, mut fastest) = (0.0_f64, 0.0_f64);
        for step in 0..size(1000, 10_000) {
            let moved: Vec<f64> =
                (0..targets.len()).map(|j| targets[j] + 0.6 * f64::from(noise(3, 0, step, j))).collect();
            let asked = if step < 50 { &targets } else { &moved };
            sim.step(&hold(asked), 4).unwrap();
            assert!(is_finite(&sim), "{robot}: step {step}");
            drift = drift.max(sim.link_drift()[0]);
            fastest = fastest.max(most(sim.qvel()));
        }
        let height = sim.qpos()[2];
        println!(
            "{robot:<12} drift {:.2} mm, fastest {fastest:.1}, height {height:.3} m, upright {:.3}",
            1e3 * drift,
            upright(&sim)
        );
        assert!(height > -0.05 && height < 2.0, "{robot}: {height}");
    }
}

/// Largest difference of joint positions while one joint follows a step of 0.1 rad with the base
/// fixed in the air.
fn step_response(robot: &str, joint: usize) -> (f64, f64) {
    let [mut avian, mut articulated] = ["avian", "articulated"].map(|engine| {
        let options = SimulationOptions { fixed_base: true, ground: None, ..options(robot, engine, 1) };
        Simulation::new(&options).unwrap()
    });
    let targets = stance(&avian);
    for sim in [&mut avian, &mut articulated] {
        sim.step(&hold(&targets), 400).unwrap();
    }
    let rest = most(avian.qpos().iter().zip(&articulated.qpos()).map(|(a, b)| a - b));
    let mut targets = targets;
    targets[joint] += 0.1;
    let mut off: f64 = 0.0;
    for _ in 0..200 {
        for sim in [&mut avian, &mut articulated] {
            sim.step(&hold(&targets), 1).unwrap();
        }
        off = off.max(most(avian.qpos().iter().zip(&articulated.qpos()).map(|(a, b)| a - b)));
    }
    (rest, off)
}

/// Bound for a step of 0.1 rad.
const STEP_BOUND: f64 = 0.01;

#[test]
fn a_step_of_a_joint_is_followed_as_in_the_articulated_engine() {
    let mut failures = Vec::new();
    for robot in ROBOTS {
        for joint in 0..3 {
            let (rest, off) = step_response(robot, joint);
            println!("{robot:<12} joint {joint}: at rest {rest:.6} rad, at most {off:.5} rad off");
            if rest > 1e-3 || off > STEP_BOUND {
                failures.push(format!("{robot} joint {joint}: {rest} {off}"));
            }
        }
    }
    assert!(failures.is_empty(), "{failures:#?}");
}

fn bits(sim: &Simulation) -> Vec<u64> {
    [sim.qpos(), sim.qvel(), sim.joint_torque(), sim.contact_forces()].concat().iter().map(|x| x.to_bits()).collect()
}

/// Random targets for `steps` control steps; the bits of each.
fn run(sim: &mut Simulation, steps: usize, stream: u64) -> Vec<Vec<u64>> {
    let (stance, envs) = (stance(sim), sim.num_envs());
    (0..steps)
        .map(|step| {
            let targets: Vec<f64> = (0..envs)
                .flat_map(|env| stance.iter().enumerate().map(move |(j, q)| (env, j, *q)))
                .map(|(env, j, q)| q + 0.3 * f64::from(noise(stream, env, step, j)))
                .collect();
            sim.step(&hold(&targets), 4).unwrap();
            bits(sim)
        })
        .collect()
}

#[test]
fn bits_depend_on_neither_threads_nor_runs_nor_other_envs() {
    let with = |threads, envs| {
        let options = SimulationOptions { threads: Some(threads), ..options("anymal_c", "avian", envs) };
        run(&mut Simulation::new(&options).unwrap(), 100, 1)
    };
    let one = with(1, 6);
    assert_eq!(one, with(1, 6), "another run");
    assert_eq!(one, with(2, 6), "two threads");
    let alone = with(1, 1);
    let sim = simulation("anymal_c", "avian");
    let (nq, nv) = (sim.nq(), sim.nv());
    for (all, first) in one.iter().zip(&alone) {
        assert_eq!(all[..nq], first[..nq]);
        assert_eq!(all[6 * nq..6 * nq + nv], first[nq..nq + nv]);
    }
}

#[test]
fn a_reset_env_is_a_fresh_one() {
    for robot in ["anymal_d", "unitree_go2"] {
        let mut fresh = simulation(robot, "avian");
        let expected = run(&mut fresh, 150, 1);
        let mut used = simulation(robot, "avian");
        // lying on the ground in some heap
        let mut start = used.default_qpos().to_vec();
        start[2] += 0.3;
        start[3..7].copy_from_slice(&[0.5, 0.8, 0.2, 0.1]);
        used.set_state(None, Some(&start), None).unwrap();
        run(&mut used, 200, 2);
        let (qpos, qvel) = (used.default_qpos().to_vec(), vec![0.0; used.nv()]);
        used.set_state(None, Some(&qpos), Some(&qvel)).unwrap();
        assert_eq!(used.qpos(), qpos);
        assert!(run(&mut used, 150, 1) == expected, "{robot}");
    }
}

#[test]
fn a_restored_simulation_goes_on_with_the_same_bits() {
    let options = |threads| SimulationOptions { threads: Some(threads), ..options("spot", "avian", 5) };
    let mut sim = Simulation::new(&options(1)).unwrap();
    sim.set_mass(None, 0, &[30.0]).unwrap();
    sim.set_com(None, 1, &[0.01, 0.0, -0.02]).unwrap();
    run(&mut sim, 40, 1);
    let snapshot = sim.snapshot().unwrap();
    let expected = run(&mut sim, 60, 2);
    // where it was taken, and where other contacts and other numbers were
    let mut other = Simulation::new(&options(2)).unwrap();
    run(&mut other, 15, 3);
    for (sim, place) in [(&mut sim, "where it was taken"), (&mut other, "elsewhere")] {
        sim.restore(&snapshot).unwrap();
        assert!(sim.snapshot().unwrap() == snapshot, "{place}");
        assert!(run(sim, 60, 2) == expected, "{place}");
    }
    assert!(simulation("spot", "articulated").restore(&snapshot).is_err());
}

#[test]
fn what_the_engine_lacks_is_refused() {
    let error = |options: SimulationOptions| Simulation::new(&options).err().unwrap().to_string();
    let avian = || options("spot", "avian", 1);
    let message = error(SimulationOptions { precision: Precision::Double, ..avian() });
    assert!(message.starts_with("precision: ") && message.contains("articulated"), "{message}");
    let message = error(SimulationOptions { dt: 1e-7, ..avian() });
    assert!(message.starts_with("dt: "), "{message}");
    let message = error(options("tests/data/urdf/arm.urdf", "avian", 1));
    assert!(message.contains("prismatic"), "{message}");
    let message = error(options("spot", "xpbd", 1));
    assert!(message.contains("avian"), "{message}");
}

/// The deepest overlap (m) of links that may touch, while the legs follow targets from the whole
/// range of the joints, in the air; the largest contact force on any link, and of all links
/// together (N), whose forces are all internal.
fn deepest_overlap(robot: &str, self_collision: bool) -> [f64; 3] {
    let options = SimulationOptions {
        self_collision: Some(self_collision),
        ground: None,
        gravity: [0.0; 3],
        ..options(robot, "avian", 1)
    };
    let mut sim = Simulation::new(&options).unwrap();
    // the other engine's shapes: boxes and capsules for the links' own
    let shapes = MorphologyModel::new(&Library::new(Vec::new()).robot(robot).unwrap()).unwrap();
    let topology = &shapes.topology;
    let parameters = Parameters::<f64>::from_scalars(topology, &shapes.nominal);
    let (mut work, still) = (Workspace::new(topology), vec![0.0; topology.num_joints()]);
    let [mut deepest, mut largest, mut net] = [0.0_f64; 3];
    for step in 0..600 {
        let targets: Vec<f64> = (0..still.len())
            .map(|j| {
                let (low, high) = (parameters.lower[j].max(-3.0), parameters.upper[j].min(3.0));
                low + (high - low) * 0.5 * (1.0 + f64::from(noise(1, 0, step / 100, j)))
            })
            .collect();
        sim.step(&hold(&targets), 1).unwrap();
        assert!(is_finite(&sim), "{robot}: step {step}");
        let q = sim.qpos();
        f64::forward_kinematics(topology, &parameters, &q[7..], &still, &Spatial::zero(), &mut work);
        f64::place_colliders(topology, &parameters, &mut work);
        for pair in 0..topology.pairs.len() {
            deepest = deepest.max(-f64::pair_gap(topology, &work, pair));
        }
        let forces = sim.contact_forces();
        largest = largest.max(most(forces.iter().copied()));
        net = net.max(most((0..3).map(|k| forces.iter().skip(k).step_by(3).sum::<f64>())));
    }
    [deepest, largest, net]
}

#[test]
fn links_of_a_robot_stay_apart() {
    for robot in ["anymal_c", "anymal_d", "spot"] {
        let [[with, force, net], [without, nothing, _]] = [true, false].map(|on| deepest_overlap(robot, on));
        println!(
            "{robot:<12} {:.1} mm deep at most, {:.1} mm without; forces up to {force:.0} N, together {net:.2e} N",
            1e3 * with,
            1e3 * without
        );
        assert!(without > 0.03, "{robot}: the targets never make links meet");
        assert!(with < 0.01, "{robot}: links pass {with} m into each other");
        assert!(force > 10.0 && nothing == 0.0, "{robot}: {force} N between links, {nothing} N without contact");
        assert!(net < 1e-6 * force, "{robot}: internal forces add up to {net} N");
    }
}
