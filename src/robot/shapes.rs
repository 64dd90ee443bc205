//! Contact bodies from collision elements; meshes are found without ROS.

use std::path::{Path, PathBuf};

use glam::DVec3;

use super::error::Warning;
use super::model::{Body, Geometry, Shape};
use super::pose::Pose;
use super::urdf::LoadOptions;

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
            match geometry(&collision.geometry, file, options) {
                Ok(geometry) => shapes.push(Shape { geometry, origin: place * Pose::from_urdf(&collision.origin) }),
                Err(missing) => warnings.push(Warning::new(
                    file,
                    format!("link \"{}\", <collision>", link.name),
                    format!("mesh \"{}\" is not found; the shape is left out", missing.filename),
                    format!("{}, or use a sphere, box, cylinder or capsule", missing.remedy),
                )),
            }
        }
        if !shapes.is_empty() {
            bodies.push(Body { name: link.name.clone(), link: merged, shapes });
        }
    }
    bodies
}

/// A mesh that is not where its name says.
struct MissingMesh {
    filename: String,
    remedy: String,
}

fn geometry(geometry: &urdf_rs::Geometry, file: &Path, options: &LoadOptions) -> Result<Geometry, MissingMesh> {
    Ok(match geometry {
        urdf_rs::Geometry::Sphere { radius } => Geometry::Sphere { radius: *radius },
        urdf_rs::Geometry::Box { size } => Geometry::Box { size: DVec3::from_array(**size) },
        urdf_rs::Geometry::Cylinder { radius, length } => Geometry::Cylinder { radius: *radius, length: *length },
        urdf_rs::Geometry::Capsule { radius, length } => Geometry::Capsule { radius: *radius, length: *length },
        urdf_rs::Geometry::Mesh { filename, scale } => Geometry::Mesh {
            path: resolve(filename, file, options).ok_or_else(|| MissingMesh {
                filename: filename.clone(),
                remedy: match package_of(filename) {
                    Some((package, _)) => {
                        format!("name the directory of \"{package}\" in package_dirs")
                    }
                    None => "put the file there".to_string(),
                },
            })?,
            scale: scale.map_or(DVec3::ONE, |scale| DVec3::from_array(*scale)),
        },
    })
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
