//! Chains of joints from the base to its ends, and which of them can be legs.

use glam::DVec3;

use super::feet;
use super::model::{JointKind, Model};
use super::pose::Pose;

/// Cosine above which an axis counts as lying along a base axis.
const ALIGNED: f64 = 0.7;

/// Where the robot's links are when all joints are 0, in the base frame.
pub(super) struct ZeroPose<'a> {
    pub model: &'a Model,
    pub links: Vec<Pose>,
}

impl<'a> ZeroPose<'a> {
    pub fn new(model: &'a Model) -> Self {
        Self { model, links: model.forward_kinematics(&[]) }
    }

    /// Origin of a joint in the base frame, m.
    pub fn position(&self, joint: usize) -> DVec3 {
        self.links[joint + 1].translation
    }

    /// Axis of a joint in the base frame.
    pub fn axis(&self, joint: usize) -> DVec3 {
        self.links[joint + 1].rotation * self.model.joints[joint].axis
    }

    /// Joints from the base to every link that carries no further joint.
    pub fn chains(&self) -> Vec<Vec<usize>> {
        let is_end = |link: &usize| *link != 0 && self.model.children(*link).next().is_none();
        let ends = (0..self.model.links.len()).filter(is_end);
        ends.map(|end| self.chain_to(end)).collect()
    }

    /// Joints from the base to `link`.
    pub fn chain_to(&self, link: usize) -> Vec<usize> {
        let above = |link: &usize| self.model.parent(*link).filter(|parent| *parent != 0);
        let first = Some(link).filter(|link| *link != 0);
        let mut joints: Vec<usize> = std::iter::successors(first, above).map(|link| link - 1).collect();
        joints.reverse();
        joints
    }

    /// Hip abduction, hip flexion and knee of every chain that can be a leg.
    ///
    /// A leg reaches below its first joint. Its joints turn about the base's x, y and y; only
    /// when there are not four such chains, any chain of exactly three turning joints will do.
    pub fn leg_candidates(&self, chains: &[Vec<usize>], wanted: usize) -> Vec<[usize; 3]> {
        let by_axes = self.candidates(chains, |turning| self.by_axes(turning));
        if by_axes.len() == wanted {
            return by_axes;
        }
        let by_order = self.candidates(chains, |turning| self.by_axes(turning).or_else(|| turning.try_into().ok()));
        if by_order.len() == wanted { by_order } else { by_axes }
    }

    fn candidates(&self, chains: &[Vec<usize>], pick: impl Fn(&[usize]) -> Option<[usize; 3]>) -> Vec<[usize; 3]> {
        let mut legs = Vec::new();
        for chain in chains {
            let turns = |joint: &usize| self.model.joints[*joint].kind != JointKind::Prismatic;
            let turning: Vec<usize> = chain.iter().copied().filter(turns).collect();
            let Some(leg) = pick(&turning) else {
                continue;
            };
            // Chains that part below the knee are one leg.
            if self.reaches_down(&leg) && !legs.contains(&leg) {
                legs.push(leg);
            }
        }
        legs
    }

    /// The first joint about x and the next two about y.
    fn by_axes(&self, turning: &[usize]) -> Option<[usize; 3]> {
        let mut rest = turning.iter().copied();
        let hip = rest.find(|joint| self.axis(*joint).x.abs() > ALIGNED)?;
        let thigh = rest.find(|joint| self.axis(*joint).y.abs() > ALIGNED)?;
        let knee = rest.find(|joint| self.axis(*joint).y.abs() > ALIGNED)?;
        Some([hip, thigh, knee])
    }

    fn reaches_down(&self, [hip, _, knee]: &[usize; 3]) -> bool {
        let lowest = match feet::find(self, *knee, None) {
            Some(foot) => self.links[foot.link].transform_point(foot.point).z,
            None => self.position(*knee).z,
        };
        lowest < self.position(*hip).z
    }

    /// Whether `link` is the child of `joint` or hangs on it.
    pub fn is_below(&self, link: usize, joint: usize) -> bool {
        self.chain_to(link).contains(&joint)
    }

    /// The joints of a chain with their axes and the position of the first, for error messages.
    pub fn describe(&self, chain: &[usize]) -> String {
        let joints: Vec<String> = chain
            .iter()
            .map(|joint| {
                let axis = self.axis(*joint);
                let name = &self.model.joints[*joint].name;
                format!("{name} about ({:.2}, {:.2}, {:.2})", axis.x, axis.y, axis.z)
            })
            .collect();
        let at = chain.first().map_or(DVec3::ZERO, |joint| self.position(*joint));
        format!("[{}] from ({:.3}, {:.3}, {:.3})", joints.join(" -> "), at.x, at.y, at.z)
    }
}
