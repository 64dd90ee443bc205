//! Numbers that no legged robot has in SI units, and the unit that they seem to have.

use std::collections::HashMap;
use std::f64::consts::{PI, TAU};
use std::path::Path;

use glam::DVec3;
use urdf_rs::JointType;

use super::error::Warning;
use super::inertia::principal_moments;
use super::merge::mass_properties;
use super::model::{Body, Geometry, Model, Shape};
use super::pose::Pose;

/// Longest offset and largest shape of a robot, m.
pub(super) const LARGEST_LENGTH: f64 = 5.0;
/// Length, m, beyond which an offset or shape is suspicious if it is also many times the usual one
/// of the robot.
const LONG: f64 = 1.0;
const TIMES_USUAL: f64 = 20.0;
/// A mesh smaller than this is a mesh in m with a scale for mm, m.
const SMALLEST_MESH: f64 = 5e-4;
/// Largest turn of a joint with limits, rad: the widest of known robots turn by 10 rad to each
/// side.
const MOST_TURN: f64 = 4.0 * PI * 1.001;
/// Limits beyond this are placeholders, not degrees.
const MOST_DEGREES: f64 = 1080.0;
/// Density that no robot has, kg/m^3, as its mass over the box about it: known ones have 20 to 400,
/// steel 7800.
const DENSEST: f64 = 15_000.0;
/// Mass of a link below which its inertia is not checked, kg: the shapes of sensors are often
/// tokens.
const LEAST_MASS: f64 = 1.0;
/// No side of the box is taken as shorter than this share of its diagonal.
const SLIMMEST: f64 = 0.5;
/// Radius of gyration over the size of the robot, and of the link's own shapes, that no body has.
const GYRATION: f64 = 10.0;
const GYRATION_OF_SHAPES: f64 = 30.0;
/// Links lighter than this are empty, kg.
const EMPTY: f64 = 1e-3;
/// Effort over weight times size that no joint has: known ones have 0.1 to 1.
const STRONGEST: f64 = 50.0;
/// Efforts up to this are placeholders that makers of small robots write, N m.
const LARGEST_PLACEHOLDER: f64 = 1500.0;

/// Warnings for numbers that are plausible in another unit only. `places` are where the links of
/// the URDF are in `model`.
pub(super) fn implausible(
    robot: &urdf_rs::Robot,
    model: &Model,
    places: &[Option<(usize, Pose)>],
    file: &Path,
) -> Vec<Warning> {
    let sizes = Sizes::new(robot, model, places);
    let mut found = Found { file, warnings: Vec::new() };
    lengths(robot, model, &mut found);
    // checks that follow from lengths mean nothing where lengths are wrong
    let are_metres = found.warnings.is_empty();
    angles(robot, &mut found);
    if are_metres {
        masses(robot, model, &sizes, &mut found);
        efforts(robot, model, &sizes, &mut found);
    }
    inertias(robot, &sizes, &mut found);
    found.warnings
}

/// One warning for all elements with the same fault.
struct Found<'a> {
    file: &'a Path,
    warnings: Vec<Warning>,
}

impl Found<'_> {
    /// `elements` are those at fault, each with its problem; `unit` is the unit that they seem to
    /// have.
    fn push(&mut self, elements: &[(String, String)], unit: &str, remedy: impl Into<String>) {
        let Some((element, value)) = elements.first() else {
            return;
        };
        let others = match elements.len() {
            1 => String::new(),
            2 => " (as is one more)".to_string(),
            count => format!(" (as are {} more)", count - 1),
        };
        let problem = format!("{value}{others}: it looks like {unit}");
        self.warnings.push(Warning::new(self.file, element.clone(), problem, remedy));
    }
}

/// A box along the axes.
#[derive(Clone, Copy, Debug)]
struct Extent {
    low: DVec3,
    high: DVec3,
}

impl Extent {
    const EMPTY: Self = Self { low: DVec3::INFINITY, high: DVec3::NEG_INFINITY };

    fn add(&mut self, point: DVec3) {
        self.low = self.low.min(point);
        self.high = self.high.max(point);
    }

    fn join(&mut self, other: &Self) {
        self.low = self.low.min(other.low);
        self.high = self.high.max(other.high);
    }

