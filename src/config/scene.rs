//! The scene of a task: ground and obstacles.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use toml::{Table, Value};

use super::error::{ConfigError, ConfigErrorKind};
use super::quantities::{Angle, Coordinate, FrictionCoefficient, FrictionLength, Height, Length, Quantity};
use super::terrain::TerrainConfig;
use super::values;
use crate::robot::{Surface, read_surface};

/// Largest number of triangles of an obstacle: more are a scan.
const MOST_TRIANGLES: usize = 250_000;
/// Each step of stairs is a collider.
const MOST_STEPS: u32 = 10_000;
/// Lengths of an obstacle up to this are none, m.
const SMALLEST_LENGTH: f64 = 1e-6;

/// Heights that are below the ground by no more than this are level with it, m.
const FLUSH: f64 = 1e-6;

/// Ground and obstacles.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct SceneConfig {
    /// An infinite plane at z = 0, open where a heightfield reaches below it; with terrain only its
    /// surface counts.
    pub ground: GroundConfig,
    /// Generated ground, in place of the plane, with the ground's surface.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub terrain: Option<TerrainConfig>,
    /// Obstacles on the ground, with the ground's surface.
    pub obstacles: Vec<ObstacleConfig>,
    /// Placement of the obstacles. Default: in every env.
    pub placement: Placement,
    /// Distance of the points at which the articulated engine knows the height of terrain and
    /// obstacles, m. Default: 0.02.
    #[serde(deserialize_with = "values::number_of::<Length, _, _>")]
    pub grid_cell: f64,
}

/// Placement of the obstacles of a scene.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Placement {
    /// Every env has each of them; positions are about the env's origin.
    #[default]
    PerEnv,
    /// Each obstacle stands once in the world, where envs have their origins on a grid or on their
    /// tiles.
    Global,
}

impl Default for SceneConfig {
    fn default() -> Self {
        Self {
            ground: GroundConfig::default(),
            terrain: None,
            obstacles: Vec::new(),
            placement: Placement::PerEnv,
            grid_cell: 0.02,
        }
    }
}

/// Surface of the ground.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct GroundConfig {
    /// Coefficient of friction at rest. Default: 1.
    #[serde(deserialize_with = "values::number_of::<FrictionCoefficient, _, _>")]
    pub static_friction: f64,
    /// Coefficient of friction when sliding. Default: 1.
    #[serde(deserialize_with = "values::number_of::<FrictionCoefficient, _, _>")]
    pub dynamic_friction: f64,
    /// Coefficient of torsional friction, m: torque about a contact's normal per normal force.
    /// Default: 0.
    #[serde(deserialize_with = "values::number_of::<FrictionLength, _, _>", skip_serializing_if = "values::is_zero")]
    pub torsional_friction: f64,
    /// Coefficient of rolling friction, m: torque across a contact's normal per normal force.
    /// Default: 0.
    #[serde(deserialize_with = "values::number_of::<FrictionLength, _, _>", skip_serializing_if = "values::is_zero")]
    pub rolling_friction: f64,
    /// Share of the approach speed that is given back, 0 to 1. Default: 0.
    #[serde(deserialize_with = "values::fraction")]
    pub restitution: f64,
    /// Combination of the coefficients of ground and robot, of static and of dynamic friction.
    /// Default: multiply.
    pub friction_combine: FrictionCombine,
}

impl Default for GroundConfig {
    fn default() -> Self {
        Self {
            static_friction: 1.0,
            dynamic_friction: 1.0,
            torsional_friction: 0.0,
            rolling_friction: 0.0,
            restitution: 0.0,
            friction_combine: FrictionCombine::Multiply,
        }
    }
}

/// Combination of the coefficients of two surfaces into one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum FrictionCombine {
    /// The product of both coefficients.
    Multiply,
    /// The mean of both coefficients.
    Average,
    /// The smaller one.
    Min,
    /// The larger one.
    Max,
}

