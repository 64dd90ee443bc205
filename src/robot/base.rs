//! Choice of the base's link. The frame of an empty root, such as a footprint on the ground, says
//! nothing about the body below it.

use std::collections::BTreeMap;
use std::path::Path;

use super::chains::ZeroPose;
use super::error::Warning;
use super::limbs::LimbKind;
use super::merge::Motion;
use super::model::Model;
use super::pose::Pose;
use super::roles::detect;
use super::tree::Tree;

/// Share of the robot's mass below which a link is no body.
const LIGHT: f64 = 0.01;
/// Largest share of the robot's mass that links fixed to an empty root next to the body may have.
const BESIDE: f64 = 0.25;
/// Rotations and distances below this, rad and m, are none.
const NEAR: f64 = 1e-6;
/// Frames turned by less than this against each other have the same axes, rad.
const SAME_AXES: f64 = 1e-3;
/// Least advantage of an empty root over the body below it in how its axes fit the joints, as a
/// mean cosine.
const BETTER: f64 = 0.1;

/// A link whose frame may be the base's.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Base {
    pub link: usize,
    /// The joints from it up to the root, none of which moves.
    pub above: Vec<usize>,
}

impl Base {
    pub fn of(link: usize) -> Self {
        Self { link, above: Vec::new() }
    }
}

/// Candidates for the base of a robot.
pub(super) struct Bases {
    /// The body below an empty root, or the root; then the links above whose axes are turned
    /// against it.
    pub candidates: Vec<Base>,
    /// Frame of the root in that of the first candidate.
    root: Pose,
    /// Whether the root is empty and several of its children may be the body.
    is_open: bool,
}

impl Bases {
    /// The candidates of a robot; the root alone where the options keep it.
    pub fn new(robot: &urdf_rs::Robot, tree: &Tree, motions: &[Motion], keeps_root: bool) -> Self {
        let below = Below::new(robot, tree, motions);
        let mut above: Vec<usize> = Vec::new();
        let mut link = tree.root;
        let mut is_open = false;
        while !keeps_root && below.is_empty(link) {
            let Some(joint) = below.body(link) else {
                is_open = below.is_open(link);
                break;
            };
            above.insert(0, joint);
            link = tree.ends[joint].1;
        }
        let mut candidates = vec![Base { link, above: above.clone() }];
        let mut root = Pose::IDENTITY;
        let mut last = root;
        for (at, &joint) in above.iter().enumerate() {
            if let Motion::Attached(origin) = &motions[joint] {
                root = root * origin.inverse();
            }
            if angle(&(last.inverse() * root)) > SAME_AXES && angle(&root) > SAME_AXES {
                candidates.push(Base { link: tree.ends[joint].0, above: above[at + 1..].to_vec() });
                last = root;
            }
        }
        Self { candidates, root, is_open }
    }

    /// Notice about `chosen`, one of the candidates.
    pub fn notice(&self, robot: &urdf_rs::Robot, tree: &Tree, chosen: &Base, file: &Path) -> Option<Warning> {
        let name = |link: usize| robot.links[link].name.as_str();
        let (root, body) = (name(tree.root), name(self.candidates[0].link));
        let (turn, distance) = (angle(&self.root), self.root.translation.length());
        let warning = |link: &str, problem: String, remedy: String| {
            Some(Warning::new(file, format!("link \"{link}\""), problem, remedy))
        };
        if self.is_open {
            let problem = "is empty, and several links hang on it: its frame is the base's".to_string();
            let remedy = "let it lie in the body with x forward and z up: heights are measured from it".to_string();
            return warning(name(chosen.link), problem, remedy);
        }
        if *chosen != self.candidates[0] {
            let problem = format!(
                "is empty, but the joints turn about its axes, not those of \"{body}\": its frame is the base's"
            );
            let remedy = "let it lie in the body: heights are measured from it".to_string();
            return warning(name(chosen.link), problem, remedy);
        }
        if turn < NEAR && distance < NEAR {
            return None;
        }
        let turned =
            if turn < NEAR { String::new() } else { format!(" and turned by {:.1} degrees", turn.to_degrees()) };
        let problem = format!("is an empty root: the base's frame is that of \"{body}\", {distance:.3} m away{turned}");
        let remedy = format!("no change is needed where \"{body}\" has x forward and z up; else turn its frame");
        warning(root, problem, remedy)
    }
}

