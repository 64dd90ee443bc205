//! A varied body is the body of a URDF edited by hand: the same numbers, the same description, the
//! same motion. And it stands on its feet.

use std::path::PathBuf;

use polypod::components::{Body, ContactSensor, EnvId, Feet, Stance};
use polypod::config::Library;
use polypod::morphology::MorphologyModel;
use polypod::robot::BodyGroup;
use polypod::variation::BodyScales;
use polypod::{Sim, SimOptions};

const X: BodyScales = BodyScales {
    base_length: 1.12,
    base_width: 0.9,
    hip_offset: 1.2,
    thigh_length: 0.87,
    shank_length: 1.15,
    base_mass: 1.3,
    hip_mass: 0.8,
    thigh_mass: 1.15,
    shank_mass: 0.7,
    joint_range: 0.85,
    stiffness: 1.1,
    damping: 0.9,
    size: 1.1,
    action_scale: 0.7,
    default_flexion: 0.9,
    default_abduction: 0.1,
};

/// An inertial element of a uniform box.
fn inertial(mass: f64, size: [f64; 3], centre: [f64; 3]) -> String {
    let [x, y, z] = size.map(|s| s * s * mass / 12.0);
    let [cx, cy, cz] = centre;
    format!(
        r#"<inertial><origin xyz="{cx} {cy} {cz}"/><mass value="{mass}"/>
        <inertia ixx="{}" iyy="{}" izz="{}" ixy="0" ixz="0" iyz="0"/></inertial>"#,
        y + z,
        x + z,
        x + y
    )
}