/// Something that does not move. `position` is about the env's origin or in the world (see
/// [`Placement`]), m; `rpy` are roll, pitch and yaw about fixed axes as in a URDF, rad, zero by
/// default.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(tag = "shape", rename_all = "snake_case", deny_unknown_fields)]
pub enum ObstacleConfig {
    /// A box about its centre.
    Box {
        /// Edge lengths, m.
        size: [f64; 3],
        /// Position of the centre.
        position: [f64; 3],
        /// Roll, pitch, yaw.
        #[serde(default)]
        rpy: [f64; 3],
    },
    /// A sphere about its centre.
    Sphere {
        /// Radius, m.
        radius: f64,
        /// Position of the centre.
        position: [f64; 3],
    },
    /// A cylinder about its centre, upright unless it is turned.
    Cylinder {
        /// Radius, m.
        radius: f64,
        /// Length, m.
        length: f64,
        /// Position of the centre.
        position: [f64; 3],
        /// Roll, pitch, yaw.
        #[serde(default)]
        rpy: [f64; 3],
    },
    /// A capsule about its centre, upright unless it is turned.
    Capsule {
        /// Radius, m.
        radius: f64,
        /// Distance between the centres of the ends, m.
        length: f64,
        /// Position of the centre.
        position: [f64; 3],
        /// Roll, pitch, yaw.
        #[serde(default)]
        rpy: [f64; 3],
    },
    /// A wedge that rises along x.
    Ramp {
        /// Length, width and height of the upper end, m.
        size: [f64; 3],
        /// Position of the middle of the underside.
        position: [f64; 3],
        /// Roll, pitch, yaw.
        #[serde(default)]
        rpy: [f64; 3],
    },
    /// Stairs that rise along x.
    Stairs {
        /// Depth, width and height of each step, m.
        size: [f64; 3],
        /// Number of steps.
        steps: u32,
        /// Position of the middle of the underside.
        position: [f64; 3],
        /// Roll, pitch, yaw.
        #[serde(default)]
        rpy: [f64; 3],
    },
    /// The triangles of a mesh.
    Mesh {
        /// STL or OBJ, in m, relative to the file that names it. While the task is loaded it is
        /// read into `vertices` and `triangles`, which then stand in its place.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        file: Option<PathBuf>,
        /// Factor along each of the mesh's own axes, above 0. Default: 1.
        #[serde(default = "unscaled")]
        scale: [f64; 3],
        /// Position of the mesh's origin.
        position: [f64; 3],
        /// Roll, pitch, yaw.
        #[serde(default)]
        rpy: [f64; 3],
        /// Corners before scaling, m.
        #[serde(default)]
        vertices: Vec<[f64; 3]>,
        /// Three corners each, counted from 0.
        #[serde(default)]
        triangles: Vec<[u32; 3]>,
    },
    /// A surface over a rectangle, two triangles between four heights. Where some are below the
    /// ground, there is no plane in the rectangle.
    Heightfield {
        /// Edge lengths along x and y, m.
        size: [f64; 2],
        /// `heights[i][j]`, m: `i` along x, `j` along y; at least two of each.
        heights: Vec<Vec<f64>>,
        /// Position of the middle, at height zero.
        position: [f64; 3],
        /// Roll, pitch, yaw.
        #[serde(default)]
        rpy: [f64; 3],
    },
}

fn unscaled() -> [f64; 3] {
    [1.0; 3]
}

