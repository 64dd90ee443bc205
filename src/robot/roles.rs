//! Limbs, the roles of their joints, and feet, by geometry.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec3;
use serde::Deserialize;

use super::chains::{LimbChain, ZeroPose};
use super::error::{Diagnosis, RobotError, nearest_name};
use super::feet;
use super::folded;
use super::limbs::{Foot, Limb, LimbJoint, LimbKind, Place, Role, Roles, Side, Slot};
use super::model::Model;
use super::quadruped::{self, CANONICAL_JOINT_NAMES, CORNERS, LEG_ROLES};
use super::upper::{UpperChain, upper_chains};

/// Number of chains that an error lists.
const LISTED: usize = 12;

/// Part of the robot that a contact body belongs to; terms name it in configs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BodyGroup {
    /// Part of the base link.
    Base,
    /// Part of the torso: a link between the base and other limbs.
    Torso,
    /// Part of a leg above the thigh.
    Hip,
    /// Part of a leg above the knee.
    Thigh,
    /// Part of a leg below the knee, without the foot.
    Shank,
    /// The foot of a leg.
    Foot,
    /// Part of an arm.
    Arm,
    /// Part of a head.
    Head,
    /// None of these; configs cannot name it.
    #[serde(skip)]
    Other,
}

/// Names that a config gives to joints and feet.
#[derive(Default)]
pub(super) struct Overrides {
    pub joints: BTreeMap<Slot, usize>,
    pub feet: BTreeMap<Place, usize>,
}

/// Finds limbs, joint roles and feet from a robot's geometry at zero joint positions.
///
/// Two legs make a biped (a humanoid, with arms), four a quadruped, six a hexapod.
/// `joint_overrides` maps slots to joint names, `foot_overrides` the places of legs to contact
/// bodies. A quadruped's leg whose joints are all named is taken as it is; where all joints of the
/// robot are named, geometry is not asked.
///
/// # Errors
/// [`RobotError::Options`] for overrides that name nothing, [`RobotError::Roles`] when there are
/// not two, four or six legs, their places cannot be told, or a leg has no foot; it lists what was
/// found.
pub fn detect(
    model: &Model,
    joint_overrides: &BTreeMap<String, String>,
    foot_overrides: &BTreeMap<String, String>,
) -> Result<Roles, RobotError> {
    let pose = ZeroPose::new(model);
    let named = Overrides { joints: named_joints(model, joint_overrides)?, feet: named_feet(model, foot_overrides)? };
    refuse_shared_joints(&pose, named.joints.iter().map(|(slot, joint)| (*slot, *joint)))?;
    let is_quadrupeds = |slot: &Slot| CORNERS.contains(&slot.place) && LEG_ROLES.contains(&slot.role);
    let all_named = !model.joints.is_empty()
        && (0..model.joints.len()).all(|joint| named.joints.values().any(|named| *named == joint));
    let limbs =
        if all_named && !named.joints.keys().all(is_quadrupeds) { Vec::new() } else { found_limbs(&pose, &named)? };
    let limbs = with_named(&pose, number(limbs), &named)?;
    let limbs = limbs.into_iter().map(|limb| finish(&pose, limb, &named)).collect::<Result<Vec<_>, _>>()?;
    refuse_shared_joints(
        &pose,
        limbs.iter().flat_map(|limb| limb.joints.iter().map(|joint| (joint.slot, joint.joint))),
    )?;
    for place in named.feet.keys() {
        if !limbs.iter().any(|limb| limb.kind == LimbKind::Leg && limb.place == *place) {
            let legs: Vec<&str> =
                limbs.iter().filter(|limb| limb.kind == LimbKind::Leg).map(|limb| limb.place.name()).collect();
            let remedy = nearest_name(place.name(), legs.iter().copied());
            return Err(option_error(model, "feet", place.name(), "is no leg of this robot", remedy));
        }
    }
    let mut roles = Roles::new(limbs);
    roles.zero_of_slot = folded::zeros(&pose, &roles);
    Ok(roles)
}