    /// Box about a shape in the frame of its link.
    fn of(shape: &Shape) -> Self {
        let mut extent = Self::EMPTY;
        let half = match &shape.geometry {
            Geometry::Sphere { radius } => DVec3::splat(*radius),
            Geometry::Box { size } => *size * 0.5,
            Geometry::Cylinder { radius, length } => DVec3::new(*radius, *radius, 0.5 * length),
            Geometry::Capsule { radius, length } => DVec3::new(*radius, *radius, 0.5 * length + radius),
            Geometry::Hull { points } => {
                points.iter().for_each(|point| extent.add(shape.origin.transform_point(*point)));
                return extent;
            }
        };
        Self { low: -half, high: half }.corners().for_each(|corner| extent.add(shape.origin.transform_point(corner)));
        extent
    }

    fn corners(&self) -> impl Iterator<Item = DVec3> {
        let Self { low, high } = *self;
        (0..8u32).map(move |corner| {
            DVec3::select(glam::BVec3::new(corner & 1 == 0, corner & 2 == 0, corner & 4 == 0), low, high)
        })
    }

    fn diagonal(&self) -> f64 {
        if self.low.x > self.high.x { 0.0 } else { self.high.distance(self.low) }
    }

    /// Volume, m^3.
    fn volume(&self) -> f64 {
        let diagonal = self.diagonal();
        if diagonal == 0.0 {
            0.0
        } else {
            (self.high - self.low).max(DVec3::splat(SLIMMEST * diagonal)).element_product()
        }
    }
}

struct Sizes {
    /// Box about each URDF link's own shapes, in the frame of the merged link.
    shapes: Vec<Extent>,
    /// Box about these shapes, the link's centre of mass and the joints on it; empty for a link
    /// without shapes.
    links: Vec<Extent>,
    /// Box about all shapes, frames and centres of mass with all joints at zero, in the base frame.
    whole: Extent,
}

impl Sizes {
    fn new(robot: &urdf_rs::Robot, model: &Model, places: &[Option<(usize, Pose)>]) -> Self {
        let poses = model.forward_kinematics(&[]);
        let index: HashMap<&str, usize> =
            robot.links.iter().enumerate().map(|(at, link)| (link.name.as_str(), at)).collect();
        let mut shapes = vec![Extent::EMPTY; robot.links.len()];
        let mut whole = Extent::EMPTY;
        for body in &model.bodies {
            for shape in &body.shapes {
                let extent = Extent::of(shape);
                if let Some(&at) = index.get(body.name.as_str()) {
                    shapes[at].join(&extent);
                }
                extent.corners().for_each(|corner| whole.add(poses[body.link].transform_point(corner)));
            }
        }
        let mut links = shapes.clone();
        let has_shapes = |at: usize| shapes[at].diagonal() > 0.0;
        let mut add = |at: usize, origin: &urdf_rs::Pose| {
            if let Some((_, place)) = places[at].filter(|_| has_shapes(at)) {
                links[at].add(place.transform_point(DVec3::from_array(*origin.xyz)));
            }
        };
        robot.links.iter().enumerate().for_each(|(at, link)| add(at, &link.inertial.origin));
        for joint in &robot.joints {
            if let Some(&at) = index.get(joint.parent.link.as_str()) {
                add(at, &joint.origin);
            }
        }
        for (merged, pose) in places.iter().flatten() {
            whole.add((poses[*merged] * *pose).translation);
        }
        for (link, pose) in model.links.iter().zip(&poses) {
            whole.add(pose.transform_point(link.com));
        }
        Self { shapes, links, whole }
    }
}

