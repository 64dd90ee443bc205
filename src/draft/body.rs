//! Standing poses, from the URDF alone, for bodies of any class but quadrupeds of twelve joints.

use std::ops::RangeInclusive;

use glam::{DMat3, DVec3};

use super::stance::{GRAVITY, REACHED, ROUNDS, centre_of_mass, nearest_to_zero, range};
use crate::robot::{Limb, LimbKind, Model, Place, Pose, Role, Roles};

/// Share of a leg's length by which the foot lies below the hip: of four legs or more as of
/// quadrupeds of twelve joints, of two legs on soles and on points. Humanoids of `configs/robots`
/// stand at 0.92 to 0.98.
const CROUCH: f64 = 0.72;
const ON_SOLES: f64 = 0.93;
const ON_POINTS: f64 = 0.9;
/// Other places for feet that do not reach theirs, tried in turn: shares of that height, and of the
/// way from below the hips to below the centre of mass, which a sole need not have in its middle.
const OTHER_PLACES: [(f64, f64); 6] = [(1.0, 0.5), (1.0, 0.0), (0.95, 1.0), (0.95, 0.5), (0.95, 0.0), (0.9, 0.5)];
/// Angle by which the thighs of a leg that points away from the body are raised, rad, and the least
/// share of its length by which the foot then lies below the hip. PhantomX stands so.
const RAISED: f64 = 0.4;
const CLEARANCE: f64 = 0.35;
/// Knee angle that the search for a pose begins with, rad: of two legs, and of more.
const KNEES: [f64; 2] = [0.8, 1.4];
/// Weight of the distance from the start of the search, per rad, against a foot's distance in leg
/// lengths.
const REST: f64 = 1e-3;
const ITERATIONS: u32 = 80;
/// Step of the difference quotients, rad.
const DIFFERENCE: f64 = 1e-6;
/// An arm hangs if its centre of mass lies below the shoulder by this share of its distance.
const HANGS: f64 = 0.8;
/// Angles of hip and knee, each, with which a search begins.
const STARTS: u32 = 24;
/// Angles of a shoulder that are tried.
const ANGLES: u32 = 32;

/// A pose in which all feet stand level below the body, soles flat, and arms hang.
pub(super) struct Standing {
    /// Joint positions, the robot's own order and directions, rad.
    pub q: Vec<f64>,
    /// Distance of each leg's foot from where it should be, m.
    pub misses: Vec<(Place, f64)>,
    /// Height of the base frame above the feet's soles, m.
    pub height: f64,
    /// Mean length of the legs, m.
    pub leg_length: f64,
    /// Largest torque that the legs' joints of each role bear while all feet carry the same, N m.
    pub torques: Vec<(Role, f64)>,
}