/// The group of each of [`Model::bodies`].
pub fn body_groups(model: &Model, roles: &Roles) -> Vec<BodyGroup> {
    let mut own = vec![None; model.links.len()];
    for limb in &roles.limbs {
        let knee = limb.joints.iter().position(|joint| joint.slot.role.is_knee());
        for (at, joint) in limb.joints.iter().enumerate() {
            own[joint.joint + 1] = Some(match limb.kind {
                LimbKind::Leg => match knee {
                    Some(knee) if at + 1 < knee => BodyGroup::Hip,
                    Some(knee) if at + 1 == knee => BodyGroup::Thigh,
                    Some(_) => BodyGroup::Shank,
                    None => BodyGroup::Thigh,
                },
                LimbKind::Arm => BodyGroup::Arm,
                LimbKind::Torso => BodyGroup::Torso,
                LimbKind::Head => BodyGroup::Head,
                LimbKind::Tail => BodyGroup::Other,
            });
        }
    }
    let group_of_link = |link: usize| {
        let above = |link: &usize| model.parent(*link);
        let mut links = std::iter::successors(Some(link), above);
        links.find_map(|link| own[link]).unwrap_or(BodyGroup::Other)
    };
    let bodies = model.bodies.iter().enumerate();
    bodies
        .map(|(index, body)| match body.link {
            _ if roles.foot_body.contains(&index) => BodyGroup::Foot,
            0 => BodyGroup::Base,
            link => group_of_link(link),
        })
        .collect()
}

/// A limb before its joints are numbered within their roles.
struct RawLimb {
    place: Place,
    kind: LimbKind,
    joints: Vec<(usize, Role)>,
}

fn named_joints(model: &Model, overrides: &BTreeMap<String, String>) -> Result<BTreeMap<Slot, usize>, RobotError> {
    let mut named = BTreeMap::new();
    for (canonical, name) in overrides {
        let slot = Slot::parse(canonical).ok_or_else(|| {
            let remedy = nearest_name(canonical, CANONICAL_JOINT_NAMES);
            option_error(model, "joint_roles", canonical, "is no canonical joint", remedy)
        })?;
        let joint = model.joint_index(name).ok_or_else(|| {
            let known = model.joints.iter().map(|joint| joint.name.as_str());
            let problem = format!("names \"{name}\", which is no moving joint");
            option_error(model, "joint_roles", canonical, problem, nearest_name(name, known))
        })?;
        named.insert(slot, joint);
    }
    Ok(named)
}

fn named_feet(model: &Model, overrides: &BTreeMap<String, String>) -> Result<BTreeMap<Place, usize>, RobotError> {
    let mut named = BTreeMap::new();
    for (leg, name) in overrides {
        let is_leg = |place: &Place| place.side() != Side::Middle;
        let known = || Place::ALL.into_iter().filter(is_leg).map(Place::name);
        let place = Place::parse(leg).filter(is_leg).ok_or_else(|| {
            option_error(model, "feet", leg, "is no leg", nearest_name(leg, known().collect::<Vec<_>>()))
        })?;
        let bodies = &model.bodies;
        let body = bodies.iter().position(|body| body.name == *name);
        let body = body.ok_or_else(|| {
            let known = bodies.iter().map(|body| body.name.as_str());
            let problem = format!("names \"{name}\", which is no link with collision shapes");
            option_error(model, "feet", leg, problem, nearest_name(name, known))
        })?;
        named.insert(place, body);
    }
    Ok(named)
}

