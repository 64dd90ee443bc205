//! Contact bodies from collision elements; meshes are found without ROS.

use std::path::{Path, PathBuf};

use glam::DVec3;

use super::error::{Topic, Warning};
use super::hull_cache::{self, Taken};
use super::merge::MAX_EXTENT;
use super::mesh;
use super::model::{Body, Geometry, Shape};
use super::pose::Pose;
use super::urdf::LoadOptions;

/// A hull this close to that of all vertices is called the same, m.
const MIN_DEVIATION: f64 = 5e-6;

/// The links with collision shapes, in the file's order, where `places` has put them: the index of
/// the merged link and the frame in it.
pub(super) fn bodies(
    robot: &urdf_rs::Robot,
    places: &[Option<(usize, Pose)>],
    file: &Path,
    options: &LoadOptions,
    warnings: &mut Vec<Warning>,
) -> Vec<Body> {
    let mut bodies = Vec::new();
    for (link, place) in robot.links.iter().zip(places) {
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
            bodies.push(Body { name: link.name.clone(), link: merged, shapes });
        }
    }
    bodies
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
/// else in a directory called `<package>` beside the URDF or beside one of its parent directories.
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

/// Splits `package://<package>/<rest>`.
fn package_of(filename: &str) -> Option<(&str, &str)> {
    filename.strip_prefix("package://").or_else(|| filename.strip_prefix("model://"))?.split_once('/')
}
