//! Generated terrain: `[scene.terrain]` of a task.

use serde::{Deserialize, Serialize};

use super::quantities::{BodyFactor, Difficulty, Length, Proportion, Spacing, SteepSlope};
use super::tiles::SubTerrainShape;
use super::values;

/// Tiles side by side in a grid about the world's origin: along x they grow harder, along y their
/// type changes. Field names and meaning are those of Isaac Lab's terrain generator.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct TerrainConfig {
    /// Edge lengths of a tile along x and y, m.
    #[serde(deserialize_with = "values::list_of::<Length, _, _>")]
    pub size: [f64; 2],
    /// Tiles along x: levels of difficulty.
    #[serde(deserialize_with = "values::at_least_one")]
    pub num_rows: u32,
    /// Tiles along y, shared out among the types.
    #[serde(deserialize_with = "values::at_least_one")]
    pub num_cols: u32,
    /// Width of the flat border around all tiles, m.
    #[serde(deserialize_with = "values::number_of::<Length, _, _>")]
    pub border_width: f64,
    /// Distance of the vertices of height fields, m. Default: 0.1.
    #[serde(default = "horizontal_scale", deserialize_with = "values::number_of::<Length, _, _>")]
    pub horizontal_scale: f64,
    /// Step of the heights of height fields, m. Default: 0.005.
    #[serde(default = "vertical_scale", deserialize_with = "values::number_of::<Spacing, _, _>")]
    pub vertical_scale: f64,
    /// Faces of height fields that are steeper than this become vertical, rise over run. Default:
    /// 0.75.
    #[serde(default = "slope_threshold", deserialize_with = "values::number_of::<SteepSlope, _, _>")]
    pub slope_threshold: f64,
    /// Distance of which the edges of gaps, rails, beams and stones are multiples, m: a multiple of
    /// `scene.grid_cell`, so that both engines stand on the same edges. Default: 0.025.
    #[serde(
        default = "edge_step",
        deserialize_with = "values::number_of::<Length, _, _>",
        skip_serializing_if = "is_edge_step"
    )]
    pub edge_step: f64,
    /// Length by which the tiles of a robot are scaled: the heights, gaps and widths that change
    /// with the difficulty. Robots of other scales have other columns. Default: all robots share
    /// all columns.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scale_by: Option<ScaleBy>,
    /// Leg length of the robots for which the ranges of the tiles hold, m; for `scale_by`. Default:
    /// 0.5.
    #[serde(
        default = "reference_leg_length",
        deserialize_with = "values::number_of::<Length, _, _>",
        skip_serializing_if = "is_reference_leg_length"
    )]
    pub reference_leg_length: f64,
    /// Largest factor by which `scale_by` enlarges tiles. Default: no limit.
    #[serde(
        default,
        deserialize_with = "values::optional_of::<BodyFactor, _, _>",
        skip_serializing_if = "Option::is_none"
    )]
    pub max_scale: Option<f64>,
    /// Difficulty of the first and beyond the last row. Default: 0 to 1.
    #[serde(default = "difficulty_range", deserialize_with = "values::range_of::<Difficulty, _, _>")]
    pub difficulty_range: [f64; 2],
    /// Columns of the envs. Default: every robot meets all of them equally often.
    #[serde(default)]
    pub columns: Columns,
    /// Seed of everything that is random in the terrain. Default: 0.
    #[serde(default)]
    pub seed: u64,
    /// Envs begin at levels from 0 to this one; at any level when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_init_terrain_level: Option<u32>,
    /// The types of tiles, in the order of their columns.
    pub sub_terrains: Vec<SubTerrainConfig>,
}

/// Assignment of columns of tiles to envs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Columns {
    /// An env's column follows from its index among the envs of its robot: every robot meets every
    /// type of tile in equal shares.
    #[default]
    PerRobot,
    /// An env's column follows from its index among all envs: neighbours share a column, so that a
    /// robot meets few types.
    Contiguous,
}