/// Limbs by geometry. A quadruped's joints that are named are taken into account; others are put in
/// afterwards.
fn found_limbs(pose: &ZeroPose<'_>, named: &Overrides) -> Result<Vec<RawLimb>, RobotError> {
    let chains = pose.limb_chains();
    let mut legs = pose.grounded(&chains.limbs);
    // a limb without a knee is no leg, nor is an arm
    legs.retain(|leg| {
        let chain = &chains.limbs[*leg];
        if pose.hangs_above(&chains.torso, chain) {
            return false;
        }
        pose.biped_leg(&chain.joints).contains(&Role::Knee) || pose.points_away(&chain.joints, tip(pose, chain))
    });
    let feet: Vec<DVec3> = legs.iter().map(|leg| tip(pose, &chains.limbs[*leg])).collect();
    let radial = |at: usize| pose.points_away(&chains.limbs[legs[at]].joints, feet[at]);
    let is_quadruped = named.joints.keys().any(|slot| LEG_ROLES.contains(&slot.role) && CORNERS.contains(&slot.place));
    let mut limbs = Vec::new();
    let mut taken: BTreeSet<usize> = chains.torso.iter().copied().collect();
    let places = match legs.len() {
        2 if !is_quadruped => Some(sides(pose, &chains.limbs, &legs, &feet)?),
        6 if !is_quadruped => Some(sides(pose, &chains.limbs, &legs, &feet)?),
        4 if !is_quadruped && (0..4).all(radial) => Some(sides(pose, &chains.limbs, &legs, &feet)?),
        _ => None,
    };
    let Some(places) = places else {
        let corner_legs = quadruped::legs(pose, named)?;
        let corner_slots = CORNERS.into_iter().zip(&corner_legs).flat_map(|(place, leg)| {
            LEG_ROLES.into_iter().zip(leg).filter_map(move |(role, joint)| Some((Slot::new(place, role), (*joint)?)))
        });
        refuse_shared_joints(pose, corner_slots)?;
        for (place, leg) in CORNERS.into_iter().zip(&corner_legs) {
            let own = leg.iter().flatten().copied().collect::<Vec<usize>>();
            let of_chain = chains.limbs.iter().find(|chain| leg[2].is_some_and(|knee| chain.joints.contains(&knee)));
            let mut joints: Vec<usize> = of_chain.map(|chain| chain.joints.clone()).unwrap_or_default();
            joints.retain(|joint| !corner_legs.iter().any(|other| other != leg && other.contains(&Some(*joint))));
            joints.extend(own.iter().filter(|joint| !joints.contains(joint)).copied().collect::<Vec<_>>());
            joints.sort_unstable();
            let roles = pose.quadruped_leg(&joints, leg);
            let mut joints: Vec<(usize, Role)> = joints.into_iter().zip(roles).collect();
            joints.extend(of_chain.iter().flat_map(|chain| &chain.twigs).map(|joint| (*joint, Role::Toe)));
            joints.retain(|(joint, _)| own.contains(joint) || taken.insert(*joint));
            taken.extend(own);
            limbs.push(RawLimb { place, kind: LimbKind::Leg, joints });
        }
        add_upper_limbs(pose, &chains.torso, &chains.limbs, &taken, &mut limbs);
        return Ok(limbs);
    };
    for (at, place) in places.into_iter().enumerate() {
        let chain = &chains.limbs[legs[at]];
        let roles = match pose.lift_axis(&chain.joints, feet[at]) {
            Some(lift) if legs.len() > 2 && radial(at) => pose.radial_leg(&chain.joints, lift),
            _ if legs.len() > 2 => {
                let known = pose.leg_candidates(std::slice::from_ref(&chain.joints), 1);
                pose.quadruped_leg(&chain.joints, &known.first().copied().unwrap_or_default())
            }
            _ => pose.biped_leg(&chain.joints),
        };
        let mut joints: Vec<(usize, Role)> = chain.joints.iter().copied().zip(roles).collect();
        joints.extend(chain.twigs.iter().map(|joint| (*joint, Role::Toe)));
        taken.extend(joints.iter().map(|(joint, _)| *joint));
        limbs.push(RawLimb { place, kind: LimbKind::Leg, joints });
    }
    add_upper_limbs(pose, &chains.torso, &chains.limbs, &taken, &mut limbs);
    Ok(limbs)
}

/// End of a leg in the base frame, m.
fn tip(pose: &ZeroPose<'_>, chain: &LimbChain) -> DVec3 {
    let foot = chain.joints.iter().rev().find_map(|joint| feet::find(pose, *joint, None));
    match (foot, chain.joints.last()) {
        (Some(foot), _) => pose.links[foot.link].transform_point(foot.point),
        (None, Some(last)) => pose.position(*last),
        (None, None) => DVec3::ZERO,
    }
}