fn collision(shape: &str, centre: [f64; 3], rpy: &str) -> String {
    let [x, y, z] = centre;
    format!(r#"<collision><origin xyz="{x} {y} {z}" rpy="{rpy}"/><geometry>{shape}</geometry></collision>"#)
}

fn box_of([x, y, z]: [f64; 3]) -> String {
    format!(r#"<box size="{x} {y} {z}"/>"#)
}

/// A quadruped of boxes and cylinders, with every length, mass and limit multiplied where it
/// stands.
fn urdf(s: &BodyScales) -> String {
    let size = s.size;
    let base = [0.5 * s.base_length, 0.2 * s.base_width, 0.1].map(|x| x * size);
    let offset = 0.08 * s.hip_offset * size;
    let (thigh, shank) = (0.22 * s.thigh_length * size, 0.24 * s.shank_length * size);
    let inertial = |mass: f64, across: [f64; 3], centre: [f64; 3]| inertial(mass * size.powi(3), across, centre);
    let mut text = format!(
        r#"<robot name="boxes"><link name="base">{}{}</link>"#,
        inertial(8.0 * s.base_mass, base, [0.0; 3]),
        collision(&box_of(base), [0.0; 3], "0 0 0")
    );
    for (leg, front, left) in [("LF", 1.0, 1.0), ("LH", -1.0, 1.0), ("RF", 1.0, -1.0), ("RH", -1.0, -1.0)] {
        let hip = [0.0, 0.5 * left * offset, 0.0];
        let (mid_thigh, mid_shank) = ([0.0, 0.0, -0.5 * thigh], [0.0, 0.0, -0.5 * shank]);
        let links = [
            (
                "HIP",
                inertial(0.6 * s.hip_mass, [0.06 * size, offset, 0.06 * size], hip),
                collision(
                    &format!(r#"<cylinder radius="{}" length="{offset}"/>"#, 0.03 * size),
                    hip,
                    "1.5707963267948966 0 0",
                ),
            ),
            (
                "THIGH",
                inertial(1.0 * s.thigh_mass, [0.04 * size, 0.03 * size, thigh], mid_thigh),
                collision(&box_of([0.04 * size, 0.03 * size, thigh]), mid_thigh, "0 0 0"),
            ),
            (
                "SHANK",
                inertial(0.3 * s.shank_mass, [0.02 * size, 0.02 * size, shank], mid_shank),
                collision(&box_of([0.02 * size, 0.02 * size, shank]), mid_shank, "0 0 0"),
            ),
        ];
        for (part, mass, shape) in &links {
            text += &format!(r#"<link name="{leg}_{part}">{mass}{shape}</link>"#);
        }
        text += &format!(
            r#"<link name="{leg}_FOOT">{}</link>"#,
            collision(&format!(r#"<sphere radius="{}"/>"#, 0.022 * size), [0.0; 3], "0 0 0")
        );
        let hip_at = [0.2 * s.base_length * front, 0.06 * s.base_width * left, 0.0].map(|x| x * size);
        for (name, parent, child, at, axis, [lower, upper]) in [
            ("HAA", "base".into(), "HIP", hip_at, "1 0 0", [-0.9, 0.9]),
            ("HFE", format!("{leg}_HIP"), "THIGH", [0.0, left * offset, 0.0], "0 1 0", [-1.0, 3.6]),
            ("KFE", format!("{leg}_THIGH"), "SHANK", [0.0, 0.0, -thigh], "0 1 0", [-2.7, -0.7]),
        ] {
            let (middle, half) = (0.5 * (lower + upper), 0.5 * (upper - lower) * s.joint_range);
            let [x, y, z] = at;
            text += &format!(
                r#"<joint name="{leg}_{name}" type="revolute"><parent link="{parent}"/><child link="{leg}_{child}"/>
                <origin xyz="{x} {y} {z}"/><axis xyz="{axis}"/>
                <limit lower="{}" upper="{}" effort="{}" velocity="{}"/></joint>"#,
                middle - half,
                middle + half,
                40.0 * size.powi(4),
                30.0 / size.sqrt()
            );
        }
        text += &format!(
            r#"<joint name="{leg}_foot" type="fixed"><parent link="{leg}_SHANK"/><child link="{leg}_FOOT"/>
            <origin xyz="0 0 {}"/></joint>"#,
            -shank
        );
    }
    text + "</robot>"
}

/// A folder with the robot `boxes`, scaled in its files.
struct Folder(PathBuf);

impl Folder {
    fn new(label: &str, scales: &BodyScales, self_collisions: bool) -> Self {
        let folder = std::env::temp_dir().join(format!("polypod-boxes-{label}-{}", std::process::id()));
        std::fs::create_dir_all(folder.join("configs/robots")).unwrap();
        let outward = scales.default_abduction;
        let pose = [("HAA", [0.05 + outward, -0.05 - outward]), ("HFE", [0.8; 2]), ("KFE", [-1.5; 2])];
        let pose = pose.iter().flat_map(|(role, sides)| {
            let bent = if *role == "HAA" { 1.0 } else { scales.default_flexion };
            ["LF", "LH", "RF", "RH"]
                .map(|leg| format!("{leg}_{role} = {:?}\n", bent * sides[usize::from(&leg[..1] == "R")]))
        });
        let config = format!(
            "name = \"boxes\"\ntitle = \"Boxes\"\nurdf = \"boxes.urdf\"\nreward_set = \"unitree\"\naction_scale = {}\n\
             self_collisions = {self_collisions}\n[default_pose]\n{}[actuators.legs]\njoints = [\"*\"]\nmodel = \"ideal_pd\"\n\
             effort_limit = {}\nstiffness = {}\ndamping = {}\n",
            0.25 * scales.action_scale,
            pose.collect::<String>(),
            40.0 * scales.size.powi(4),
            50.0 * scales.stiffness * scales.size.powi(4),
            1.5 * scales.damping * scales.size.powf(4.5)
        );
        std::fs::write(folder.join("configs/robots/boxes.toml"), config).unwrap();
        std::fs::write(folder.join("configs/robots/boxes.urdf"), urdf(scales)).unwrap();
        Self(folder)
    }

    fn model(&self) -> MorphologyModel {
        MorphologyModel::new(&Library::new(vec![self.0.clone()]).robot("boxes").unwrap()).unwrap()
    }

    fn sim(&self) -> Sim {
        let options = SimOptions {
            robots: Some(vec!["boxes".into()]),
            roots: vec![self.0.clone()],
            threads: Some(1),
            overrides: [
                "events.body_variation.enabled=false",
                "observations.enable_noise=false",
                "sim.gravity=[0.0, 0.0, 0.0]",
            ]
            .map(String::from)
            .to_vec(),
            ..SimOptions::new("velocity_flat_variation", 5)
        };
        Sim::new(&options).unwrap()
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

fn assert_same_stance(a: &Stance, b: &Stance) {
    assert!((a.spawn_height - b.spawn_height).abs() < 1e-6, "{a:?} {b:?}");
    assert!((a.action_scale - b.action_scale).abs() < 1e-7, "{a:?} {b:?}");
    assert!(a.default_position.iter().zip(&b.default_position).all(|(x, y)| (x - y).abs() < 1e-6), "{a:?} {b:?}");
}

#[test]
fn a_varied_body_has_the_numbers_of_an_edited_urdf() {
    for self_collisions in [false, true] {
        let plain = Folder::new(&format!("plain-{self_collisions}"), &BodyScales::NOMINAL, self_collisions).model();
        let edited = Folder::new(&format!("edited-{self_collisions}"), &X, self_collisions).model();
        assert_eq!(plain.topology.colliders.len(), edited.topology.colliders.len());
        assert_eq!(plain.topology.colliders.is_empty(), !self_collisions);
        let mut varied = plain.nominal.clone();
        let mut stance = plain.stance.clone();
        X.apply(&plain, &mut varied, &mut stance);
        assert_same_stance(&stance, &edited.stance);
        let mut numbers = 0;
        varied.zip_with(&edited.nominal, |x, y| {
            numbers += 1;
            // a limit that is absent is infinite
            let is_same = *x == *y || (*x - *y).abs() <= 2e-6 * y.abs() + 1e-8;
            assert!(is_same, "number {numbers}: {x} is not {y}");
        });
        assert!(numbers > 500);
        // the identity changes nothing but by rounding, and nothing by none
        let mut same = plain.nominal.clone();
        let mut stance = plain.stance.clone();
        BodyScales::NOMINAL.apply(&plain, &mut same, &mut stance);
        assert_same_stance(&stance, &plain.stance);
        same.zip_with(&plain.nominal, |x, y| {
            assert!(*x == *y || (*x - *y).abs() <= 2e-7 * y.abs(), "{x} is not {y}");
        });
    }
}

/// Base and joints of every env.
fn motion(sim: &mut Sim) -> Vec<f32> {
    let world = sim.world_mut();
    let mut query = world.query::<(&polypod::components::BasePose, &polypod::components::JointState)>();
    query
        .iter(world)
        .flat_map(|(pose, joints)| {
            pose.position.into_iter().chain(pose.rotation).chain(joints.position.clone()).collect::<Vec<_>>()
        })
        .collect()
}

fn feet_in_the_air(sim: &mut Sim) -> bool {
    let world = sim.world_mut();
    world.query::<&ContactSensor>().iter(world).all(|sensor| sensor.peak_force.iter().all(|force| *force == 0.0))
}

#[test]
fn a_varied_body_moves_and_is_described_as_an_edited_urdf() {
    let (plain, edited) = (Folder::new("plain-sim", &BodyScales::NOMINAL, false), Folder::new("edited-sim", &X, false));
    let (mut a, mut b) = (plain.sim(), edited.sim());
    // the masses that startup has sampled are replaced, in both
    let model = a.morphologies()[0].clone();
    let edited = b.morphologies()[0].clone();
    let varied = |body: &mut Body, stance: &mut Stance| {
        let friction = (body.0.static_friction, body.0.dynamic_friction);
        *body.0 = model.nominal.clone();
        *stance = model.stance.clone();
        X.apply(&model, &mut body.0, stance);
        (body.0.static_friction, body.0.dynamic_friction) = friction;
    };
    let world = a.world_mut();
    for (mut body, mut stance) in world.query::<(&mut Body, &mut Stance)>().iter_mut(world) {
        varied(&mut body, &mut stance);
    }
    let world = b.world_mut();
    for mut body in world.query::<&mut Body>().iter_mut(world) {
        let friction = (body.0.static_friction, body.0.dynamic_friction);
        *body.0 = edited.nominal.clone();
        (body.0.static_friction, body.0.dynamic_friction) = friction;
    }
    for sim in [&mut a, &mut b] {
        sim.reset(None, None).unwrap();
    }
    for t in 0..60 {
        let (x, y) = (motion(&mut a), motion(&mut b));
        let worst = x.iter().zip(&y).map(|(x, y)| (x - y).abs()).fold(0.0, f32::max);
        // without gravity nothing is touched, where rounding would decide in which physics step
        assert!(feet_in_the_air(&mut a), "step {t}: something is touched");
        assert!(worst < 1e-5, "step {t}: positions differ by {worst}");
        if t == 0 {
            let size = a.task().observations.last().unwrap().size;
            for (x, y) in a.batch().observations.chunks(83).zip(b.batch().observations.chunks(83)) {
                for (x, y) in x[83 - size..].iter().zip(&y[83 - size..]) {
                    assert!((x - y).abs() < 2e-6 * (1.0 + y.abs()), "the description says {x}, not {y}");
                }
            }
        }
        let actions: Vec<f32> = (0..a.batch().actions.len()).map(|i| 0.3 * (0.2 * t as f32 + i as f32).sin()).collect();
        a.step(&actions).unwrap();
        b.step(&actions).unwrap();
    }
}

const EACH: usize = 48;
const ROBOTS: [&str; 8] =
    ["anymal_d", "anymal_c", "anymal_b", "unitree_a1", "unitree_go1", "unitree_go2", "unitree_b2", "spot"];

/// Many varied bodies of each robot, in the default pose and otherwise undisturbed.
fn varied() -> Sim {
    let off = ["push_robot", "physics_material", "add_base_mass", "base_com", "reset_base", "reset_joints"];
    let off = off.map(|event| format!("events.{event}.enabled=false"));
    let options = SimOptions {
        robots: Some(ROBOTS.map(String::from).to_vec()),
        seed: 2,
        overrides: off.into_iter().chain(["observations.enable_noise=false".into()]).collect(),
        ..SimOptions::new("velocity_flat_variation", EACH * ROBOTS.len())
    };
    Sim::new(&options).unwrap()
}

#[test]
fn varied_robots_stand_on_their_feet() {
    let mut sim = varied();
    let models = sim.morphologies().to_vec();
    let still = vec![0.0; sim.batch().actions.len()];
    for _ in 0..100 {
        sim.step(&still).unwrap();
        if let Some(env) = sim.batch().terminated.iter().position(|ended| *ended) {
            panic!("{} in env {env} has fallen", ROBOTS[env / EACH]);
        }
    }
    let margins: Vec<f32> = models.iter().map(|m| m.config.reset.spawn_margin as f32).collect();
    let world = sim.world_mut();
    for (id, sensor) in world.query::<(&EnvId, &ContactSensor)>().iter(world) {
        let robot = id.0 as usize / EACH;
        for (force, group) in sensor.peak_force.iter().zip(&models[robot].body_groups) {
            let touches = *force > 1.0;
            assert!(!touches || *group == BodyGroup::Foot, "{}, env {}: {group:?} touches", ROBOTS[robot], id.0);
        }
        let standing = models[robot].feet.iter().filter(|&&body| sensor.peak_force[body] > 1.0).count();
        assert!(standing >= 3, "{}, env {}: {standing} feet on the ground", ROBOTS[robot], id.0);
    }
    for (id, stance, feet) in world.query::<(&EnvId, &Stance, &Feet)>().iter(world) {
        let robot = id.0 as usize / EACH;
        assert!(
            stance.spawn_height > margins[robot] && feet.position.iter().all(|foot| foot[2] > -0.005 && foot[2] < 0.1)
        );
    }
}

#[test]
fn left_and_right_stay_mirror_images() {
    let mut sim = varied();
    let models = sim.morphologies().to_vec();
    let mut seen = 0;
    let world = sim.world_mut();
    for (id, body) in world.query::<(&EnvId, &Body)>().iter(world) {
        let model = &models[id.0 as usize / EACH];
        for slot in 0..12 {
            // legs come in the order LF, LH, RF, RH
            let (j, k) = (model.slots[slot].joint(), model.slots[slot ^ 2].joint());
            let share = |j: usize| body.0.mass[j + 1] / model.nominal.mass[j + 1];
            assert!((share(j) - share(k)).abs() < 1e-5);
            for axis in 0..3 {
                let (left, right) = (body.0.joint_offset[j][axis].abs(), body.0.joint_offset[k][axis].abs());
                let apart =
                    (model.nominal.joint_offset[j][axis].abs() - model.nominal.joint_offset[k][axis].abs()).abs();
                assert!((left - right).abs() <= 1.2 * apart + 1e-6, "{}: {left} and {right}", model.name());
            }
            seen += usize::from(share(j) != 1.0);
        }
    }
    assert!(seen > 3000);
}

#[test]
fn avian_refuses_what_it_cannot_do() {
    let options =
        SimOptions { overrides: vec!["physics.engine=avian".into()], ..SimOptions::new("velocity_flat_variation", 8) };
    let error = Sim::new(&options).err().unwrap().to_string();
    assert!(error.contains("body_variation") && error.contains("articulated"), "{error}");
}