/// Fit of a robot's frame to its legs: mean cosine between the axes of their joints and those that
/// their roles state; 0 for a robot without legs.
pub(super) fn suits(model: &Model) -> f64 {
    let Ok(roles) = detect(model, &BTreeMap::new(), &BTreeMap::new()) else {
        return 0.0;
    };
    let pose = ZeroPose::new(model);
    let legs = roles.limbs.iter().filter(|limb| limb.kind == LimbKind::Leg);
    let cosines: Vec<f64> = legs.flat_map(|limb| pose.cosines(limb)).collect();
    cosines.iter().sum::<f64>() / cosines.len().max(1) as f64
}

/// Whether the second of two readings of a robot suits its legs clearly better.
pub(super) fn is_better(first: &Model, second: &Model) -> bool {
    suits(second) > suits(first) + BETTER
}

fn angle(pose: &Pose) -> f64 {
    let trace = pose.rotation.x_axis.x + pose.rotation.y_axis.y + pose.rotation.z_axis.z;
    // for small angles more precise than the cosine alone
    let r = &pose.rotation;
    let sine = [r.y_axis.z - r.z_axis.y, r.z_axis.x - r.x_axis.z, r.x_axis.y - r.y_axis.x];
    sine.iter().map(|s| s * s).sum::<f64>().sqrt().atan2(trace - 1.0)
}

/// Links below each link.
struct Below<'a> {
    robot: &'a urdf_rs::Robot,
    tree: &'a Tree,
    motions: &'a [Motion],
    /// Mass of the link and all below it, kg.
    mass: Vec<f64>,
    /// Whether a joint moves below it.
    moves: Vec<bool>,
    /// Mass of the robot, kg.
    total: f64,
}

impl<'a> Below<'a> {
    fn new(robot: &'a urdf_rs::Robot, tree: &'a Tree, motions: &'a [Motion]) -> Self {
        let mut order = Vec::with_capacity(robot.links.len());
        let mut stack = vec![tree.root];
        while let Some(link) = stack.pop() {
            order.push(link);
            stack.extend(tree.joints_below[link].iter().map(|joint| tree.ends[*joint].1));
        }
        let mut mass: Vec<f64> = robot.links.iter().map(|link| link.inertial.mass.value).collect();
        let mut moves = vec![false; robot.links.len()];
        for &link in order.iter().rev() {
            for &joint in &tree.joints_below[link] {
                let child = tree.ends[joint].1;
                mass[link] += mass[child];
                moves[link] |= moves[child] || matches!(motions[joint], Motion::Free(_));
            }
        }
        let total = mass[tree.root];
        Self { robot, tree, motions, mass, moves, total }
    }

    /// Whether a link has no mass to speak of, and no joint moves on it.
    fn is_empty(&self, link: usize) -> bool {
        let own = self.robot.links[link].inertial.mass.value;
        let is_free = |joint: &usize| matches!(self.motions[*joint], Motion::Free(_));
        (own == 0.0 || own < LIGHT * self.total) && !self.tree.joints_below[link].iter().any(is_free)
    }

    /// Joints below a link whose children can be the body: those that carry moving joints, or mass
    /// if nothing moves.
    fn bodies(&self, link: usize) -> Vec<usize> {
        let joints = &self.tree.joints_below[link];
        let child = |joint: &usize| self.tree.ends[*joint].1;
        let moving: Vec<usize> = joints.iter().copied().filter(|joint| self.moves[child(joint)]).collect();
        if !moving.is_empty() {
            return moving;
        }
        joints.iter().copied().filter(|joint| self.mass[child(joint)] > LIGHT * self.total).collect()
    }

    /// The joint between an empty link and the one body on it.
    fn body(&self, link: usize) -> Option<usize> {
        let [joint] = self.bodies(link)[..] else {
            return None;
        };
        let child = self.tree.ends[joint].1;
        let beside = self.mass[link] - self.mass[child];
        let has_shapes = !self.robot.links[link].collision.is_empty();
        (beside <= BESIDE * self.total && (self.moves[child] || !has_shapes)).then_some(joint)
    }

    /// Whether several links that carry limbs can be the body on an empty link without geometry.
    fn is_open(&self, link: usize) -> bool {
        let children = self.tree.joints_below[link].iter().map(|joint| self.tree.ends[*joint].1);
        self.robot.links[link].collision.is_empty() && children.filter(|child| self.moves[*child]).count() > 1
    }
}