/// Finds offsets and shapes in mm or cm.
fn lengths(robot: &urdf_rs::Robot, model: &Model, found: &mut Found<'_>) {
    let length = |pose: &urdf_rs::Pose| DVec3::from_array(*pose.xyz).length();
    let joints =
        robot.joints.iter().map(|joint| (format!("joint \"{}\", <origin xyz>", joint.name), length(&joint.origin)));
    let links = robot.links.iter();
    let inertials =
        links.map(|link| (format!("link \"{}\", <inertial>, <origin xyz>", link.name), length(&link.inertial.origin)));
    let offsets: Vec<(String, f64)> = joints.chain(inertials).filter(|(_, length)| *length > 0.0).collect();
    let usual = median(offsets.iter().map(|(_, length)| *length));
    let is_long = |length: f64| length > LARGEST_LENGTH || (length > LONG && length > TIMES_USUAL * usual);
    let long: Vec<(String, String)> = offsets
        .into_iter()
        .filter(|(_, length)| is_long(*length))
        .map(|(element, length)| (element, format!("it lies {length:.4} m away")))
        .collect();
    found.push(&long, "millimetres", "write metres");

    // a robot without joints has nothing to compare with
    let reach = reach(model);
    let is_large = |size: f64| size > LARGEST_LENGTH || (reach > 0.0 && size > LONG && size > TIMES_USUAL * reach);
    let (mut meshes, mut shapes, mut tiny) = (Vec::new(), Vec::new(), Vec::new());
    let bodies: HashMap<&str, &Body> = model.bodies.iter().map(|body| (body.name.as_str(), body)).collect();
    for link in &robot.links {
        let Some(body) = bodies.get(link.name.as_str()) else {
            continue;
        };
        // omitted shapes leave no trace, so both are counted only if they agree
        let pairs = link.collision.iter().zip(&body.shapes).filter(|_| link.collision.len() == body.shapes.len());
        for (collision, shape) in pairs {
            let element = format!("link \"{}\", <collision>", link.name);
            let alone = Shape { origin: Pose::IDENTITY, ..shape.clone() };
            let extent = Extent::of(&alone);
            let size = (extent.high - extent.low).max_element();
            match &collision.geometry {
                urdf_rs::Geometry::Mesh { filename, .. } if is_large(size) => {
                    meshes.push((element, format!("mesh \"{filename}\" is {size:.4} m large")));
                }
                urdf_rs::Geometry::Mesh { filename, .. } if size > 0.0 && size < SMALLEST_MESH => {
                    tiny.push((element, format!("mesh \"{filename}\" is {:.4} mm large", 1e3 * size)));
                }
                urdf_rs::Geometry::Mesh { .. } => {}
                _ if is_large(size) => shapes.push((element, format!("its shape is {size:.4} m large"))),
                _ => {}
            }
        }
    }
    found.push(&meshes, "millimetres", "give the <mesh> scale=\"0.001 0.001 0.001\", or write it in metres");
    found.push(&tiny, "a mesh in metres with a scale for millimetres", "remove the scale of the <mesh>");
    found.push(&shapes, "millimetres", "write metres");
}

/// Largest distance of a joint from the base, m.
fn reach(model: &Model) -> f64 {
    model.forward_kinematics(&[]).iter().map(|pose| pose.translation.length()).fold(0.0, f64::max)
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}

/// Finds limits and rotations in degrees, and travel in mm.
fn angles(robot: &urdf_rs::Robot, found: &mut Found<'_>) {
    let (mut degrees, mut travel) = (Vec::new(), Vec::new());
    for joint in &robot.joints {
        let (lower, upper) = (joint.limit.lower, joint.limit.upper);
        let most = [lower, upper].into_iter().filter(|limit| limit.is_finite()).map(f64::abs).fold(0.0, f64::max);
        let element = format!("joint \"{}\", <limit>", joint.name);
        match joint.joint_type {
            JointType::Revolute if most > MOST_TURN && most <= MOST_DEGREES => {
                let turns = format!("its limits {lower} .. {upper} rad are {:.1} turns", (upper - lower) / TAU);
                degrees.push((element, turns));
            }
            JointType::Prismatic if most > LARGEST_LENGTH => {
                travel.push((element, format!("its limits are {lower} .. {upper} m")));
            }
            _ => {}
        }
    }
    let rpy = |element: String, pose: &urdf_rs::Pose| {
        let most = pose.rpy.iter().map(|angle| angle.abs()).fold(0.0, f64::max);
        (most > MOST_TURN && most <= MOST_DEGREES)
            .then(|| (element, format!("its rotation {} {} {} rad goes round", pose.rpy[0], pose.rpy[1], pose.rpy[2])))
    };
    let of_joints =
        robot.joints.iter().filter_map(|joint| rpy(format!("joint \"{}\", <origin rpy>", joint.name), &joint.origin));
    let of_links = robot.links.iter().flat_map(|link| {
        let inertial = rpy(format!("link \"{}\", <inertial>, <origin rpy>", link.name), &link.inertial.origin);
        let shapes = link.collision.iter();
        inertial.into_iter().chain(
            shapes.filter_map(|shape| rpy(format!("link \"{}\", <collision>, <origin rpy>", link.name), &shape.origin)),
        )
    });
    let turned: Vec<(String, String)> = of_joints.chain(of_links).collect();
    found.push(&degrees, "degrees", "write radians");
    found.push(&travel, "millimetres", "write metres");
    found.push(&turned, "degrees", "write radians");
}

