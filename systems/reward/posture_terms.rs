//! Reward terms on how a body holds itself: getting up, standing, standing on some of its feet.
//!
//! Formulas: MuJoCo Playground's get-up task (Apache-2.0), in units of the body, so that one weight
//! serves bodies of all sizes. The name `upright` is mjlab's.

use serde::Deserialize;

use super::sum_of_squares;
use crate::config::quantities::{BodyFactor, Factor, ForceThreshold, Height, Width};
use crate::config::{did_you_mean, values};
use crate::dynamics::elementary::exp;
use crate::engine::device::FormKind;
use crate::morphology::MorphologyModel;
use crate::systems::terms::Registry;
use crate::systems::view::RobotView;

/// A key, what is wrong with its value, and the remedy.
type Problem = (String, String, String);

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct UprightParams {
    /// Width of the bell curve over the distance of two unit vectors.
    #[serde(deserialize_with = "values::number_of::<Width, _, _>")]
    std: f32,
    /// Direction of the base that is to point up, base axes. Default: its z axis.
    #[serde(default = "z_axis", deserialize_with = "values::list_of::<Factor, _, _>")]
    up: [f64; 3],
}

fn z_axis() -> [f64; 3] {
    [0.0, 0.0, 1.0]
}

struct Upright {
    inverse_square: f32,
    up: [f32; 3],
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct TorsoParams {
    /// Width of the bell curve over the missing height, as a share of the height of the hips in the
    /// default pose.
    #[serde(deserialize_with = "values::number_of::<Width, _, _>")]
    std: f32,
    /// Height of the base that is enough, m. Default: `target_share`.
    #[serde(default, deserialize_with = "values::optional_of::<Height, _, _>")]
    target_height: Option<f32>,
    /// Height that is enough, as a share of that in the default pose. Default: 1.
    #[serde(default = "one", deserialize_with = "values::number_of::<BodyFactor, _, _>")]
    target_share: f32,
}

fn one() -> f32 {
    1.0
}

struct Torso {
    target: f32,
    /// 1 over width times height of the hips, squared, 1/m^2.
    inverse_square: f32,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Posture {
    /// Width of the bell curve over the root of the joints' mean squared distance, rad.
    #[serde(deserialize_with = "values::number_of::<Width, _, _>")]
    std: f32,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct OffGroundParams {
    /// Places of the feet, such as `LF` and `RF`.
    feet: Vec<String>,
    /// Normal force from which a foot stands, N. Isaac Lab's default.
    #[serde(default = "one", deserialize_with = "values::number_of::<ForceThreshold, _, _>")]
    threshold: f32,
}

struct OffGround {
    /// Contact bodies of the feet.
    bodies: Vec<usize>,
    threshold: f32,
}

pub(super) fn register(registry: &mut Registry) {
    registry.reward_for("upright", prepare_upright, upright);
    registry.reward_for("torso_height", prepare_torso, torso_height);
    registry.reward("posture", posture);
    registry.reward_for("feet_off_ground", prepare_off_ground, feet_off_ground);
    on_device(registry);
}

/// The numbers of these terms in `device/env.h`.
fn on_device(registry: &mut Registry) {
    registry.on_device(FormKind::Reward, "upright", |p, robot| {
        let Upright { inverse_square, up: [x, y, z] } = prepare_upright(p, robot).ok()?;
        Some((vec![inverse_square, x, y, z], Some(Vec::new())))
    });
    registry.on_device(FormKind::Reward, "torso_height", |p, robot| {
        let Torso { target, inverse_square } = prepare_torso(p, robot).ok()?;
        Some((vec![target, inverse_square], Some(Vec::new())))
    });
    registry.reward_on_device("posture", |p: Posture| vec![p.std]);
    registry.on_device(FormKind::Reward, "feet_off_ground", |p, robot| {
        let OffGround { bodies, threshold } = prepare_off_ground(p, robot).ok()?;
        Some((vec![threshold], Some(bodies.into_iter().map(|body| body as i32).collect())))
    });
}

fn prepare_upright(p: UprightParams, _: &MorphologyModel) -> Result<Upright, Problem> {
    let length = p.up.iter().map(|x| x * x).sum::<f64>().sqrt();
    if length < 1e-6 {
        return Err((
            "up".into(),
            "it points nowhere".into(),
            "write a direction in base axes, such as [0, 0, 1]".into(),
        ));
    }
    Ok(Upright { inverse_square: 1.0 / (p.std * p.std), up: p.up.map(|x| (x / length) as f32) })
}

/// Bell curve over the distance of the direction from the vertical, as unit vectors.
#[inline(always)]
fn upright(p: &Upright, r: &RobotView) -> f32 {
    let gravity = &r.imu.projected_gravity;
    let distance: [f32; 3] = std::array::from_fn(|k| p.up[k] + gravity[k]);
    exp(-sum_of_squares(&distance) * p.inverse_square)
}

fn prepare_torso(p: TorsoParams, robot: &MorphologyModel) -> Result<Torso, Problem> {
    let default = robot.default_height();
    let target = p.target_height.unwrap_or_else(|| robot.least_height(p.target_share, default));
    let unit = p.std * robot.default_hip_height().max(1e-3);
    Ok(Torso { target, inverse_square: 1.0 / (unit * unit) })
}

/// Bell curve over the height that the base lacks; 1 where it is high enough.
#[inline(always)]
fn torso_height(p: &Torso, r: &RobotView) -> f32 {
    let missing = (p.target - r.base_height()).max(0.0);
    exp(-missing * missing * p.inverse_square)
}

/// Bell curve over the distance of the joints from the default pose. It counts the more, the nearer
/// the base is to upright: by the square of (1 + cosine of the tilt) / 2.
#[inline(always)]
fn posture(p: &Posture, r: &RobotView) -> f32 {
    let pairs = r.joints.position.iter().zip(&r.stance.default_position);
    let sum = pairs.fold(0.0, |sum: f32, (q, q0)| (q - q0).mul_add(q - q0, sum));
    let mean = sum / r.joints.position.len().max(1) as f32;
    let stands = 0.5 * (1.0 - r.imu.projected_gravity[2]);
    stands * stands * exp(-mean / (p.std * p.std))
}

fn prepare_off_ground(p: OffGroundParams, robot: &MorphologyModel) -> Result<OffGround, Problem> {
    let legs = || robot.roles.legs.iter().map(|place| place.name());
    let mut bodies = Vec::new();
    for (i, name) in p.feet.iter().enumerate() {
        let Some(foot) = legs().position(|leg| leg == name) else {
            let problem = format!("{} has no foot `{name}`", robot.name());
            return Err((format!("feet[{i}]"), problem, did_you_mean(name, legs(), "feet")));
        };
        bodies.push(robot.feet[foot]);
    }
    if bodies.is_empty() {
        let remedy = format!("name some of {}", legs().collect::<Vec<_>>().join(", "));
        return Err(("feet".into(), "the list is empty".into(), remedy));
    }
    Ok(OffGround { bodies, threshold: p.threshold })
}

/// Share of the feet that do not stand.
#[inline(always)]
fn feet_off_ground(p: &OffGround, r: &RobotView) -> f32 {
    let off = p.bodies.iter().filter(|body| r.contacts.peak_force[**body] <= p.threshold);
    off.count() as f32 / p.bodies.len() as f32
}
