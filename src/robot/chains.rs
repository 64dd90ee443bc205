//! Chains of joints from the base to its ends, and the choice of legs among them.

use std::f64::consts::PI;

use glam::DVec3;

use super::feet;
use super::model::{JointKind, Model};
use super::pose::Pose;

/// Cosine above which an axis counts as lying along a base axis.
pub(super) const ALIGNED: f64 = 0.7;

/// Largest number of joints of a torso in a row.
const TORSO_JOINTS: usize = 3;

/// Share of the body's width that lies about its middle.
pub(super) const MIDDLE: f64 = 0.02;

/// A torso carries limbs that reach farther to both sides than this share of the body's width.
const ASIDE: f64 = 0.1;

/// Limbs that reach down to this share of the height above the lowest point stand on the ground.
const GROUND: f64 = 0.3;

/// A leg hangs stretched if it reaches this share of its length below its hip.
const STRETCHED: f64 = 0.7;

/// A limb whose first joint is higher above the torso's last joint than this share of its reach is
/// an arm.
const RAISED: f64 = 0.2;

/// Number of positions of a joint that are tried.
const ANGLES: u32 = 19;

/// Hip abduction, hip flexion and knee joint of a leg; some have no abduction.
pub(super) type LegJoints = [Option<usize>; 3];

/// Joints of a limb from the body to its end.
#[derive(Clone, Debug, Default)]
pub(super) struct LimbChain {
    /// Joints of the chain, at least one.
    pub joints: Vec<usize>,
    /// Joints that hang on the limb outside its chain: fingers, toes.
    pub twigs: Vec<usize>,
}

/// All joints of a robot.
#[derive(Clone, Debug, Default)]
pub(super) struct LimbChains {
    /// Joints between the base and limbs on both sides.
    pub torso: Vec<usize>,
    pub limbs: Vec<LimbChain>,
}