/// Length that scales a robot's tiles.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ScaleBy {
    /// Height of the hips above the ground in the default pose, as a share of
    /// `reference_leg_length`, to the nearest tenth.
    LegLength,
}

fn edge_step() -> f64 {
    0.025
}

fn is_edge_step(step: &f64) -> bool {
    *step == edge_step()
}

fn reference_leg_length() -> f64 {
    0.5
}

fn is_reference_leg_length(length: &f64) -> bool {
    *length == reference_leg_length()
}

fn horizontal_scale() -> f64 {
    0.1
}

fn vertical_scale() -> f64 {
    0.005
}

fn slope_threshold() -> f64 {
    0.75
}

fn difficulty_range() -> [f64; 2] {
    [0.0, 1.0]
}

/// One type of tile.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
pub struct SubTerrainConfig {
    /// Name in logs.
    pub name: String,
    /// Share of the columns, in proportion to those of the other types.
    #[serde(deserialize_with = "values::number_of::<Proportion, _, _>")]
    pub proportion: f64,
    /// Shape of the tile.
    #[serde(flatten)]
    pub shape: SubTerrainShape,
}

/// Vertices that a height field may have along a side.
const MOST_VERTICES: f64 = 4000.0;
/// Vertices of all tiles: with their triangles and the trees that find these they take about a
/// gigabyte.
const MOST_VERTICES_IN_ALL: f64 = 8e6;

impl TerrainConfig {
    /// Problem that no single value shows: element, problem and remedy.
    pub(super) fn problem(&self) -> Option<(String, &'static str, &'static str)> {
        let own = |element: &str, problem, remedy| Some((format!("scene.terrain.{element}"), problem, remedy));
        let [x, y] = self.size;
        if !(x.is_finite() && y.is_finite() && x > 0.0 && y > 0.0) {
            return own("size", "a tile has no area", "write two lengths in m, above 0");
        }
        if x.max(y) / self.horizontal_scale > MOST_VERTICES {
            return own("horizontal_scale", "a height field would have too many vertices", "raise it");
        }
        if self.num_rows.saturating_mul(self.num_cols) > 100_000 {
            return own("num_rows", "there would be more than 100 000 tiles", "lower num_rows or num_cols");
        }
        if self.sub_terrains.is_empty() {
            return own("sub_terrains", "there is no type of tile", "add [[scene.terrain.sub_terrains]] tables");
        }
        let of_type = self.sub_terrains.iter().enumerate().find_map(|(i, sub)| {
            let (problem, remedy) = sub.shape.problem(x.min(y))?;
            Some((format!("scene.terrain.sub_terrains[{i}]"), problem, remedy))
        });
        of_type.or_else(|| {
            let of_column = |kind: usize| self.sub_terrains[kind].shape.num_vertices(self);
            let all = f64::from(self.num_rows) * self.column_types().into_iter().map(of_column).sum::<f64>();
            let remedy = "lower num_rows, num_cols or size, or make the tiles coarser";
            if all > MOST_VERTICES_IN_ALL {
                own("num_rows", "the tiles would have more than 8 million vertices", remedy)
            } else {
                None
            }
        })
    }

    /// Whether it has a tile whose edges are multiples of `edge_step`.
    pub(super) fn has_edges(&self) -> bool {
        self.sub_terrains.iter().any(|sub| sub.shape.has_edges())
    }

    /// Type of each column.
    pub fn column_types(&self) -> Vec<usize> {
        let total: f64 = self.sub_terrains.iter().map(|sub| sub.proportion).sum();
        (0..self.num_cols)
            .map(|column| {
                // the small number keeps a column that begins at a boundary on its far side
                let share = f64::from(column) / f64::from(self.num_cols) + 1e-3 / f64::from(self.num_cols);
                let mut end = 0.0;
                let found = self.sub_terrains.iter().position(|sub| {
                    end += sub.proportion / total;
                    share < end
                });
                found.unwrap_or(self.sub_terrains.len() - 1)
            })
            .collect()
    }
}