impl SceneConfig {
    /// Problem that no single value shows: element, problem and remedy.
    pub(super) fn problem(&self) -> Option<(String, &'static str, &'static str)> {
        if let Some(terrain) = &self.terrain {
            if let Some(problem) = terrain.problem() {
                return Some(problem);
            }
            let steps = terrain.edge_step / self.grid_cell;
            if terrain.has_edges() && (steps - steps.round()).abs() > 1e-6 * steps {
                let problem = "edges of tiles would lie between the points of the grid, scene.grid_cell apart";
                return Some(("scene.terrain.edge_step".into(), problem, "write a multiple of scene.grid_cell"));
            }
            if !self.obstacles.is_empty() && self.placement == Placement::PerEnv {
                let problem = "obstacles of every env cannot stand on terrain, of which there is one";
                return Some(("scene.placement".into(), problem, "write scene.placement = \"global\""));
            }
        }
        self.obstacles.iter().enumerate().find_map(|(i, obstacle)| {
            let covered = obstacle.pit().filter(|_| self.terrain.is_some()).map(|_| {
                ("it has heights below 0, where generated terrain covers it", "raise it, or leave out scene.terrain")
            });
            let (problem, remedy) = obstacle.problem().or(covered)?;
            Some((format!("scene.obstacles[{i}]"), problem, remedy))
        })
    }

    /// Rectangles in which the plane is open, see [`ObstacleConfig::pit`].
    pub fn pits(&self) -> Vec<[[f64; 2]; 2]> {
        self.obstacles.iter().filter_map(ObstacleConfig::pit).collect()
    }
}

impl ObstacleConfig {
    /// Position and orientation: `position` and `rpy`.
    pub fn placement(&self) -> ([f64; 3], [f64; 3]) {
        match self {
            Self::Sphere { position, .. } => (*position, [0.0; 3]),
            Self::Box { position, rpy, .. }
            | Self::Cylinder { position, rpy, .. }
            | Self::Capsule { position, rpy, .. }
            | Self::Ramp { position, rpy, .. }
            | Self::Stairs { position, rpy, .. }
            | Self::Mesh { position, rpy, .. }
            | Self::Heightfield { position, rpy, .. } => (*position, *rpy),
        }
    }

    /// The rectangle of a heightfield that reaches below the ground, as its corners of smallest and
    /// largest x and y, m: the plane is open there, and the field's heights are the ground.
    pub fn pit(&self) -> Option<[[f64; 2]; 2]> {
        let Self::Heightfield { size, heights, position: [x, y, z], .. } = self else {
            return None;
        };
        let lowest = heights.iter().flatten().fold(f64::INFINITY, |low: f64, height| low.min(*height));
        let half = size.map(|edge| 0.5 * edge);
        (z + lowest < -FLUSH).then_some([[x - half[0], y - half[1]], [x + half[0], y + half[1]]])
    }

    /// Lengths of the shape, m, or the factors of a mesh.
    fn lengths(&self) -> [f64; 3] {
        match self {
            Self::Box { size, .. } | Self::Ramp { size, .. } | Self::Stairs { size, .. } => *size,
            Self::Sphere { radius, .. } => [*radius; 3],
            Self::Cylinder { radius, length, .. } | Self::Capsule { radius, length, .. } => [*radius, *length, 1.0],
            Self::Heightfield { size, .. } => [size[0], size[1], 1.0],
            Self::Mesh { scale, .. } => *scale,
        }
    }

    /// Whether it is larger or farther away than anything in a world of robots; heights are looked
    /// for from 100 m downwards.
    pub(super) fn is_out_of_reach(&self) -> bool {
        let ([x, y, z], rpy) = self.placement();
        let within = |numbers: &[f64], most: f64| numbers.iter().all(|number| number.abs() <= most);
        let heights: &[Vec<f64>] = if let Self::Heightfield { heights, .. } = self { heights } else { &[] };
        !(within(&[x, y], Coordinate::MOST)
            && within(&[z], Height::MOST)
            && within(&rpy, Angle::MOST)
            && within(&self.lengths(), Length::MOST)
            && heights.iter().all(|row| within(row, Height::MOST)))
    }

