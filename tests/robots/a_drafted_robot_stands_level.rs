//! The default pose that `draft` finds for a URDF: all feet on one plane, the centre of mass
//! between them, knees bent, joints within their limits.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use glam::{DVec2, DVec3};
use polypod::draft::{Draft, DraftOptions, draft};
use polypod::robot::{CANONICAL_JOINT_NAMES, LoadOptions, Model, Pose, Roles, Slot, detect, load};
use toml::Table;

fn assets() -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("assets/robots");
    let mut files: Vec<PathBuf> =
        std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path().join("robot.urdf")).collect();
    // twelve joints in four legs
    let is_quadruped = |file: &Path| {
        let model = load(file, &LoadOptions::default()).ok()?;
        let slots = detect(&model, &BTreeMap::new(), &BTreeMap::new()).ok()?.slots;
        Some(CANONICAL_JOINT_NAMES.iter().all(|name| Slot::parse(name).is_some_and(|slot| slots.contains(&slot))))
    };
    files.retain(|file| is_quadruped(file) == Some(true));
    files.sort();
    assert!(files.len() >= 14, "{files:?}");
    files
}

struct Stood {
    /// Joints of the URDF, those that are held among them.
    whole_joints: usize,
    model: Model,
    roles: Roles,
    /// Joint positions, rad.
    q: Vec<f64>,
}

fn stood(file: &Path) -> Stood {
    let Draft { toml, .. } = draft(file, &DraftOptions::default()).unwrap();
    let table: Table = toml.parse().unwrap();
    let locked: BTreeMap<String, f64> = table
        .get("locked_joints")
        .and_then(|locked| locked.as_table())
        .into_iter()
        .flatten()
        .map(|(joint, position)| (joint.clone(), position.as_float().unwrap()))
        .collect();
    let held = locked.len();
    let model = load(file, &LoadOptions { locked_joints: locked, ..LoadOptions::default() }).unwrap();
    let roles = detect(&model, &BTreeMap::new(), &BTreeMap::new()).unwrap();
    let mut q = vec![0.0; model.joints.len()];
    for (slot, (&joint, sign)) in roles.slots.iter().zip(roles.joint_of_slot.iter().zip(&roles.sign_of_slot)) {
        q[joint] = sign * table["default_pose"][&slot.to_string()].as_float().unwrap();
    }
    Stood { whole_joints: model.joints.len() + held, model, roles, q }
}

impl Stood {
    /// Frames of hip and knee of a leg.
    fn hip_and_knee(&self, links: &[Pose], leg: usize) -> [DVec3; 2] {
        [leg + 4, leg + 8].map(|slot| {
            let slot = Slot::parse(CANONICAL_JOINT_NAMES[slot]).unwrap();
            let joint = self.roles.joint_of_slot[self.roles.slots.binary_search(&slot).unwrap()];
            links[joint + 1].translation
        })
    }

    /// The lowest point of each foot, base frame, m.
    fn soles(&self) -> [DVec3; 4] {
        let links = self.model.forward_kinematics(&self.q);
        std::array::from_fn(|leg| {
            let link = self.model.bodies[self.roles.foot_body[leg]].link;
            links[link].transform_point(self.roles.foot_point[leg]) - DVec3::Z * self.roles.foot_radius[leg]
        })
    }

    /// Mean length of thigh and shank together, m.
    fn leg_length(&self) -> f64 {
        let links = self.model.forward_kinematics(&self.q);
        let of = |(leg, sole): (usize, DVec3)| {
            let [hip, knee] = self.hip_and_knee(&links, leg);
            let foot = sole + DVec3::Z * self.roles.foot_radius[leg];
            hip.distance(knee) + knee.distance(foot)
        };
        self.soles().into_iter().enumerate().map(of).sum::<f64>() / 4.0
    }

    fn centre_of_mass(&self) -> DVec3 {
        let links = self.model.forward_kinematics(&self.q);
        let moments =
            self.model.links.iter().zip(&links).map(|(link, pose)| pose.transform_point(link.com) * link.mass);
        moments.sum::<DVec3>() / self.model.total_mass()
    }
}

#[test]
fn feet_are_level_about_the_centre_of_mass() {
    for file in assets() {
        let stood = stood(&file);
        let soles = stood.soles();
        let middle = soles.iter().sum::<DVec3>() / 4.0;
        for sole in soles {
            assert!((sole.z - middle.z).abs() < 2e-3, "{}: {soles:?}", file.display());
        }
        let centre = stood.centre_of_mass();
        // a tenth of a leg behind it, as of the robots that policies know
        let behind = 0.109 * stood.leg_length();
        let off = (centre - middle).truncate() - DVec2::new(behind, 0.0);
        // an arm that is held may lean to a side
        let beside = if stood.model.joints.len() < stood.whole_joints { 3e-2 } else { 1e-2 };
        assert!(off.x.abs() < 1e-2 && off.y.abs() < beside, "{}: {centre} over {middle}", file.display());
        // to the front and to the rear, to the left and to the right of it
        assert!(soles[0].x > centre.x && soles[1].x < centre.x && soles[0].y > centre.y && soles[2].y < centre.y);
    }
}

#[test]
fn knees_are_bent_and_joints_within_their_limits() {
    for file in assets() {
        let stood = stood(&file);
        for (joint, q) in stood.model.joints.iter().zip(&stood.q) {
            assert!(joint.lower < *q && *q < joint.upper, "{}: {} at {q}", file.display(), joint.name);
        }
        let links = stood.model.forward_kinematics(&stood.q);
        for (leg, sole) in stood.soles().into_iter().enumerate() {
            let [hip, knee] = stood.hip_and_knee(&links, leg);
            let straight = hip.distance(knee) + knee.distance(sole);
            let share = hip.distance(sole) / straight;
            assert!((0.6..0.95).contains(&share), "{}: leg {leg} at {share} of its length", file.display());
        }
    }
}

#[test]
fn a_name_without_letters_is_refused() {
    for name in ["", "  ", "--"] {
        let error =
            draft(&assets()[0], &DraftOptions { name: Some(name.into()), ..DraftOptions::default() }).unwrap_err();
        let text = error.to_string();
        assert!(text.contains("name") && text.contains("letter"), "{text}");
    }
}

#[test]
fn legs_that_hang_at_zero_keep_their_angles() {
    // descriptions of these robots are what bundled policies were trained on
    for file in assets() {
        let model = load(&file, &LoadOptions::default()).unwrap();
        let roles = detect(&model, &BTreeMap::new(), &BTreeMap::new()).unwrap();
        assert_eq!(roles.zero_of_slot, vec![0.0; roles.slots.len()], "{}", file.display());
    }
}