impl Standing {
    pub fn find(model: &Model, roles: &Roles) -> Self {
        let mut q: Vec<f64> = (0..model.joints.len()).map(|joint| rest(model, joint)).collect();
        for limb in roles.limbs.iter().filter(|limb| limb.kind == LimbKind::Arm) {
            let_hang(model, limb, &mut q);
        }
        let zero = model.forward_kinematics(&q);
        let legs: Vec<Leg<'_>> = roles.limbs.iter().filter_map(|limb| Leg::new(model, limb, &zero)).collect();
        let count = legs.len().max(1) as f64;
        let is_biped = legs.len() <= 2;
        let leg_length = legs.iter().map(|leg| leg.length).sum::<f64>() / count;
        let hips = legs.iter().map(|leg| leg.hip.x).sum::<f64>() / count;
        let stand_at = |share: f64, below: f64, q: &mut Vec<f64>| {
            // the shortest leg says how high the robot stands
            let lowest = |leg: &Leg<'_>| leg.hip.z - share * leg.drop(is_biped) - leg.radius;
            let ground = legs.iter().map(lowest).fold(f64::NEG_INFINITY, f64::max);
            let mut misses = vec![0.0; legs.len()];
            for _ in 0..ROUNDS {
                let furthest = 0.2 * leg_length;
                let centre = centre_of_mass(model, q).x;
                let shift = below * (centre - hips).clamp(-furthest, furthest);
                for (leg, miss) in legs.iter().zip(&mut misses) {
                    let place = match leg.reach() {
                        Some(out) => leg.hip + out,
                        None => DVec3::new(leg.hip.x + shift, leg.track, 0.0),
                    };
                    let target = DVec3::new(place.x, place.y, ground + leg.radius);
                    *miss = leg.solve(model, target, is_biped, q);
                }
            }
            (ground, misses)
        };
        let start = q.clone();
        let (mut ground, mut misses) = stand_at(1.0, 1.0, &mut q);
        let most = |misses: &[f64]| misses.iter().copied().fold(0.0, f64::max);
        for (share, below) in OTHER_PLACES {
            if most(&misses) < REACHED {
                break;
            }
            let mut lower = start.clone();
            let (other_ground, others) = stand_at(share, below, &mut lower);
            if most(&others) < most(&misses) {
                (q, ground, misses) = (lower, other_ground, others);
            }
        }
        let places = legs.iter().map(|leg| leg.limb.place);
        Self {
            misses: places.zip(misses).collect(),
            height: -ground,
            leg_length,
            torques: torques(model, &legs, &q),
            q,
        }
    }
}

/// Zero, or the middle of a range without zero: a joint at its stop has nowhere to go.
fn rest(model: &Model, joint: usize) -> f64 {
    let own = &model.joints[joint];
    if own.lower > 0.0 || own.upper < 0.0 {
        let range = range(model, joint);
        return 0.5 * (range.start() + range.end());
    }
    nearest_to_zero(own)
}

/// Turns the shoulder of a stretched arm until the arm is lowest.
fn let_hang(model: &Model, limb: &Limb, q: &mut [f64]) {
    let Some(first) = limb.joints.first() else {
        return;
    };
    let links = below(model, first.joint + 1);
    let centre = |q: &[f64]| {
        let poses = model.forward_kinematics(q);
        let mass: f64 = links.iter().map(|link| model.links[*link].mass).sum();
        let moment: DVec3 =
            links.iter().map(|&link| poses[link].transform_point(model.links[link].com) * model.links[link].mass).sum();
        (moment / mass.max(1e-9), poses[first.joint + 1].translation)
    };
    let (com, shoulder) = centre(q);
    if shoulder.z - com.z >= HANGS * com.distance(shoulder) {
        return;
    }
    for role in [Role::ShoulderRoll, Role::ShoulderPitch] {
        let Some(joint) = limb.joint(role) else {
            continue;
        };
        let range = range(model, joint);
        let mut best = (com.z, q[joint]);
        for step in 0..=ANGLES {
            q[joint] = at(&range, f64::from(step) / f64::from(ANGLES));
            let z = centre(q).0.z;
            // 1 mm: among equally good angles, the one nearest to zero
            if z < best.0 - 1e-3 || (z < best.0 + 1e-3 && q[joint].abs() < best.1.abs()) {
                best = (z.min(best.0), q[joint]);
            }
        }
        q[joint] = best.1;
    }
}

fn at(range: &RangeInclusive<f64>, share: f64) -> f64 {
    range.start() + (range.end() - range.start()) * share
}

/// A link and all links below it.
pub(super) fn below(model: &Model, link: usize) -> Vec<usize> {
    let mut links = vec![link];
    let mut next = 0;
    while next < links.len() {
        links.extend(model.children(links[next]));
        next += 1;
    }
    links
}