/// The places of two, four or six legs, half of them on the left, from the front to the back.
fn sides(pose: &ZeroPose<'_>, chains: &[LimbChain], legs: &[usize], feet: &[DVec3]) -> Result<Vec<Place>, RobotError> {
    use Place::{Left, LeftFront, LeftHind, LeftMiddle, Right, RightFront, RightHind, RightMiddle};
    let (left, right): (&[Place], &[Place]) = match legs.len() {
        2 => (&[Left], &[Right]),
        4 => (&[LeftFront, LeftHind], &[RightFront, RightHind]),
        _ => (&[LeftFront, LeftMiddle, LeftHind], &[RightFront, RightMiddle, RightHind]),
    };
    let mean = feet.iter().sum::<DVec3>() / feet.len() as f64;
    let spread = feet.iter().map(|foot| foot.distance(mean)).fold(0.0, f64::max);
    let mut places = vec![Left; legs.len()];
    for (side, names) in [(1.0, left), (-1.0, right)] {
        let mut own: Vec<usize> = (0..legs.len()).filter(|at| side * (feet[*at].y - mean.y) > 0.02 * spread).collect();
        own.sort_by(|a, b| feet[*b].x.total_cmp(&feet[*a].x));
        if own.len() != names.len() {
            let found: Vec<&[usize]> = legs.iter().map(|leg| &chains[*leg].joints[..]).collect();
            return Err(roles_error(
                pose,
                "<robot>",
                format!("there are not as many legs on the left as on the right: {}", list(pose, &found)),
                "let the base frame have x forward and y left, or name all joints in joint_roles (--role SLOT=JOINT of robot new)",
            ));
        }
        for (at, place) in own.into_iter().zip(names) {
            places[at] = *place;
        }
    }
    Ok(places)
}

/// Torso, arms, heads and tails.
fn add_upper_limbs(
    pose: &ZeroPose<'_>,
    torso: &[usize],
    chains: &[LimbChain],
    taken: &BTreeSet<usize>,
    limbs: &mut Vec<RawLimb>,
) {
    if !torso.is_empty() {
        let joints = torso.iter().copied().zip(pose.middle_limb(torso)).collect();
        limbs.push(RawLimb { place: Place::Torso, kind: LimbKind::Torso, joints });
    }
    let legs = limbs.iter().filter(|limb| limb.kind == LimbKind::Leg).count();
    for UpperChain { joints, twigs, place, kind } in upper_chains(pose, chains, taken, legs) {
        let roles = if place.side() == Side::Middle { pose.middle_limb(&joints) } else { pose.arm(&joints) };
        let mut joints: Vec<(usize, Role)> = joints.into_iter().zip(roles).collect();
        let of_twig = |joint: usize| match kind {
            LimbKind::Arm => (joint, Role::Finger),
            _ => (joint, pose.middle_limb(&[joint])[0]),
        };
        joints.extend(twigs.into_iter().map(of_twig));
        limbs.push(RawLimb { place, kind, joints });
    }
}

/// Numbers the joints of each role and place.
fn number(limbs: Vec<RawLimb>) -> Vec<Limb> {
    let mut next: BTreeMap<(Place, Role), u8> = BTreeMap::new();
    let limbs = limbs.into_iter().map(|RawLimb { place, kind, joints }| {
        let joints = joints.into_iter().map(|(joint, role)| {
            let nth = next.entry((place, role)).or_default();
            let slot = Slot { role, nth: *nth, place };
            *nth = nth.saturating_add(1);
            LimbJoint { joint, slot, sign: 1.0 }
        });
        Limb { place, kind, joints: joints.collect(), foot: None }
    });
    limbs.collect()
}

/// The limbs with the named joints in their slots.
fn with_named(pose: &ZeroPose<'_>, mut limbs: Vec<Limb>, named: &Overrides) -> Result<Vec<Limb>, RobotError> {
    let is_named = |joint: usize| named.joints.values().any(|named| *named == joint);
    for limb in &mut limbs {
        limb.joints.retain(|joint| !is_named(joint.joint));
    }
    for (&slot, &joint) in &named.joints {
        let kind = slot.limb_kind();
        if let Some(other) = limbs.iter().flat_map(|limb| &limb.joints).find(|other| other.slot == slot) {
            return Err(roles_error(
                pose,
                format!("joint \"{}\"", pose.model.joints[joint].name),
                format!("and {} are both {slot}", pose.model.joints[other.joint].name),
                "give each of them its own canonical joint in joint_roles, or lock one in locked_joints",
            ));
        }
        let joint = LimbJoint { joint, slot, sign: 1.0 };
        match limbs.iter_mut().find(|limb| limb.place == slot.place && limb.kind == kind) {
            Some(limb) => limb.joints.push(joint),
            None => limbs.push(Limb { place: slot.place, kind, joints: vec![joint], foot: None }),
        }
    }
    limbs.retain(|limb| !limb.joints.is_empty());
    for limb in &mut limbs {
        // a parent's index is below its children's
        limb.joints.sort_by_key(|joint| (matches!(joint.slot.role, Role::Toe | Role::Finger), joint.joint));
    }
    Ok(limbs)
}