    fn problem(&self) -> Option<(&'static str, &'static str)> {
        let (position, rpy) = self.placement();
        if !position.iter().chain(&rpy).all(|x| x.is_finite()) {
            return Some(("its position or rpy is not finite", "write finite numbers"));
        }
        if !self.lengths().iter().all(|x| x.is_finite() && *x > SMALLEST_LENGTH) {
            return Some(("a length of it is not above zero", "write lengths in m, above 0"));
        }
        match self {
            Self::Mesh { vertices, triangles, .. } => {
                let known = |corner: &u32| (*corner as usize) < vertices.len();
                if triangles.is_empty() {
                    Some(("it has no triangles", "name a file, or write vertices and triangles"))
                } else if !triangles.iter().flatten().all(known) {
                    Some(("a triangle of it names a corner that is not there", "count the vertices from 0"))
                } else if !vertices.iter().flatten().all(|x| x.is_finite()) {
                    Some(("a vertex of it is not finite", "write finite numbers"))
                } else {
                    None
                }
            }
            Self::Stairs { steps: 0, .. } => Some(("it has no steps", "write steps = 1 or more")),
            Self::Stairs { steps, .. } if *steps > MOST_STEPS => {
                Some(("it has more than 10 000 steps", "write fewer steps, or a ramp"))
            }
            Self::Heightfield { heights, .. } => {
                let columns = heights.first().map_or(0, Vec::len);
                let rectangular = heights.iter().all(|row| row.len() == columns);
                if heights.len() < 2 || columns < 2 || !rectangular {
                    Some(("its heights are not a table of at least two by two", "write rows of equal length"))
                } else if !heights.iter().flatten().all(|x| x.is_finite()) {
                    Some(("a height of it is not finite", "write finite numbers"))
                } else if self.pit().is_some() && rpy != [0.0; 3] {
                    Some(("it is turned and has heights below 0, the ground's", "leave out its rpy, or raise it"))
                } else {
                    None
                }
            }
            _ => None,
        }
    }
}

/// Reads the files that the mesh obstacles of a task's table name, relative to `dir`, into the
/// table in place of their names: nothing needs them from then on.
///
/// # Errors
/// A file that cannot be read, or has too many triangles; without the name of the task's file.
pub(super) fn embed_meshes(task: &mut Table, dir: &Path) -> Result<(), ConfigError> {
    let scene = task.get_mut("scene").and_then(Value::as_table_mut);
    let Some(obstacles) = scene.and_then(|scene| scene.get_mut("obstacles")).and_then(Value::as_array_mut) else {
        return Ok(());
    };
    for (i, obstacle) in obstacles.iter_mut().enumerate() {
        let Some(obstacle) = obstacle.as_table_mut() else {
            continue;
        };
        let is_mesh = obstacle.get("shape").and_then(Value::as_str) == Some("mesh");
        let Some(file) = obstacle.get("file").and_then(Value::as_str).filter(|_| is_mesh) else {
            continue;
        };
        let path = dir.join(file);
        let invalid = |problem: String, remedy: &str| {
            let problem = format!("{}: {problem}", path.display());
            ConfigError::invalid("", format!("scene.obstacles[{i}].file"), problem, remedy)
        };
        let Surface { vertices, triangles } = read_surface(&path).map_err(|problem| {
            invalid(problem, "name an STL or OBJ file, relative to this file").of_kind(ConfigErrorKind::Unreadable)
        })?;
        if triangles.len() > MOST_TRIANGLES {
            let problem = format!("it has {} triangles", triangles.len());
            return Err(invalid(problem, &format!("simplify it to {MOST_TRIANGLES} at most")));
        }
        let rows = |rows: Vec<[Value; 3]>| Value::Array(rows.into_iter().map(|row| row.to_vec().into()).collect());
        obstacle.insert("vertices".into(), rows(vertices.into_iter().map(|v| v.map(Value::from)).collect()));
        let corners = triangles.into_iter().map(|t| t.map(|corner| Value::from(i64::from(corner))));
        obstacle.insert("triangles".into(), rows(corners.collect()));
        obstacle.remove("file");
    }
    Ok(())
}