/// A leg, with the data that it stands by.
struct Leg<'a> {
    limb: &'a Limb,
    /// Joints that the pose moves.
    free: Vec<usize>,
    foot_link: usize,
    foot_point: DVec3,
    radius: f64,
    /// The joint that bends first, base frame, m.
    hip: DVec3,
    /// Length from the hip over all joints that bend to the foot, m.
    length: f64,
    /// Distance of the foot to the left of the base, m.
    track: f64,
    /// Rotation of the foot's link with all joints at zero, for a leg whose ankle can keep the sole
    /// level.
    level: Option<DMat3>,
    /// Direction of a leg that points away from the body, and the lengths of its first part and of
    /// the rest, m.
    radial: Option<(DVec3, f64, f64)>,
}

impl<'a> Leg<'a> {
    fn new(model: &Model, limb: &'a Limb, zero: &[Pose]) -> Option<Self> {
        let foot = limb.foot.filter(|_| limb.kind == LimbKind::Leg)?;
        let link = model.bodies[foot.body].link;
        let tip = zero[link].transform_point(foot.point);
        let bends: Vec<usize> =
            limb.joints.iter().filter(|own| own.slot.role.is_flexion()).map(|own| own.joint).collect();
        let mut points: Vec<DVec3> = bends.iter().map(|joint| zero[joint + 1].translation).collect();
        points.push(tip);
        let parts: Vec<f64> = points.windows(2).map(|pair| pair[0].distance(pair[1])).collect();
        let first = zero[limb.joints.first()?.joint + 1].translation;
        let hip = *points.first()?;
        let out = DVec3::new(tip.x - first.x, tip.y - first.y, 0.0).normalize_or_zero();
        let is_radial = limb.joint(Role::HipLift).is_some();
        let moves = |role: Role| !matches!(role, Role::HipYaw | Role::AnkleYaw | Role::Toe | Role::Slide | Role::Wheel);
        Some(Self {
            limb,
            free: limb.joints.iter().filter(|own| moves(own.slot.role)).map(|own| own.joint).collect(),
            foot_link: link,
            foot_point: foot.point,
            radius: foot.radius,
            hip,
            length: parts.iter().sum(),
            track: tip.y,
            level: limb.joint(Role::AnklePitch).map(|_| model.forward_kinematics(&[])[link].rotation),
            radial: is_radial.then(|| (out, parts[0], parts[1..].iter().sum())),
        })
    }

    /// Wanted depth of the foot below the hip, m.
    fn drop(&self, is_biped: bool) -> f64 {
        match self.radial {
            Some((_, first, rest)) => rest - first * self.raised().sin(),
            None if !is_biped => CROUCH * self.length,
            None if self.level.is_some() => ON_SOLES * self.length,
            None => ON_POINTS * self.length,
        }
    }

    /// Angle of the thigh of a leg that points away from the body, rad.
    fn raised(&self) -> f64 {
        let Some((_, first, rest)) = self.radial else {
            return 0.0;
        };
        let most = (rest - CLEARANCE * (first + rest)) / first.max(1e-9);
        most.clamp(-1.0, 1.0).asin().min(RAISED)
    }

    /// Horizontal vector from the hip of a leg that points away from the body to its foot, m.
    fn reach(&self) -> Option<DVec3> {
        self.radial.map(|(out, first, _)| out * (first * self.raised().cos()))
    }

    fn foot(&self, links: &[Pose]) -> DVec3 {
        links[self.foot_link].transform_point(self.foot_point)
    }

