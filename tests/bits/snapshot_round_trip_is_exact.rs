//! A restored snapshot goes on as the simulation that it was taken from, to the last bit; nothing
//! else is restored.

use polypod::{Control, Error, Sim, SimOptions, Simulation, SimulationOptions};

use crate::common::{ROBOTS, assert_all_same, busy, env_bits, size, step, turning};

/// A simulation somewhere in the middle of its episodes.
fn under_way(options: &SimOptions) -> Sim {
    let mut sim = Sim::new(options).unwrap();
    (0..37).for_each(|t| step(&mut sim, t));
    sim
}

/// Fifty further steps: the bits of all envs after each of them, and the last snapshot.
fn fifty_steps(sim: &mut Sim) -> (Vec<Vec<Vec<u32>>>, Vec<u8>) {
    let steps = (100..150)
        .map(|t| {
            step(sim, t);
            env_bits(sim)
        })
        .collect();
    (steps, sim.snapshot().unwrap())
}

#[test]
fn a_restored_simulation_goes_on_as_if_nothing_had_happened() {
    round_trip(busy(&ROBOTS, 27));
}

#[test]
fn so_it_does_on_ground_that_resists_turning() {
    round_trip(turning(busy(&["anymal_d", "spot"], 10)));
}

#[test]
fn so_it_does_on_avians_rigid_bodies() {
    let mut options = busy(&ROBOTS, 18);
    options.overrides.push("physics.engine=avian".into());
    round_trip(options.clone());
    // envs have separate origins here, and change them
    let terrain = ["scene.terrain.num_rows=3", "scene.terrain.num_cols=4"].map(String::from);
    let overrides = options.overrides.into_iter().chain(terrain).collect();
    round_trip(SimOptions { task: "velocity_rough".into(), num_envs: 9, overrides, ..options });
}

fn round_trip(options: SimOptions) {
    let mut sim = under_way(&options);
    let snapshot = sim.snapshot().unwrap();
    let expected = fifty_steps(&mut sim);

    sim.restore(&snapshot).unwrap();
    assert!(sim.snapshot().unwrap() == snapshot);
    assert!(fifty_steps(&mut sim) == expected, "restored where it was taken");

    let mut fresh = Sim::new(&SimOptions { seed: 8, threads: Some(2), ..options }).unwrap();
    fresh.restore(&snapshot).unwrap();
    assert_eq!(fresh.seed(), 7);
    assert!(fresh.snapshot().unwrap() == snapshot);
    assert!(fifty_steps(&mut fresh) == expected, "restored into another simulation");
}

#[track_caller]
fn assert_refused(sim: &mut Sim, bytes: &[u8], word: &str) {
    let before = sim.snapshot().unwrap();
    let error = sim.restore(bytes).unwrap_err();
    assert!(matches!(error, Error::Snapshot(_)), "{error}");
    assert!(error.to_string().starts_with("snapshot: ") && error.to_string().contains(word), "{error}");
    assert!(sim.snapshot().unwrap() == before, "a refused snapshot has changed the simulation");
}

#[test]
fn a_snapshot_of_another_simulation_is_refused() {
    let options = busy(&["unitree_a1", "spot"], 6);
    let mut sim = under_way(&options);
    let mut twin = under_way(&options);
    let mut decimation = options.clone();
    decimation.overrides.push("sim.decimation=2".into());
    for (other, word) in [
        (decimation, "another simulation"),
        (busy(&["unitree_a1", "spot"], 7), "another simulation"),
        (busy(&["spot", "unitree_a1"], 6), "another simulation"),
        (busy(&["unitree_a1", "unitree_go1"], 6), "another simulation"),
    ] {
        assert_refused(&mut sim, &under_way(&other).snapshot().unwrap(), word);
    }
    (50..60).for_each(|t| {
        step(&mut sim, t);
        step(&mut twin, t);
    });
    assert_all_same(&mut sim, &mut twin, "after refused snapshots");
}

