//! Contact bodies from collision elements; meshes are found without ROS.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use glam::DVec3;

use super::error::{Topic, Warning};
use super::hull_cache::{self, Taken};
use super::merge::MAX_EXTENT;
use super::mesh;
use super::model::{Body, BodySurface, Geometry, Joint, Shape};
use super::plausible::LARGEST_LENGTH;
use super::pose::Pose;
use super::urdf::LoadOptions;

/// Among parts that move together, parts lighter than this share of the heaviest are no limb's end.
const SUBSTANTIAL: f64 = 0.1;
/// Links lighter than this have token inertias, kg.
const TOKEN: f64 = 1e-3;
/// Thinnest side of the box of an inertia, over its longest.
const THINNEST: f64 = 0.1;
/// Longest side of the box of an inertia, over the robot's size and over the distance of the centre
/// of mass from the link's frame, whichever is more. Makers' feet reach 0.29 of the first and
/// forearms with hands 4.2 of the second.
const LONGEST: [f64; 2] = [0.3, 4.5];
/// Longest side of a box in the place of one that is longer, over these two: makers raise the
/// moments of light hands until their simulators are stable.
const USUAL: [f64; 2] = [0.2, 2.5];
/// A hull this close to that of all vertices is called the same, m.
const MIN_DEVIATION: f64 = 5e-6;

/// The links with collision shapes, in the file's order, where `places` has put them: the index of
/// the merged link and the frame in it.
///
/// Where a limb ends in links all of whose meshes are missing, the box of the inertia of the last
/// one takes their place: robots are published without meshes, and a foot has to touch the ground.
pub(super) fn bodies(
    robot: &urdf_rs::Robot,
    joints: &[Joint],
    places: &[Option<(usize, Pose)>],
    file: &Path,
    options: &LoadOptions,
    warnings: &mut Vec<Warning>,
) -> Vec<Body> {
    let mut bodies = Vec::new();
    let mut bare = Vec::new();
    for (index, (link, place)) in robot.links.iter().zip(places).enumerate() {
        let Some((merged, place)) = *place else {
            continue;
        };
        let mut shapes = Vec::with_capacity(link.collision.len());
        for collision in &link.collision {
            let mut warn = |(problem, remedy): Remark, topic: Topic| {
                let remedy = format!("{remedy}, or use a sphere, box, cylinder or capsule");
                let element = format!("link \"{}\", <collision>", link.name);
                warnings.push(Warning::new(file, element, problem, remedy).about(topic));
            };
            let origin = place * Pose::from_urdf(&collision.origin);
            if !origin.is_within(MAX_EXTENT) {
                let problem =
                    format!("with the joints above, its origin lies beyond {MAX_EXTENT} m; the shape is left out");
                warn((problem, "write metres".to_string()), Topic::Other);
                continue;
            }
            match geometry(&collision.geometry, file, options, &mut warn) {
                Ok(geometry) => shapes.push(Shape { geometry, origin }),
                Err((problem, remedy)) => warn((format!("{problem}{LEFT_OUT}"), remedy), Topic::MissingMesh),
            }
        }
        if !shapes.is_empty() {
            bodies
                .push((index, Body { name: link.name.clone(), link: merged, shapes, surface: BodySurface::default() }));
        } else if link.collision.iter().any(|collision| matches!(collision.geometry, urdf_rs::Geometry::Mesh { .. })) {
            bare.push(index);
        }
    }
    bare.retain(|index| {
        let moved = places[*index].map_or(0, |(merged, _)| merged);
        let is_end = moved > 0 && joints.iter().all(|joint| joint.parent != moved);
        is_end && bodies.iter().all(|(_, body): &(usize, Body)| body.link != moved)
    });
    let size = size(joints);
    for index in last_links(robot, places, &bare) {
        let shape = box_of_inertia(&robot.links[index].inertial, size);
        if let (Some((merged, place)), Some(shape)) = (places[index], shape) {
            let name = &robot.links[index].name;
            let problem = "its collision meshes are missing; the box of its inertia takes their place";
            let remedy = "put the files there, or write a <collision> with a sphere, box, cylinder or capsule";
            warnings.push(Warning::new(file, format!("link \"{name}\""), problem, remedy));
            let shapes = vec![Shape { origin: place * shape.origin, ..shape }];
            bodies.push((index, Body { name: name.clone(), link: merged, shapes, surface: BodySurface::default() }));
        }
    }
    bodies.sort_by_key(|(index, _)| *index);
    bodies.into_iter().map(|(_, body)| body).collect()
}

/// The last of the links that move together, and no small parts.
fn last_links(robot: &urdf_rs::Robot, places: &[Option<(usize, Pose)>], links: &[usize]) -> Vec<usize> {
    let mass = |index: usize| robot.links[index].inertial.mass.value;
    let merged = |index: usize| places[index].map(|(merged, _)| merged);
    let is_substantial = |index: &usize| {
        let together = links.iter().filter(|other| merged(**other) == merged(*index));
        mass(*index) >= SUBSTANTIAL * together.map(|other| mass(*other)).fold(TOKEN / SUBSTANTIAL, f64::max)
    };
    let kept: Vec<usize> = links.iter().copied().filter(is_substantial).collect();
    let parent_of: HashMap<&str, &str> =
        robot.joints.iter().map(|joint| (joint.child.link.as_str(), joint.parent.link.as_str())).collect();
    let carries = |above: usize, below: usize| {
        let first = parent_of.get(robot.links[below].name.as_str()).copied();
        let mut above_it = std::iter::successors(first, |name| parent_of.get(name).copied()).take(robot.links.len());
        above_it.any(|name| name == robot.links[above].name)
    };
    let is_last = |index: &usize| !kept.iter().any(|other| merged(*other) == merged(*index) && carries(*index, *other));
    kept.iter().copied().filter(is_last).collect()
}