    /// Writes the angles to `q` for which the foot is nearest to `target`. Returns the remaining
    /// distance, m. Knees of two legs point forward, of more to the rear, where they can.
    fn solve(&self, model: &Model, target: DVec3, is_biped: bool, q: &mut [f64]) -> f64 {
        let mut best: Option<(bool, f64, Vec<f64>)> = None;
        let usual = if is_biped { KNEES[0] } else { -KNEES[1] };
        for (is_search, knee) in [(false, usual), (false, -usual), (true, usual), (true, -usual)] {
            if best.as_ref().is_some_and(|(good, ..)| *good) {
                break;
            }
            let start = if is_search {
                self.nearest_start(model, target, knee.signum(), q)
            } else {
                let mut angles = q.to_vec();
                self.bend(model, knee, &mut angles);
                Some(angles)
            };
            let Some(start) = start else {
                continue;
            };
            let mut angles = start.clone();
            self.refine(model, target, &start, is_search, &mut angles);
            let miss = self.foot(&model.forward_kinematics(&angles)).distance(target);
            let reached = miss < REACHED;
            // the usual side comes first; another one must reach farther to replace it
            if best.as_ref().is_none_or(|(good, least, _)| !good && (reached || miss < *least)) {
                best = Some((reached, miss, angles));
            }
        }
        best.map_or(f64::INFINITY, |(_, miss, angles)| {
            q.copy_from_slice(&angles);
            miss
        })
    }

    /// The best of a grid of positions of hip and knee with the knee on one side of straight, the
    /// ankle keeping the sole level.
    fn nearest_start(&self, model: &Model, target: DVec3, side: f64, q: &[f64]) -> Option<Vec<f64>> {
        let of = |is: fn(Role) -> bool| self.limb.joints.iter().find(|own| is(own.slot.role));
        let (hip, knee) = (of(|role| matches!(role, Role::Hfe | Role::HipPitch))?, of(Role::is_knee)?);
        let ankle = of(|role| role == Role::AnklePitch);
        let mut best: Option<(f64, Vec<f64>)> = None;
        for step in 0..STARTS * STARTS {
            let mut angles = q.to_vec();
            for (own, step) in [(hip, step / STARTS), (knee, step % STARTS)] {
                angles[own.joint] = at(&range(model, own.joint), f64::from(step) / f64::from(STARTS - 1));
            }
            if side * knee.sign * angles[knee.joint] <= 0.0 {
                continue;
            }
            if let Some(ankle) = ankle {
                let bent = hip.sign * angles[hip.joint] + knee.sign * angles[knee.joint];
                let range = range(model, ankle.joint);
                angles[ankle.joint] = (-ankle.sign * bent).clamp(*range.start(), *range.end());
            }
            let squares: f64 = self.errors(model, target, &angles, &angles).iter().map(|error| error * error).sum();
            if best.as_ref().is_none_or(|(least, _)| squares < *least) {
                best = Some((squares, angles));
            }
        }
        best.map(|(_, angles)| angles)
    }

    /// Bends the knee by an angle in its canonical direction; hip and ankle compensate.
    fn bend(&self, model: &Model, knee: f64, q: &mut [f64]) {
        for own in &self.limb.joints {
            let angle = match own.slot.role {
                role if role.is_knee() => knee,
                Role::Hfe | Role::HipPitch | Role::AnklePitch => -0.5 * knee,
                Role::HipLift => -self.raised(),
                _ => continue,
            };
            let range = range(model, own.joint);
            q[own.joint] = (own.sign * angle).clamp(*range.start(), *range.end());
        }
    }

    /// Distance of the foot in leg lengths, tilt of the sole, and distance from the start.
    fn errors(&self, model: &Model, target: DVec3, start: &[f64], q: &[f64]) -> Vec<f64> {
        let links = model.forward_kinematics(q);
        let mut errors = ((self.foot(&links) - target) / self.length).to_array().to_vec();
        if let Some(level) = self.level {
            let up = links[self.foot_link].rotation * level.transpose() * DVec3::Z;
            errors.extend([up.x, up.y]);
        }
        errors.extend(self.free.iter().map(|&joint| REST * (q[joint] - start[joint])));
        errors
    }

