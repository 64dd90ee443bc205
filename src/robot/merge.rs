//! Merging of links on fixed and locked joints into the link that moves them.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap, HashMap};
use std::path::Path;

use glam::{DMat3, DVec3};
use urdf_rs::JointType;

use super::base::{Base, Bases, is_better};
use super::error::{Diagnosis, LOCK, RobotError, Topic, Warning, nearest_name};
use super::inertia::{InertiaFault, MassProperties, principal_moments};
use super::model::{Joint, JointKind, Link, LockedJoint, Model};
use super::plausible::implausible;
use super::pose::Pose;
use super::precision;
use super::shapes::bodies;
use super::tree::Tree;
use super::urdf::{Coupled, LoadOptions};
use crate::dynamics::MAX_DEPTH;

/// Numbers beyond this are no robot's, in any SI unit, and the engine's products of them overflow.
const LARGEST: f64 = 1e9;
/// Longest offset, largest shape or mesh, and farthest link of a robot, m: beyond it lie other
/// units alone. Robots in millimetres are read up to here, with a warning.
pub(super) const MAX_EXTENT: f64 = 1e3;
/// Smallest mass of a link that moves, kg: a milligram. The engine divides by it in single
/// precision.
const LIGHTEST: f64 = 1e-6;
/// Smallest principal moment of such a link, kg m^2: a millionth of that of a milligram's ball of 1
/// mm.
const SMALLEST_MOMENT: f64 = 1e-18;
/// Position limits beyond this, rad or m, are written for "none": 159 turns.
const FARTHEST: f64 = MAX_EXTENT;

/// Largest number of joints that mimic one another in a row.
const MAX_COUPLED: usize = 64;

/// Makes the model of a robot whose joints form `tree`; returns it with the positions of held
/// joints, which mimic others (rad or m).
///
/// # Errors
/// [`RobotError::Options`] for joints that cannot be locked, [`RobotError::Unsupported`] for kinds
/// of joints that are not modelled, [`RobotError::Value`] for axes and limits that mean nothing,
/// [`RobotError::Inertia`] for links that cannot move as rigid bodies.
pub(super) fn merge(
    robot: &urdf_rs::Robot,
    tree: &Tree,
    file: &Path,
    options: &LoadOptions,
    warnings: Vec<Warning>,
) -> Result<(Model, BTreeMap<String, f64>), RobotError> {
    let mut merger = Merger {
        robot,
        tree,
        file,
        options,
        held: vec![None; robot.joints.len()],
        places: Vec::new(),
        parts: Vec::new(),
        joints: Vec::new(),
        locked: Vec::new(),
        warnings,
    };
    merger.check_locks()?;
    let coupled = merger.hold_coupled();
    let motions = merger.motions()?;
    let bases = Bases::new(robot, tree, &motions, options.keeps_root);
    let warnings = std::mem::take(&mut merger.warnings);
    let mut base = &bases.candidates[0];
    let mut found = merger.model(base, &motions, warnings.clone())?;
    for other in &bases.candidates[1..] {
        let model = merger.model(other, &motions, warnings.clone())?;
        if is_better(&found, &model) {
            (found, base) = (model, other);
        }
    }
    precision::check(&found, file)?;
    found.warnings.extend(bases.notice(robot, tree, base, file));
    Ok((found, coupled))
}

struct Merger<'a> {
    robot: &'a urdf_rs::Robot,
    tree: &'a Tree,
    file: &'a Path,
    options: &'a LoadOptions,
    /// For each joint, where it is held, rad or m.
    held: Vec<Option<f64>>,
    /// For each URDF link, the merged link that carries it and its frame there.
    places: Vec<Option<(usize, Pose)>>,
    /// For each merged link, the URDF links it consists of, the one that names it first.
    parts: Vec<Vec<usize>>,
    joints: Vec<Joint>,
    locked: Vec<LockedJoint>,
    warnings: Vec<Warning>,
}