/// Pose of the robot's links with all joints at 0, in the base frame.
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

    /// Whether a joint turns.
    pub fn turns(&self, joint: usize) -> bool {
        self.model.joints[joint].kind != JointKind::Prismatic
    }

    /// All joints below `link`, parents first.
    pub fn joints_below(&self, link: usize) -> Vec<usize> {
        let mut below = Vec::new();
        let mut stack = vec![link];
        while let Some(link) = stack.pop() {
            let children: Vec<usize> = self.model.children(link).collect();
            below.extend(children.iter().map(|child| child - 1));
            stack.extend(children.into_iter().rev());
        }
        below.sort_unstable();
        below
    }

    /// The robot's limbs on the base and on its torso.
    pub fn limb_chains(&self) -> LimbChains {
        let farthest = (0..self.model.joints.len()).map(|joint| self.position(joint).y.abs()).fold(0.0, f64::max);
        let mut found = LimbChains::default();
        self.collect_limbs(0, farthest, &mut found);
        found
    }

    fn collect_limbs(&self, link: usize, width: f64, found: &mut LimbChains) {
        for child in self.model.children(link).collect::<Vec<_>>() {
            let mut path = vec![child - 1];
            let mut end = child;
            let branches = loop {
                let children: Vec<usize> = self.model.children(end).collect();
                let [only] = children[..] else {
                    break children;
                };
                path.push(only - 1);
                end = only;
            };
            let side = |sign: f64| {
                branches.iter().any(|branch| {
                    let own = self.joints_below(*branch).into_iter().chain([branch - 1]);
                    own.map(|joint| sign * self.position(joint).y).fold(0.0, f64::max) > ASIDE * width
                })
            };
            // where a joint about y lies along its axis says nothing
            let is_in_the_middle = path
                .iter()
                .all(|joint| self.position(*joint).y.abs() <= MIDDLE * width || self.axis(*joint).y.abs() > ALIGNED);
            if path.len() <= TORSO_JOINTS && is_in_the_middle && side(1.0) && side(-1.0) {
                found.torso.extend(path);
                self.collect_limbs(end, width, found);
                continue;
            }
            // where a limb branches, the longest branch goes on, and the others hang on it
            let mut twigs = self.joints_below(end);
            let longest = twigs
                .iter()
                .map(|joint| self.chain_to(joint + 1))
                .fold(Vec::new(), |longest, chain| if chain.len() > longest.len() { chain } else { longest });
            path.extend(longest.into_iter().filter(|joint| twigs.contains(joint)));
            twigs.retain(|joint| !path.contains(joint));
            found.limbs.push(LimbChain { joints: path, twigs });
        }
    }

    /// Limbs that stand on the ground: they reach down as far as the lowest one.
    pub fn grounded(&self, limbs: &[LimbChain]) -> Vec<usize> {
        let bottoms: Vec<f64> = limbs.iter().map(|limb| feet::lowest_below(self, limb.joints[0])).collect();
        let top = limbs.iter().map(|limb| self.position(limb.joints[0]).z).fold(f64::NEG_INFINITY, f64::max);
        let ground = bottoms.iter().copied().fold(f64::INFINITY, f64::min);
        let is_leg = |limb: &usize| {
            let reaches_down = bottoms[*limb] < self.position(limbs[*limb].joints[0]).z;
            reaches_down && bottoms[*limb] <= ground + GROUND * (top - ground)
        };
        (0..limbs.len()).filter(is_leg).collect()
    }

    /// Whether a limb hangs from above the joints of the torso that carries it: an arm that reaches
    /// the ground is no leg.
    pub fn hangs_above(&self, torso: &[usize], limb: &LimbChain) -> bool {
        let first = limb.joints[0];
        let Some(last) = self.chain_to(first + 1).into_iter().rev().find(|joint| torso.contains(joint)) else {
            return false;
        };
        let top = self.position(first).z;
        top - self.position(last).z > RAISED * (top - feet::lowest_below(self, first))
    }

    /// Hip abduction, hip flexion and knee of every chain that can be a leg of a body whose legs
    /// move in planes along it.
    ///
    /// A leg reaches below its first joint. Its joints turn about the base's x, y and y, or there
    /// are just two, about y and y; only when there are not as many such chains as wanted, any
    /// chain of exactly three turning joints will do.
    pub fn leg_candidates(&self, chains: &[Vec<usize>], wanted: usize) -> Vec<LegJoints> {
        let by_two = |turning: &[usize]| self.by_axes(turning).or_else(|| self.by_two(turning));
        let by_order = |turning: &[usize]| {
            let three = || turning.try_into().ok().map(|three: [usize; 3]| three.map(Some));
            self.by_axes(turning).or_else(three)
        };
        let hangs = |leg: &LegJoints| self.reaches_down(leg);
        let by_axes = self.candidates(chains, |turning| self.by_axes(turning), hangs);
        if by_axes.len() == wanted {
            return by_axes;
        }
        let grounds = self.grounds(chains);
        let stands = |leg: &LegJoints| hangs(leg) && grounds(leg);
        if by_axes.len() > wanted {
            // an arm on the back turns about the same axes
            let standing = self.candidates(chains, |turning| self.by_axes(turning), stands);
            if standing.len() == wanted {
                return standing;
            }
        }
        let stretches = |leg: &LegJoints| self.can_reach_down(leg);
        // the third and the fourth find legs that are folded with all joints at zero, the last one
        // those that turn about z before they swing
        for found in [
            self.candidates(chains, by_two, hangs),
            self.candidates(chains, by_order, hangs),
            self.candidates(chains, |turning| self.by_axes(turning), stretches),
            self.candidates(chains, by_two, stretches),
            self.candidates(chains, |turning| self.by_pitches(turning), stands),
        ] {
            if found.len() == wanted {
                return found;
            }
        }
        by_axes
    }

    fn candidates(
        &self,
        chains: &[Vec<usize>],
        pick: impl Fn(&[usize]) -> Option<LegJoints>,
        is_leg: impl Fn(&LegJoints) -> bool,
    ) -> Vec<LegJoints> {
        let mut legs = Vec::new();
        for chain in chains {
            let turning: Vec<usize> = chain.iter().copied().filter(|joint| self.turns(*joint)).collect();
            let Some(leg) = pick(&turning) else {
                continue;
            };
            // Chains that branch below the knee are one leg.
            if is_leg(&leg) && !legs.contains(&leg) {
                legs.push(leg);
            }
        }
        legs
    }

    /// The first joint about x and the next two about y.
    fn by_axes(&self, turning: &[usize]) -> Option<LegJoints> {
        let mut rest = turning.iter().copied();
        let hip = rest.find(|joint| self.axis(*joint).x.abs() > ALIGNED)?;
        let thigh = rest.find(|joint| self.axis(*joint).y.abs() > ALIGNED)?;
        let knee = rest.find(|joint| self.axis(*joint).y.abs() > ALIGNED)?;
        Some([Some(hip), Some(thigh), Some(knee)])
    }

    /// Two joints, both about y.
    fn by_two(&self, turning: &[usize]) -> Option<LegJoints> {
        match *turning {
            [thigh, knee] if turning.iter().all(|joint| self.axis(*joint).y.abs() > ALIGNED) => {
                Some([None, Some(thigh), Some(knee)])
            }
            _ => None,
        }
    }

    /// The first two joints about y, below one about z.
    fn by_pitches(&self, turning: &[usize]) -> Option<LegJoints> {
        let first = turning.first().filter(|joint| self.axis(**joint).z.abs() > ALIGNED)?;
        let mut pitches = turning.iter().copied().filter(|joint| joint != first && self.axis(*joint).y.abs() > ALIGNED);
        Some([None, Some(pitches.next()?), Some(pitches.next()?)])
    }

    /// Says whether a leg of these chains stands on the ground, as [`grounded`](Self::grounded).
    fn grounds(&self, chains: &[Vec<usize>]) -> impl Fn(&LegJoints) -> bool {
        let firsts = || chains.iter().filter_map(|chain| chain.first());
        let bottom = |joint: usize| feet::lowest_below(self, joint);
        let top = firsts().map(|joint| self.position(*joint).z).fold(f64::NEG_INFINITY, f64::max);
        let ground = firsts().map(|joint| bottom(*joint)).fold(f64::INFINITY, f64::min);
        move |leg| leg.iter().flatten().next().is_some_and(|first| bottom(*first) <= ground + GROUND * (top - ground))
    }

    fn reaches_down(&self, leg: &LegJoints) -> bool {
        let (Some(&hip), Some(&knee)) = (leg.iter().flatten().next(), leg.iter().flatten().next_back()) else {
            return false;
        };
        let lowest = match feet::find(self, knee, None) {
            Some(foot) => self.links[foot.link].transform_point(foot.point).z,
            None => self.position(knee).z,
        };
        lowest < self.position(hip).z
    }

    /// Whether hip and knee have positions within their limits in which the leg hangs stretched
    /// from the hip.
    fn can_reach_down(&self, leg: &LegJoints) -> bool {
        let (Some(hip), Some(knee)) = (leg[1], leg[2]) else {
            return false;
        };
        let (link, point) = match feet::find(self, knee, None) {
            Some(foot) => (foot.link, foot.point),
            None => (knee + 1, self.model.links[knee + 1].com),
        };
        let tip = self.links[link].transform_point(point);
        let length = self.position(hip).distance(self.position(knee)) + self.position(knee).distance(tip);
        let mut q = vec![0.0; self.model.joints.len()];
        let mut lowest = f64::INFINITY;
        for step in 0..(ANGLES * ANGLES) {
            for (joint, share) in [(hip, step / ANGLES), (knee, step % ANGLES)] {
                let own = &self.model.joints[joint];
                let (lower, upper) = (own.lower.max(-PI), own.upper.min(PI));
                q[joint] = lower + (upper - lower) * f64::from(share) / f64::from(ANGLES - 1);
            }
            let links = self.model.forward_kinematics(&q);
            lowest = lowest.min(links[link].transform_point(point).z - links[hip + 1].translation.z);
        }
        lowest < -STRETCHED * length
    }

    /// Whether `link` is the child of `joint` or hangs on it.
    pub fn is_below(&self, link: usize, joint: usize) -> bool {
        std::iter::successors(Some(link), |link| self.model.parent(*link)).any(|link| link == joint + 1)
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
