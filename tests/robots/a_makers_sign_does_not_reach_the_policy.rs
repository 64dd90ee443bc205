//! A slot turns the same way on every robot: a URDF whose axes point the other way round gives the
//! same robot.

use std::path::{Path, PathBuf};

use polypod::systems::StateField;
use polypod::{Sim, SimOptions};

use crate::common::{busy, noise};

/// Libraries with a copy of a robot, and with one whose flexion joints turn the other way round.
/// Both have one name, and so the same random numbers.
fn libraries(robot: &str) -> [PathBuf; 2] {
    let assets = Path::new(env!("CARGO_MANIFEST_DIR"));
    let urdf = std::fs::read_to_string(assets.join(format!("assets/robots/{robot}/robot.urdf"))).unwrap();
    let mut turned = String::new();
    let mut is_turned = false;
    for line in urdf.lines() {
        let mut line = line.to_string();
        if line.contains("<axis") {
            is_turned = line.contains("xyz=\"0 1 0\"");
            line = line.replace("xyz=\"0 1 0\"", "xyz=\"0 -1 0\"");
        }
        if is_turned && line.contains("<limit") {
            let value = |key: &str| {
                let rest = &line[line.find(&format!("{key}=\"")).unwrap() + key.len() + 2..];
                rest[..rest.find('"').unwrap()].to_string()
            };
            let (lower, upper) = (value("lower"), value("upper"));
            let negative = |text: &str| format!("{}", -text.parse::<f64>().unwrap());
            line = line
                .replace(&format!("lower=\"{lower}\""), &format!("lower=\"{}\"", negative(&upper)))
                .replace(&format!("upper=\"{upper}\""), &format!("upper=\"{}\"", negative(&lower)));
        }
        turned += &line;
        turned += "\n";
    }
    assert_eq!(turned.matches("xyz=\"0 -1 0\"").count(), 8);
    [("straight", &urdf), ("turned", &turned)].map(|(kind, text)| {
        let root = std::env::temp_dir().join(format!("polypod-{kind}-{}", std::process::id()));
        std::fs::create_dir_all(root.join("configs/robots")).unwrap();
        std::fs::write(root.join("copy.urdf"), text).unwrap();
        let config = format!("extends = \"{robot}\"\nname = \"copy\"\ntitle = \"Copy\"\nurdf = \"../../copy.urdf\"\n");
        std::fs::write(root.join("configs/robots/copy.toml"), config).unwrap();
        root
    })
}

#[test]
fn turned_axes_give_the_same_robot() {
    let roots = libraries("unitree_go2");
    let make = |root: &Path| {
        let overrides = ["observations.enable_noise=false", "events.push_robot.enabled=false"];
        let mut options = SimOptions { roots: vec![root.to_path_buf()], ..busy(&["copy"], 4) };
        options.overrides.extend(overrides.map(String::from));
        Sim::new(&options).unwrap_or_else(|error| panic!("{error}"))
    };
    let (mut straight, mut turned) = (make(&roots[0]), make(&roots[1]));
    let signs = |sim: &Sim| sim.morphologies()[0].slots.iter().map(|slot| slot.sign).collect::<Vec<_>>();
    assert_eq!(signs(&straight), [1.0; 12]);
    assert_eq!(signs(&turned), [1.0, 1.0, 1.0, 1.0, -1.0, -1.0, -1.0, -1.0, -1.0, -1.0, -1.0, -1.0]);
    let mirror = |sim: &Sim| sim.morphologies()[0].mirrored_slots();
    assert_eq!(mirror(&straight), mirror(&turned));
    let default = |sim: &mut Sim| {
        let mut out = vec![0.0; 48];
        sim.state(StateField::DefaultJointPos, &mut out).unwrap();
        out
    };
    assert_eq!(default(&mut straight), default(&mut turned));
    let near = |a: &[f32], b: &[f32], what: &str| {
        let apart = a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        // single precision, while nothing has amplified it
        assert!(apart < 2e-3, "{what}: {apart} apart");
    };
    near(&straight.batch().observations, &turned.batch().observations, "at the start");
    for t in 0..15 {
        let actions: Vec<f32> = (0..48).map(|i| noise(0, i / 12, t, i % 12)).collect();
        for sim in [&mut straight, &mut turned] {
            sim.step(&actions).unwrap();
        }
        let (a, b) = (straight.batch(), turned.batch());
        near(&a.observations, &b.observations, &format!("observations of step {t}"));
        near(&a.rewards, &b.rewards, &format!("rewards of step {t}"));
        for field in [StateField::JointPos, StateField::LastAction, StateField::FeetPos] {
            let of = |sim: &mut Sim| {
                let mut out = vec![0.0; 48];
                sim.state(field, &mut out).unwrap();
                out
            };
            near(&of(&mut straight), &of(&mut turned), field.name());
        }
    }
    for root in roots {
        std::fs::remove_dir_all(root).unwrap();
    }
}