#[test]
fn damaged_bytes_are_refused() {
    let mut sim = under_way(&busy(&["spot"], 3));
    let snapshot = sim.snapshot().unwrap();
    step(&mut sim, 40);
    let garbage: Vec<u8> = (0..1000u32).map(|i| (i * 167 + 13) as u8).collect();
    for bytes in [&[][..], &[0xff; 64], &garbage, &snapshot[..1], &snapshot[..snapshot.len() / 2]] {
        assert_refused(&mut sim, bytes, "");
    }
    assert_refused(&mut sim, &snapshot[..snapshot.len() - 1], "damaged");
    assert_refused(&mut sim, &[&snapshot[..], &[0]].concat(), "damaged");
    // a flipped bit anywhere, be it in a length or in a number
    for at in (0..snapshot.len()).step_by(97) {
        let mut flipped = snapshot.clone();
        flipped[at] ^= 1 << (at % 8);
        assert_refused(&mut sim, &flipped, "");
    }
    sim.restore(&snapshot).unwrap();
}

/// FNV-1a, the checksum at the end of a snapshot.
fn fnv1a(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3))
}

/// Replaces some bytes of a snapshot at regular distances and corrects the checksum: each is
/// restored or refused, and what is refused leaves the state `before`. `restore` gives the outcome
/// and the state after it. Returns how many were refused.
fn refused(
    engine: &str,
    snapshot: &[u8],
    before: &[u8],
    (stride, values): (usize, &[u8]),
    restore: &mut impl FnMut(&[u8]) -> (Result<(), String>, Vec<u8>),
) -> usize {
    let (body, _) = snapshot.split_last_chunk::<8>().unwrap();
    let mut refused = 0;
    for at in (0..body.len()).step_by(stride) {
        for &value in values {
            let mut bytes = body.to_vec();
            bytes[at] = value;
            bytes.extend(fnv1a(&bytes).to_le_bytes());
            let (outcome, mut after) = restore(&bytes);
            match outcome {
                Ok(()) => {
                    let (outcome, restored) = restore(before);
                    outcome.unwrap();
                    after = restored;
                }
                Err(error) => {
                    refused += 1;
                    assert!(error.starts_with("snapshot: "), "{engine}, byte {at}: {error}");
                }
            }
            assert!(after == before, "{engine}: byte {at} = {value} has changed the simulation");
        }
    }
    refused
}

#[test]
fn hostile_bytes_are_restored_or_refused_and_nothing_in_between() {
    for engine in ["articulated", "avian"] {
        let robot = format!("{}/tests/data/urdf/biped.urdf", env!("CARGO_MANIFEST_DIR"));
        let mut sim = Simulation::new(&SimulationOptions {
            engine: engine.into(),
            threads: Some(1),
            ..SimulationOptions::new(robot, 1)
        })
        .unwrap();
        sim.step(&Control::default(), 20).unwrap();
        let snapshot = sim.snapshot().unwrap();
        sim.step(&Control::default(), 1).unwrap();
        let before = sim.snapshot().unwrap();
        let mut restore = |bytes: &[u8]| {
            let restored = sim.restore(bytes).map_err(|error| error.to_string());
            (restored, sim.snapshot().unwrap())
        };
        assert!(refused(engine, &snapshot, &before, (1, &[0, 255]), &mut restore) > 0, "{engine}");
    }
}

#[test]
fn what_a_task_refuses_of_a_snapshot_has_changed_nothing() {
    for engine in ["articulated", "avian"] {
        let mut options = SimOptions { threads: Some(1), ..busy(&["spot"], 2) };
        options.overrides.push(format!("physics.engine={engine}"));
        let mut sim = under_way(&options);
        let snapshot = sim.snapshot().unwrap();
        step(&mut sim, 40);
        let before = sim.snapshot().unwrap();
        let mut restore = |bytes: &[u8]| {
            let restored = sim.restore(bytes).map_err(|error| error.to_string());
            (restored, sim.snapshot().unwrap())
        };
        let refused = refused(engine, &snapshot, &before, (size(7, 1), &[255]), &mut restore);
        assert!(refused > 10, "{engine}: {refused} refused");
    }
}