impl Merger<'_> {
    fn check_locks(&mut self) -> Result<(), RobotError> {
        for (name, &position) in &self.options.locked_joints {
            let element = format!("locked joint \"{name}\"");
            let error = |problem: String, remedy: String| {
                let diagnosis = Diagnosis::new(self.file, element.clone(), problem, remedy);
                Err(RobotError::Options(diagnosis))
            };
            let Some(index) = self.robot.joints.iter().position(|joint| joint.name == *name) else {
                let known = self.robot.joints.iter().map(|joint| joint.name.as_str());
                return error("does not exist".into(), nearest_name(name, known));
            };
            let joint = &self.robot.joints[index];
            let Some(kind) = moving_kind(&joint.joint_type) else {
                let problem = format!("a {:?} joint cannot be locked", joint.joint_type);
                return error(problem.to_lowercase(), "lock revolute, continuous or prismatic joints".into());
            };
            if !position.is_finite() {
                return error(format!("its position {position} is not finite"), "write rad or m".into());
            }
            let [lower, upper] = position_limits(joint, kind);
            self.locked.push(LockedJoint { name: name.clone(), position, lower, upper });
            if !(lower..=upper).contains(&position) {
                self.warnings.push(Warning::new(
                    self.file,
                    element,
                    format!("its position {position} is outside its limits {lower} .. {upper}"),
                    "check the unit: rad or m",
                ));
            }
            self.held[index] = Some(position);
        }
        Ok(())
    }

    /// Holds the joints that mimic others, if the options say so, and returns where.
    fn hold_coupled(&mut self) -> BTreeMap<String, f64> {
        let mut coupled = BTreeMap::new();
        if self.options.coupled == Coupled::Refused {
            return coupled;
        }
        let named: HashMap<&str, usize> =
            self.robot.joints.iter().enumerate().map(|(index, joint)| (joint.name.as_str(), index)).collect();
        for (index, joint) in self.robot.joints.iter().enumerate() {
            let Some(mimic) = joint.mimic.as_ref().filter(|_| moving_kind(&joint.joint_type).is_some()) else {
                continue;
            };
            if self.held[index].is_some() {
                continue;
            }
            let position = self.coupled_position(index, &named);
            coupled.insert(joint.name.clone(), position);
            let problem =
                format!("it mimics \"{}\"; coupled joints are not modelled, so it is held at {position}", mimic.joint);
            let remedy = "remove <mimic> to let it move by itself";
            let warning = Warning::new(self.file, format!("joint \"{}\"", joint.name), problem, remedy);
            self.warnings.push(warning.about(Topic::Coupled));
        }
        for (name, position) in &coupled {
            self.held[named[name.as_str()]] = Some(*position);
        }
        coupled
    }

    /// Position of a joint that mimics others, while the first of these is held or at rest, rad or
    /// m.
    fn coupled_position(&self, joint: usize, named: &HashMap<&str, usize>) -> f64 {
        // q = scale * (position of `leader`) + shift
        let (mut leader, mut scale, mut shift) = (joint, 1.0, 0.0);
        for _ in 0..MAX_COUPLED {
            let Some(mimic) = self.robot.joints[leader].mimic.as_ref().filter(|_| self.held[leader].is_none()) else {
                break;
            };
            let Some(&next) = named.get(mimic.joint.as_str()) else {
                break;
            };
            shift += scale * mimic.offset.unwrap_or(0.0);
            scale *= mimic.multiplier.unwrap_or(1.0);
            leader = next;
        }
        let at_rest = self.held[leader].unwrap_or_else(|| within_limits(&self.robot.joints[leader], 0.0));
        let position = within_limits(&self.robot.joints[joint], scale * at_rest + shift);
        // a negative zero becomes zero
        if position.is_finite() { position + 0.0 } else { 0.0 }
    }

    /// Reads the robot with this base.
    fn model(&mut self, base: &Base, motions: &[Motion], warnings: Vec<Warning>) -> Result<Model, RobotError> {
        self.places = vec![None; self.robot.links.len()];
        self.parts.clear();
        self.joints.clear();
        self.warnings = warnings;
        self.place_all(base, motions)?;
        let links = self.links(base)?;
        let bodies = bodies(self.robot, &self.joints, &self.places, self.file, self.options, &mut self.warnings);
        let mut model = Model {
            name: self.robot.name.clone(),
            source: self.file.to_path_buf(),
            links,
            joints: std::mem::take(&mut self.joints),
            bodies,
            locked: self.locked.clone(),
            warnings: std::mem::take(&mut self.warnings),
        };
        model.warnings.extend(implausible(self.robot, &model, &self.places, self.file));
        Ok(model)
    }

    /// Places every URDF link, and makes the joints in an order that puts parents first: of the
    /// joints whose parent is there already, the earliest of the file comes next.
    fn place_all(&mut self, base: &Base, motions: &[Motion]) -> Result<(), RobotError> {
        let mut ready = BinaryHeap::new();
        self.place_with_attached(base, motions, &mut ready);
        while let Some(Reverse(index)) = ready.pop() {
            let (parent, child) = self.tree.ends[index];
            if let (Motion::Free(kind), Some(place)) = (&motions[index], self.places[parent]) {
                let joint = self.moving_joint(&self.robot.joints[index], *kind, place)?;
                self.joints.push(joint);
                self.check_depth()?;
                self.place_with_attached(&Base::of(child), motions, &mut ready);
            }
        }
        Ok(())
    }

    /// Refuses a last joint that hangs on more joints than the engine can solve.
    fn check_depth(&self) -> Result<(), RobotError> {
        let above = |joint: &usize| self.joints[*joint].parent.checked_sub(1);
        let depth = std::iter::successors(self.joints.len().checked_sub(1), above).count();
        match self.joints.last() {
            Some(joint) if depth > MAX_DEPTH => Err(RobotError::Unsupported(Diagnosis::new(
                self.file,
                format!("joint \"{}\"", joint.name),
                format!("it is number {depth} in a chain of moving joints, of which {MAX_DEPTH} are modelled"),
                "make joints of the chain fixed, or lock them in locked_joints (--lock JOINT=POSITION)",
            ))),
            _ => Ok(()),
        }
    }

    /// Starts a merged link with the frame of `base`, collects all links that are fixed to it, and
    /// the moving joints on it.
    fn place_with_attached(&mut self, base: &Base, motions: &[Motion], ready: &mut BinaryHeap<Reverse<usize>>) {
        let merged = self.parts.len();
        let mut parts = Vec::new();
        // transform of the links above the base, applied last
        let mut above = Pose::IDENTITY;
        let mut tops: Vec<(usize, Pose)> = Vec::new();
        for &joint in &base.above {
            if let Motion::Attached(origin) = &motions[joint] {
                above = above * origin.inverse();
            }
            tops.push((self.tree.ends[joint].0, above));
        }
        tops.reverse();
        let mut stack = tops;
        stack.push((base.link, Pose::IDENTITY));
        while let Some((link, pose)) = stack.pop() {
            self.places[link] = Some((merged, pose));
            parts.push(link);
            for &joint in self.tree.joints_below[link].iter().rev().filter(|joint| !base.above.contains(joint)) {
                match &motions[joint] {
                    Motion::Attached(origin) => stack.push((self.tree.ends[joint].1, pose * *origin)),
                    Motion::Free(_) => ready.push(Reverse(joint)),
                    Motion::Dropped => {}
                }
            }
        }
        self.parts.push(parts);
    }

    /// Motion of the child of each joint.
    fn motions(&self) -> Result<Vec<Motion>, RobotError> {
        let motion = |(index, joint)| match self.tree.dropped_joint {
            Some(dropped) if dropped == index => Ok(Motion::Dropped),
            _ => self.motion(index, joint),
        };
        self.robot.joints.iter().enumerate().map(motion).collect()
    }

    fn motion(&self, index: usize, joint: &urdf_rs::Joint) -> Result<Motion, RobotError> {
        let origin = Pose::from_urdf(&joint.origin);
        if joint.joint_type == JointType::Fixed {
            return Ok(Motion::Attached(origin));
        }
        let Some(kind) = moving_kind(&joint.joint_type) else {
            let problem = format!("{:?} joints are not modelled", joint.joint_type);
            return Err(RobotError::Unsupported(Diagnosis::new(
                self.file,
                format!("joint \"{}\"", joint.name),
                problem.to_lowercase(),
                "make it fixed, or a chain of revolute and prismatic joints",
            )));
        };
        match self.held[index] {
            Some(position) => {
                let locked = kind.motion(self.axis(joint)?, position);
                Ok(Motion::Attached(origin * locked))
            }
            None => Ok(Motion::Free(kind)),
        }
    }

    fn axis(&self, joint: &urdf_rs::Joint) -> Result<DVec3, RobotError> {
        let axis = DVec3::from_array(*joint.axis.xyz);
        // squares of tiny numbers lose their digits, those of huge ones overflow
        (axis / axis.abs().max_element()).try_normalize().ok_or_else(|| {
            RobotError::Value(Diagnosis::new(
                self.file,
                format!("joint \"{}\", <axis xyz>", joint.name),
                format!("{axis} is no direction"),
                "write a unit vector in the joint's frame",
            ))
        })
    }

    fn moving_joint(
        &mut self,
        joint: &urdf_rs::Joint,
        kind: JointKind,
        (parent, parent_pose): (usize, Pose),
    ) -> Result<Joint, RobotError> {
        let element = format!("joint \"{}\"", joint.name);
        if let Some(mimic) = &joint.mimic {
            return Err(RobotError::Unsupported(Diagnosis::new(
                self.file,
                element,
                format!("it mimics \"{}\"; coupled joints are not modelled", mimic.joint),
                format!("remove <mimic>, or {LOCK}"),
            )));
        }
        let axis = self.axis(joint)?;
        let [lower, upper] = position_limits(joint, kind);
        let dynamics = joint.dynamics.clone().unwrap_or_default();
        let limit = |x: f64| if x > LARGEST { f64::INFINITY } else { x };
        let (effort, velocity) = (limit(joint.limit.effort), limit(joint.limit.velocity));
        let value_error = |problem: String, remedy: &str| {
            let diagnosis = Diagnosis::new(self.file, element.clone(), problem, remedy);
            Err(RobotError::Value(diagnosis))
        };
        // the limits of the file
        let (least, most) = (joint.limit.lower, joint.limit.upper);
        if lower > upper {
            return value_error(format!("its lower limit {least} is above its upper limit {most}"), "swap them");
        }
        if lower == f64::INFINITY || upper == f64::NEG_INFINITY {
            let problem = format!("its limits {least} .. {most} leave no position within {FARTHEST}");
            return value_error(problem, "write rad or m");
        }
        for (name, value) in
            [("effort", effort), ("velocity", velocity), ("damping", dynamics.damping), ("friction", dynamics.friction)]
        {
            if value < 0.0 {
                return value_error(format!("negative {name} {value}"), "write its magnitude");
            }
            if value > LARGEST && matches!(name, "damping" | "friction") {
                return value_error(format!("its {name} {value:e} overflows"), "write SI units");
            }
        }
        let origin = parent_pose * Pose::from_urdf(&joint.origin);
        if !origin.is_within(MAX_EXTENT) {
            let problem = format!("with the joints above, its origin lies beyond {MAX_EXTENT} m");
            return value_error(problem, "write metres");
        }
        let mut warn = |problem: String, remedy: &str| {
            self.warnings.push(Warning::new(self.file, element.clone(), problem, remedy));
        };
        let length = DVec3::from_array(*joint.axis.xyz).length();
        if (length - 1.0).abs() > 1e-6 {
            warn(format!("its axis has length {length} and is normalised"), "write a unit vector");
        }
        if kind != JointKind::Continuous && (lower.is_infinite() || upper.is_infinite()) {
            warn(format!("its position limits are {lower} .. {upper}"), "give <limit> a lower and an upper");
        }
        if lower == upper {
            warn(format!("it can only stay at {lower}"), "make it fixed, or lock it");
        }
        if effort == 0.0 {
            warn("zero effort: the joint cannot be driven".into(), "write its effort limit");
        }
        if velocity == 0.0 {
            warn("zero velocity: it counts as no limit".into(), "write its velocity limit");
        }
        Ok(Joint {
            name: joint.name.clone(),
            kind,
            parent,
            origin,
            axis,
            lower,
            upper,
            effort,
            velocity,
            damping: dynamics.damping,
            friction: dynamics.friction,
            armature: 0.0,
        })
    }

    fn links(&mut self, base: &Base) -> Result<Vec<Link>, RobotError> {
        let mut links = Vec::with_capacity(self.parts.len());
        let tops: Vec<usize> = base.above.iter().map(|joint| self.tree.ends[*joint].0).collect();
        for parts in std::mem::take(&mut self.parts) {
            let with_mass = parts.iter().filter(|part| self.robot.links[**part].inertial.mass.value > 0.0).count();
            let mut whole = MassProperties::ZERO;
            for &part in &parts {
                let own = mass_properties(&self.robot.links[part].inertial);
                if with_mass > 1 || own.mass == 0.0 {
                    self.warn_of_inertia(part, &own);
                }
                // an empty link above the base leaves its bits as they are
                let is_nothing = own.mass == 0.0 && own.inertia == DMat3::ZERO && tops.contains(&part);
                if let Some((_, place)) = self.places[part].filter(|_| !is_nothing) {
                    whole = whole.joined(&own.transformed(&place));
                }
            }
            let names = parts.iter().map(|part| self.robot.links[*part].name.clone());
            let mut names = names.collect::<Vec<_>>().into_iter();
            let link = Link {
                name: names.next().unwrap_or_default(),
                mass: whole.mass,
                com: whole.com,
                inertia: whole.inertia,
                merged: names.collect(),
            };
            self.check_inertia(&link, &whole)?;
            links.push(link);
        }
        Ok(links)
    }

    /// Warns of an unsound inertia of a part. It is no error: only the inertia of the whole link
    /// matters.
    fn warn_of_inertia(&mut self, link: usize, own: &MassProperties) {
        if own.inertia == DMat3::ZERO {
            return;
        }
        let problem = match own.inertia_fault() {
            Some(fault) => describe(fault),
            None if own.mass == 0.0 => "has an inertia, but no mass".to_string(),
            None => return,
        };
        self.warnings.push(Warning::new(
            self.file,
            format!("link \"{}\"", self.robot.links[link].name),
            problem,
            "correct it; it is merged as it is",
        ));
    }

    fn check_inertia(&mut self, link: &Link, whole: &MassProperties) -> Result<(), RobotError> {
        let element = format!("link \"{}\"", link.name);
        let error = |problem: String, remedy: &str| {
            let diagnosis = Diagnosis::new(self.file, element.clone(), problem, remedy);
            Err(RobotError::Inertia(diagnosis))
        };
        if !whole.is_within(LARGEST) {
            return error("its mass or inertia overflows".into(), "write SI units");
        }
        if whole.mass > 0.0 && whole.com.abs().max_element() > MAX_EXTENT {
            return error(format!("its centre of mass lies beyond {MAX_EXTENT} m"), "write metres");
        }
        if whole.mass <= 0.0 {
            return error(
                "it moves, but neither it nor anything fixed to it has a mass".into(),
                "give it an <inertial>, or make the joint above it fixed",
            );
        }
        if whole.mass < LIGHTEST {
            let problem =
                format!("its mass of {:e} kg is below {LIGHTEST:e}, which single precision loses", whole.mass);
            return error(problem, "write kilograms, or make the joint above it fixed");
        }
        match whole.inertia_fault() {
            None if principal_moments(&whole.inertia)[0] < SMALLEST_MOMENT => {
                let problem =
                    format!("its inertia has a moment below {SMALLEST_MOMENT:e} kg m^2, which single precision loses");
                error(problem, "write the inertia about the centre of mass, in kg m^2")
            }
            Some(fault @ InertiaFault::NotPositiveDefinite(_)) => {
                error(describe(fault), "write the inertia about the centre of mass, in kg m^2")
            }
            Some(fault) => {
                self.warnings.push(Warning::new(
                    self.file,
                    element,
                    describe(fault),
                    "correct it: no body of positive density has such an inertia",
                ));
                Ok(())
            }
            None => Ok(()),
        }
    }
}