    /// Damped Gauss-Newton steps within the ranges. With `holds`, joints whose step leads out of
    /// their range stay, and the others take a step without them.
    fn refine(&self, model: &Model, target: DVec3, start: &[f64], holds: bool, q: &mut [f64]) {
        let ranges: Vec<RangeInclusive<f64>> = self.free.iter().map(|&joint| range(model, joint)).collect();
        let squares = |errors: &[f64]| errors.iter().map(|e| e * e).sum::<f64>();
        let mut errors = self.errors(model, target, start, q);
        let mut damping = 1e-3;
        for _ in 0..ITERATIONS {
            let mut columns: Vec<Vec<f64>> = self
                .free
                .iter()
                .map(|&joint| {
                    let mut moved = q.to_vec();
                    moved[joint] += DIFFERENCE;
                    let after = self.errors(model, target, start, &moved);
                    after.iter().zip(&errors).map(|(a, b)| (a - b) / DIFFERENCE).collect()
                })
                .collect();
            let mut step = normal_step(&columns, &errors, damping);
            if holds {
                for ((&joint, range), (column, step)) in
                    self.free.iter().zip(&ranges).zip(columns.iter_mut().zip(&step))
                {
                    if !range.contains(&(q[joint] - step)) {
                        column.fill(0.0);
                    }
                }
                step = normal_step(&columns, &errors, damping);
            }
            let mut next = q.to_vec();
            for ((&joint, range), step) in self.free.iter().zip(&ranges).zip(step) {
                next[joint] = (q[joint] - step).clamp(*range.start(), *range.end());
            }
            let next_errors = self.errors(model, target, start, &next);
            if squares(&next_errors) < squares(&errors) {
                q.copy_from_slice(&next);
                errors = next_errors;
                damping *= 0.1;
            } else {
                damping *= 10.0;
            }
        }
    }
}

/// The step that reduces `errors` most, from difference quotients by column: (J'J + damping) step =
/// J' errors.
fn normal_step(columns: &[Vec<f64>], errors: &[f64], damping: f64) -> Vec<f64> {
    let n = columns.len();
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
    let mut rows: Vec<Vec<f64>> = (0..n)
        .map(|i| {
            let mut row: Vec<f64> = (0..n).map(|j| dot(&columns[i], &columns[j])).collect();
            row[i] += damping;
            row.push(dot(&columns[i], errors));
            row
        })
        .collect();
    // elimination without pivots: the matrix is positive definite
    for k in 0..n {
        let pivot = rows[k].clone();
        for row in &mut rows[k + 1..] {
            let factor = row[k] / pivot[k];
            row.iter_mut().zip(&pivot).for_each(|(x, p)| *x -= factor * p);
        }
    }
    let mut step = vec![0.0; n];
    for k in (0..n).rev() {
        let known: f64 = (k + 1..n).map(|j| rows[k][j] * step[j]).sum();
        step[k] = (rows[k][n] - known) / rows[k][k];
    }
    step
}

fn torques(model: &Model, legs: &[Leg<'_>], q: &[f64]) -> Vec<(Role, f64)> {
    let links = model.forward_kinematics(q);
    let force = DVec3::Z * (model.total_mass() * GRAVITY / legs.len().max(1) as f64);
    let mut torques: Vec<(Role, f64)> = Vec::new();
    for leg in legs {
        for own in &leg.limb.joints {
            let link = &links[own.joint + 1];
            let axis = link.rotation * model.joints[own.joint].axis;
            let torque = axis.dot((leg.foot(&links) - link.translation).cross(force)).abs();
            match torques.iter_mut().find(|(role, _)| *role == own.slot.role) {
                Some((_, most)) => *most = most.max(torque),
                None => torques.push((own.slot.role, torque)),
            }
        }
    }
    torques.sort_by_key(|(role, _)| *role);
    torques
}

/// Largest torque of gravity about a joint, from all links that it carries, in any pose, N m.
pub(super) fn gravity_moment(model: &Model, joint: usize) -> f64 {
    let zero = model.forward_kinematics(&[]);
    let links = below(model, joint + 1);
    let moment: DVec3 = links
        .iter()
        .map(|&link| {
            (zero[link].transform_point(model.links[link].com) - zero[joint + 1].translation) * model.links[link].mass
        })
        .sum();
    moment.length() * GRAVITY
}
