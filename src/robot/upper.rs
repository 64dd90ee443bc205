//! Arms, heads and tails: the limbs that are no legs.

use std::collections::BTreeSet;

use glam::DVec3;

use super::chains::{LimbChain, MIDDLE, ZeroPose};
use super::limbs::{LimbKind, Place};

/// A limb without a counterpart on the other side belongs to the middle if it begins, and has its
/// centre of mass, within this share of the body's width about the middle plane: necks are not
/// always quite in it.
const NEAR_MIDDLE: f64 = 0.25;
/// Counterparts agree in mass and length up to this share of the larger one, and lie mirrored up to
/// this share of the body's width.
const LARGEST_DIFFERENCE: f64 = 0.25;
/// A limb in the middle that reaches less far than this share of the arms is a head, whatever
/// number of joints it has.
const SHORT: f64 = 0.6;
/// Joints from which a limb in the middle of a body without arms is an arm. Necks of bodies on two
/// legs may have as many, all of them near the middle plane.
const ARM_JOINTS: usize = 3;

/// A limb that is no leg.
pub(super) struct UpperChain {
    pub joints: Vec<usize>,
    /// Joints that hang on the limb outside its chain.
    pub twigs: Vec<usize>,
    pub place: Place,
    pub kind: LimbKind,
}

/// A chain as it is compared with others.
struct Measured {
    joints: Vec<usize>,
    twigs: Vec<usize>,
    /// Position of the first joint, m.
    at: DVec3,
    /// Mass that the first joint carries, kg.
    mass: f64,
    /// Centre of mass of that, m.
    centre: DVec3,
    /// Farthest joint or centre of mass of a link from the first joint, m.
    reach: f64,
    /// 1 on the left, -1 on the right, 0 in the middle.
    side: f64,
    /// Place of its counterpart among the chains.
    partner: Option<usize>,
}

/// The limbs whose joints are not `taken`, counterparts on the left and on the right in the same
/// order. `legs` is the number of the body's legs.
pub(super) fn upper_chains(
    pose: &ZeroPose<'_>,
    chains: &[LimbChain],
    taken: &BTreeSet<usize>,
    legs: usize,
) -> Vec<UpperChain> {
    let width = (0..pose.model.joints.len()).map(|joint| pose.position(joint).y.abs()).fold(0.0, f64::max);
    let free =
        |joints: &[usize]| -> Vec<usize> { joints.iter().copied().filter(|joint| !taken.contains(joint)).collect() };
    let mut all: Vec<Measured> = chains
        .iter()
        .filter_map(|chain| measured(pose, free(&chain.joints), free(&chain.twigs), MIDDLE * width))
        .collect();
    find_partners(&mut all, width);
    let is_near = |y: f64| y.abs() <= NEAR_MIDDLE * width;
    for chain in &mut all {
        if chain.partner.is_none() && is_near(chain.at.y) && is_near(chain.centre.y) {
            chain.side = 0.0;
        }
    }
    // the right ones follow their counterparts
    let mut order: Vec<usize> = (0..all.len()).collect();
    order.sort_by_key(|&at| match all[at].partner {
        Some(partner) if all[at].side < 0.0 => (partner, 1),
        _ => (at, 0),
    });
    let arms = all.iter().filter(|chain| chain.partner.is_some()).map(|chain| chain.reach).fold(0.0, f64::max);
    let placed = |chain: &Measured| {
        let is_in_the_middle = chain.joints.iter().all(|joint| is_near(pose.position(*joint).y));
        let is_neck = (legs == 2 && is_in_the_middle) || chain.reach < SHORT * arms;
        if chain.side > 0.0 {
            (Place::Left, LimbKind::Arm)
        } else if chain.side < 0.0 {
            (Place::Right, LimbKind::Arm)
        } else if chain.joints.len() >= ARM_JOINTS && !is_neck {
            (Place::Arm, LimbKind::Arm)
        } else if chain.at.x < 0.0 && chain.at.z <= 0.1 {
            (Place::Tail, LimbKind::Tail)
        } else {
            (Place::Head, LimbKind::Head)
        }
    };
    let places: Vec<(Place, LimbKind)> = order.iter().map(|&at| placed(&all[at])).collect();
    let mut all: Vec<Option<Measured>> = all.into_iter().map(Some).collect();
    let chains = order.into_iter().filter_map(|at| all[at].take());
    chains
        .zip(places)
        .map(|(chain, (place, kind))| UpperChain { joints: chain.joints, twigs: chain.twigs, place, kind })
        .collect()
}

fn measured(pose: &ZeroPose<'_>, joints: Vec<usize>, twigs: Vec<usize>, middle: f64) -> Option<Measured> {
    let at = pose.position(*joints.first()?);
    let (mut mass, mut moment, mut reach) = (0.0, DVec3::ZERO, 0.0_f64);
    for joint in joints.iter().chain(&twigs) {
        let link = &pose.model.links[joint + 1];
        let centre = pose.links[joint + 1].transform_point(link.com);
        mass += link.mass;
        moment += centre * link.mass;
        reach = reach.max(centre.distance(at)).max(pose.position(*joint).distance(at));
    }
    let side = if at.y.abs() > middle { at.y.signum() } else { 0.0 };
    let centre = if mass > 0.0 { moment / mass } else { at };
    Some(Measured { joints, twigs, at, mass, centre, reach, side, partner: None })
}

/// Finds pairs of chains on both sides that agree in number of joints, mass, length and place, the
/// nearest images first.
fn find_partners(all: &mut [Measured], width: f64) {
    let similar = |a: f64, b: f64| (a - b).abs() <= LARGEST_DIFFERENCE * a.max(b);
    let mirrored = |point: DVec3| DVec3::new(point.x, -point.y, point.z);
    let mut pairs = Vec::new();
    for (i, left) in all.iter().enumerate().filter(|(_, chain)| chain.side > 0.0) {
        for (j, right) in all.iter().enumerate().filter(|(_, chain)| chain.side < 0.0) {
            let apart = left.at.distance(mirrored(right.at));
            let agree = left.joints.len() == right.joints.len()
                && similar(left.mass, right.mass)
                && similar(left.reach, right.reach)
                && apart <= LARGEST_DIFFERENCE * width;
            if agree {
                pairs.push((apart + left.centre.distance(mirrored(right.centre)), i, j));
            }
        }
    }
    pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
    for (_, i, j) in pairs {
        if all[i].partner.is_none() && all[j].partner.is_none() {
            all[i].partner = Some(j);
            all[j].partner = Some(i);
        }
    }
}