/// Motion that a joint allows its child.
#[derive(Clone, Copy, Debug)]
pub(super) enum Motion {
    /// Nothing: it stays at this pose in the parent.
    Attached(Pose),
    /// Move in this way.
    Free(JointKind),
    /// Nothing: the joint stands for the free base.
    Dropped,
}

/// Lower and upper position limit of a joint; infinite where there is none.
fn position_limits(joint: &urdf_rs::Joint, kind: JointKind) -> [f64; 2] {
    let beyond = |x: f64| if x.abs() > FARTHEST { x.signum() * f64::INFINITY } else { x };
    match kind {
        JointKind::Continuous => [f64::NEG_INFINITY, f64::INFINITY],
        JointKind::Revolute | JointKind::Prismatic => [beyond(joint.limit.lower), beyond(joint.limit.upper)],
    }
}

/// The kind of a joint with one degree of freedom.
fn moving_kind(joint_type: &JointType) -> Option<JointKind> {
    match joint_type {
        JointType::Revolute => Some(JointKind::Revolute),
        JointType::Continuous => Some(JointKind::Continuous),
        JointType::Prismatic => Some(JointKind::Prismatic),
        JointType::Fixed | JointType::Floating | JointType::Planar | JointType::Spherical => None,
    }
}

/// The position within a joint's limits that is nearest to this one, rad or m.
fn within_limits(joint: &urdf_rs::Joint, position: f64) -> f64 {
    match joint.joint_type {
        JointType::Continuous => position,
        _ => position.max(joint.limit.lower).min(joint.limit.upper),
    }
}

pub(super) fn mass_properties(inertial: &urdf_rs::Inertial) -> MassProperties {
    let i = &inertial.inertia;
    let about_com = MassProperties {
        mass: inertial.mass.value,
        com: DVec3::ZERO,
        inertia: DMat3::from_cols_array_2d(&[[i.ixx, i.ixy, i.ixz], [i.ixy, i.iyy, i.iyz], [i.ixz, i.iyz, i.izz]]),
    };
    about_com.transformed(&Pose::from_urdf(&inertial.origin))
}

fn describe(fault: InertiaFault) -> String {
    match fault {
        InertiaFault::NotPositiveDefinite([a, b, c]) => {
            format!("its inertia is not positive definite (principal moments {a:.3e}, {b:.3e}, {c:.3e} kg m^2)")
        }
        InertiaFault::TriangleInequality([a, b, c]) => {
            format!("its inertia violates the triangle inequality (principal moments {a:.3e}, {b:.3e}, {c:.3e} kg m^2)")
        }
    }
}