/// Length of the longest chain of joints, m.
fn size(joints: &[Joint]) -> f64 {
    let mut reach = vec![0.0; joints.len() + 1];
    for (at, joint) in joints.iter().enumerate() {
        reach[at + 1] = reach[joint.parent] + joint.origin.translation.length();
    }
    reach.into_iter().fold(0.0, f64::max)
}

/// The uniform box that has a link's mass and moments of inertia, in the link's frame; a smaller
/// one where the robot is too small for it. `None` where the moments are no body's.
fn box_of_inertia(inertial: &urdf_rs::Inertial, robot_size: f64) -> Option<Shape> {
    let (mass, i) = (inertial.mass.value, &inertial.inertia);
    let moments = DVec3::new(i.ixx, i.iyy, i.izz);
    let squares = (DVec3::splat(moments.element_sum()) - 2.0 * moments) * (6.0 / mass);
    let size = squares.max(DVec3::ZERO).map(f64::sqrt);
    let longest = size.max_element();
    let origin = Pose::from_urdf(&inertial.origin);
    let bound = |[of_size, of_offset]: [f64; 2]| (of_size * robot_size).max(of_offset * origin.translation.length());
    let share = if longest > bound(LONGEST) { bound(USUAL) / longest } else { 1.0 };
    (longest > 0.0 && longest <= LARGEST_LENGTH && share > 0.0)
        .then(|| Shape { geometry: Geometry::Box { size: share * size.max(DVec3::splat(THINNEST * longest)) }, origin })
}

/// Ends the problem of a warning about a shape that is not there.
pub(super) const LEFT_OUT: &str = "; the shape is left out";

/// Problem and remedy.
type Remark = (String, String);

fn geometry(
    geometry: &urdf_rs::Geometry,
    file: &Path,
    options: &LoadOptions,
    warn: &mut impl FnMut(Remark, Topic),
) -> Result<Geometry, Remark> {
    Ok(match geometry {
        urdf_rs::Geometry::Sphere { radius } => Geometry::Sphere { radius: *radius },
        urdf_rs::Geometry::Box { size } => Geometry::Box { size: DVec3::from_array(**size) },
        urdf_rs::Geometry::Cylinder { radius, length } => Geometry::Cylinder { radius: *radius, length: *length },
        urdf_rs::Geometry::Capsule { radius, length } => Geometry::Capsule { radius: *radius, length: *length },
        urdf_rs::Geometry::Mesh { filename, scale } => {
            let path = resolve(filename, file, options).ok_or_else(|| {
                let remedy = match package_of(filename) {
                    Some((package, _)) => {
                        format!("name the directory of \"{package}\" in package_dirs (--package-dir {package}=FOLDER)")
                    }
                    None => "put the file there".to_string(),
                };
                (format!("mesh \"{filename}\" is not found"), remedy)
            })?;
            let scale = scale.map_or(DVec3::ONE, |scale| DVec3::from_array(*scale));
            convex(filename, &path, scale, warn)?
        }
    })
}

/// The convex hull of the mesh file at `path`; warns of what that assumes.
fn convex(filename: &str, path: &Path, scale: DVec3, warn: &mut impl FnMut(Remark, Topic)) -> Result<Geometry, Remark> {
    let unreadable = |problem: String| {
        let remedy = format!("write {} anew as STL, OBJ or COLLADA, in m", path.display());
        (format!("mesh \"{filename}\" is not read: {problem}"), remedy)
    };
    let (bytes, ending) = mesh::contents(path).map_err(unreadable)?;
    let Taken { points, count, deviation, boxed, assumed } =
        hull_cache::hull_of(bytes, &ending, scale, MAX_EXTENT).map_err(unreadable)?;
    let mut problem = if boxed {
        format!("mesh \"{filename}\" is taken as its bounding box, as the hull of its {count} vertices is not found")
    } else {
        format!("mesh \"{filename}\" is taken as the convex hull of {} of its {count} vertices", points.len())
    };
    if deviation >= MIN_DEVIATION {
        problem += &format!(", which lies up to {:.2} mm inside the hull of all", 1e3 * deviation);
    }
    if let Some(assumed) = assumed {
        problem += &format!("; {assumed}");
    }
    let topic = Topic::Hull { outside: (1e6 * deviation) as u64 };
    warn((problem, "check that it is convex enough".to_string()), topic);
    Ok(Geometry::Hull { points })
}

/// The existing file a mesh `filename` of the URDF at `source` means, if there is one.
///
/// `package://<package>/<rest>` is looked up in the package's directory when the options name it,
/// else in a directory called `<package>` next to the URDF or to one of its parent directories.
/// Other names are files, relative to the URDF.
fn resolve(filename: &str, source: &Path, options: &LoadOptions) -> Option<PathBuf> {
    let source = std::path::absolute(source).ok()?;
    let directory = source.parent()?;
    let existing = |path: PathBuf| path.is_file().then_some(path);
    match package_of(filename) {
        Some((package, rest)) => match options.package_dirs.get(package) {
            Some(root) => existing(root.join(rest)),
            None => directory.ancestors().find_map(|ancestor| existing(ancestor.join(package).join(rest))),
        },
        None => {
            let path = filename.strip_prefix("file://").unwrap_or(filename);
            existing(directory.join(path))
        }
    }
}

/// Splits `package://<package>/<rest>`; some makers write three slashes.
fn package_of(filename: &str) -> Option<(&str, &str)> {
    let name = filename.strip_prefix("package://").or_else(|| filename.strip_prefix("model://"))?;
    name.trim_start_matches('/').split_once('/')
}