/// Finds masses in g.
fn masses(robot: &urdf_rs::Robot, model: &Model, sizes: &Sizes, found: &mut Found<'_>) {
    let dense = |mass: f64, volume: f64| volume > 0.0 && mass > DENSEST * volume;
    let (total, volume) = (model.total_mass(), sizes.whole.volume());
    if total > LEAST_MASS && dense(total, volume) {
        let heaviest = robot.links.iter().max_by(|a, b| a.inertial.mass.value.total_cmp(&b.inertial.mass.value));
        let element = heaviest.map_or_else(String::new, |link| format!("link \"{}\", <mass value>", link.name));
        let mass = heaviest.map_or(0.0, |link| link.inertial.mass.value);
        let value = format!(
            "its mass is {mass} kg, and the robot's {total:.4} kg in a box with a diagonal of {:.3} m",
            sizes.whole.diagonal()
        );
        found.push(&[(element, value)], "grams", "write kilograms");
        return;
    }
    let links = robot.links.iter().zip(&sizes.links);
    let heavy: Vec<(String, String)> = links
        .filter(|(link, extent)| {
            let mass = link.inertial.mass.value;
            mass > LEAST_MASS && dense(mass, extent.volume())
        })
        .map(|(link, extent)| {
            let value = format!(
                "its mass is {} kg, and all of it is {:.3} m large",
                link.inertial.mass.value,
                extent.diagonal()
            );
            (format!("link \"{}\", <mass value>", link.name), value)
        })
        .collect();
    found.push(&heavy, "grams", "write kilograms, or larger shapes if the mass is right");
}

/// Finds inertias in kg mm^2 and other small units.
fn inertias(robot: &urdf_rs::Robot, sizes: &Sizes, found: &mut Found<'_>) {
    let size = sizes.whole.diagonal();
    let mut wide = Vec::new();
    let mut ratio: f64 = 0.0;
    for (link, extent) in robot.links.iter().zip(&sizes.shapes) {
        let own = mass_properties(&link.inertial);
        if own.mass < EMPTY {
            continue;
        }
        let gyration = (principal_moments(&own.inertia)[2].max(0.0) / own.mass).sqrt();
        let of_shapes = extent.diagonal();
        let is_wide = (size > 0.0 && gyration > GYRATION * size)
            || (of_shapes > 0.0 && gyration > GYRATION_OF_SHAPES * of_shapes);
        if is_wide {
            let largest = if of_shapes > 0.0 { of_shapes } else { size };
            // the ratio of a uniform box of this diagonal is at most 0.29
            ratio = ratio.max((gyration / (0.25 * largest)).powi(2));
            let value = format!(
                "its inertia is that of {} kg spread over {gyration:.3} m, in a robot of {size:.3} m",
                own.mass
            );
            wide.push((format!("link \"{}\", <inertia>", link.name), value));
        }
    }
    let units = [("kg cm^2", 1e4), ("kg mm^2", 1e6), ("g mm^2", 1e9)];
    let distance = |unit: &(&str, f64)| (ratio / unit.1).ln().abs();
    let unit = units.into_iter().min_by(|a, b| distance(a).total_cmp(&distance(b))).map_or("kg mm^2", |unit| unit.0);
    found.push(&wide, unit, "write the inertia in kg m^2");
}

/// Finds efforts in N mm.
fn efforts(robot: &urdf_rs::Robot, model: &Model, sizes: &Sizes, found: &mut Found<'_>) {
    const GRAVITY: f64 = 9.81;
    let load = model.total_mass() * GRAVITY * sizes.whole.diagonal();
    let strong: Vec<(String, String)> = robot
        .joints
        .iter()
        .filter(|joint| joint.joint_type == JointType::Revolute || joint.joint_type == JointType::Continuous)
        .filter(|joint| {
            joint.limit.effort.is_finite()
                && load > 0.0
                && joint.limit.effort > LARGEST_PLACEHOLDER.max(STRONGEST * load)
        })
        .map(|joint| {
            let times = joint.limit.effort / load;
            let value = format!("{} N m are {times:.0} times the robot's weight times its size", joint.limit.effort);
            (format!("joint \"{}\", <limit effort>", joint.name), value)
        })
        .collect();
    found.push(&strong, "N mm, or a placeholder", "write the motor's effort in N m");
}