/// The limb with its foot and the signs of its joints.
fn finish(pose: &ZeroPose<'_>, mut limb: Limb, named: &Overrides) -> Result<Limb, RobotError> {
    let chain: Vec<usize> = limb.joints.iter().map(|joint| joint.joint).collect();
    if limb.kind == LimbKind::Leg {
        limb.foot = Some(foot(pose, &limb, named.feet.get(&limb.place).copied())?);
    }
    let lift = pose.lift_of(&limb);
    for joint in &mut limb.joints {
        joint.sign = pose.sign(joint.joint, joint.slot.role, &chain, lift);
    }
    Ok(limb)
}

fn foot(pose: &ZeroPose<'_>, limb: &Limb, named: Option<usize>) -> Result<Foot, RobotError> {
    let model = pose.model;
    let (place, first) = (limb.place.name(), limb.joints[0].joint);
    if let Some(body) = named
        && !pose.is_below(model.bodies[body].link, first)
    {
        let problem = format!("\"{}\" is not on this leg", model.bodies[body].name);
        return Err(option_error(model, "feet", place, problem, "name a body of the leg".to_string()));
    }
    let knee = limb.joints.iter().find(|joint| joint.slot.role == Role::Kfe).map(|joint| joint.joint);
    // on a leg with an ankle, bodies above the ankle are no feet
    let ankle = limb.joints.iter().position(|joint| joint.slot.role == Role::AnklePitch).unwrap_or(0);
    let chain = limb.joints[ankle..].iter().rev().filter(|joint| joint.slot.role != Role::Toe).map(|joint| joint.joint);
    let found = match knee {
        Some(knee) => feet::find(pose, knee, named),
        None => chain.clone().find_map(|joint| feet::find(pose, joint, named)),
    };
    let Some(found) = found else {
        let last = knee.or_else(|| chain.clone().next()).unwrap_or(first);
        let shank = named.map_or_else(|| &model.links[last + 1].name, |body| &model.bodies[body].name);
        return Err(roles_error(
            pose,
            format!("link \"{shank}\""),
            format!("leg {place} has no collision shape for a foot there"),
            "add a <collision> with a <sphere>, or name the foot's link in feet (--foot LEG=LINK of robot new)",
        ));
    };
    // a sole is larger than the point farthest from the knee
    let sole = if knee.is_some() { None } else { feet::sole(pose, found.body) };
    let (point, radius) = sole.unwrap_or((found.point, found.radius));
    Ok(Foot { body: found.body, point, radius })
}

fn refuse_shared_joints(pose: &ZeroPose<'_>, slots: impl Iterator<Item = (Slot, usize)>) -> Result<(), RobotError> {
    let mut all: Vec<(Slot, usize)> = slots.collect();
    all.sort_unstable();
    let mut slot_of: BTreeMap<usize, Slot> = BTreeMap::new();
    for (slot, joint) in all {
        if let Some(other) = slot_of.insert(joint, slot) {
            return Err(roles_error(
                pose,
                format!("joint \"{}\"", pose.model.joints[joint].name),
                format!("is both {other} and {slot}"),
                "give each canonical joint its own joint in joint_roles",
            ));
        }
    }
    Ok(())
}

pub(super) fn list<C: AsRef<[usize]>>(pose: &ZeroPose<'_>, chains: &[C]) -> String {
    if chains.is_empty() {
        return "it has no chains of moving joints".to_string();
    }
    let mut listed: Vec<String> = chains.iter().take(LISTED).map(|chain| pose.describe(chain.as_ref())).collect();
    if chains.len() > LISTED {
        listed.push(format!("and {} more", chains.len() - LISTED));
    }
    listed.join(", ")
}

fn option_error(model: &Model, table: &str, key: &str, problem: impl Into<String>, remedy: String) -> RobotError {
    let element = format!("{table}.{key}");
    RobotError::Options(Diagnosis::new(&model.source, element, problem, remedy))
}

pub(super) fn roles_error(
    pose: &ZeroPose<'_>,
    element: impl Into<String>,
    problem: String,
    remedy: &str,
) -> RobotError {
    RobotError::Roles(Diagnosis::new(&pose.model.source, element, problem, remedy))
}
