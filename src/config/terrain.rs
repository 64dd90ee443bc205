//! Generated terrain: `[scene.terrain]` of a task.

use serde::{Deserialize, Serialize};

use super::quantities::{Difficulty, Extent, Height, Length, Proportion, Rise, Slope, Spacing, SteepSlope};
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
    /// By an env's index among those of its robot: every robot meets every type of tile in equal
    /// shares.
    #[default]
    PerRobot,
    /// By an env's index among all: neighbours share a column, so that a robot meets few types.
    Contiguous,
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

/// Shape of a tile. Ranges go from difficulty 0 to difficulty 1, lengths are in m.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum SubTerrainShape {
    /// A plane at height 0.
    Flat {},
    /// Square rings of steps that rise towards the middle.
    PyramidStairs(StairsConfig),
    /// Square rings of steps that go down towards the middle.
    PyramidStairsInv(StairsConfig),
    /// Square blocks of random heights about 0.
    Boxes(BoxesConfig),
    /// A height field of random heights.
    RandomRough(RoughConfig),
    /// A height field that rises towards the middle.
    HfPyramidSlope(SlopeConfig),
    /// A height field that falls towards the middle.
    HfPyramidSlopeInv(SlopeConfig),
}

/// Stairs around a platform.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct StairsConfig {
    /// Height of a step.
    #[serde(deserialize_with = "values::range_of::<Rise, _, _>")]
    pub step_height_range: [f64; 2],
    /// Depth of a step.
    #[serde(deserialize_with = "values::number_of::<Length, _, _>")]
    pub step_width: f64,
    /// Edge length of the platform in the middle, at least.
    #[serde(deserialize_with = "values::number_of::<Length, _, _>")]
    pub platform_width: f64,
    /// Width of the flat edge of the tile.
    #[serde(deserialize_with = "values::number_of::<Extent, _, _>")]
    pub border_width: f64,
}

/// Blocks around a platform.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct BoxesConfig {
    /// Edge length of a block.
    #[serde(deserialize_with = "values::number_of::<Length, _, _>")]
    pub grid_width: f64,
    /// Largest height and depth of a block.
    #[serde(deserialize_with = "values::range_of::<Rise, _, _>")]
    pub grid_height_range: [f64; 2],
    /// Edge length of the platform in the middle; it is as high as the highest block may be.
    #[serde(deserialize_with = "values::number_of::<Length, _, _>")]
    pub platform_width: f64,
}

/// Random heights. The difficulty changes nothing.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct RoughConfig {
    /// Smallest and largest height.
    #[serde(deserialize_with = "values::range_of::<Height, _, _>")]
    pub noise_range: [f64; 2],
    /// Heights are the smallest one plus multiples of this.
    #[serde(deserialize_with = "values::number_of::<Spacing, _, _>")]
    pub noise_step: f64,
    /// Width of the flat edge of the tile.
    #[serde(deserialize_with = "values::number_of::<Extent, _, _>")]
    pub border_width: f64,
}

/// A slope around a platform.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct SlopeConfig {
    /// Slope along the middle of a side, rise over run.
    #[serde(deserialize_with = "values::range_of::<Slope, _, _>")]
    pub slope_range: [f64; 2],
    /// Edge length of the platform in the middle.
    #[serde(deserialize_with = "values::number_of::<Length, _, _>")]
    pub platform_width: f64,
    /// Width of the flat edge of the tile.
    #[serde(deserialize_with = "values::number_of::<Extent, _, _>")]
    pub border_width: f64,
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

impl SubTerrainShape {
    /// Largest number of vertices of a tile, about.
    fn num_vertices(&self, terrain: &TerrainConfig) -> f64 {
        // four corners of a rectangle; a frame is four of them, and so are walls
        const RECTANGLE: f64 = 4.0;
        let [x, y] = terrain.size;
        match self {
            Self::Flat {} => RECTANGLE,
            Self::PyramidStairs(c) | Self::PyramidStairsInv(c) => {
                8.0 * RECTANGLE * (0.5 * x.min(y) / c.step_width + 3.0)
            }
            Self::Boxes(c) => 5.0 * RECTANGLE * ((x / c.grid_width) * (y / c.grid_width) + 3.0),
            Self::RandomRough(_) | Self::HfPyramidSlope(_) | Self::HfPyramidSlopeInv(_) => {
                (x / terrain.horizontal_scale + 2.0) * (y / terrain.horizontal_scale + 2.0)
            }
        }
    }

    /// Problem of the shape on a tile of this edge length, and the remedy.
    fn problem(&self, size: f64) -> Option<(&'static str, &'static str)> {
        let (inner, platform) = match self {
            Self::Flat {} => return None,
            Self::PyramidStairs(c) | Self::PyramidStairsInv(c) => (size - 2.0 * c.border_width, c.platform_width),
            Self::Boxes(c) if size / c.grid_width > 1000.0 => {
                return Some(("there would be more than a million blocks", "raise grid_width"));
            }
            Self::Boxes(c) => (size, c.platform_width),
            Self::RandomRough(c) => (size - 2.0 * c.border_width, 0.0),
            Self::HfPyramidSlope(c) | Self::HfPyramidSlopeInv(c) => (size - 2.0 * c.border_width, c.platform_width),
        };
        if inner <= platform {
            return Some(("its border and platform are wider than the tile", "make them narrower"));
        }
        match self {
            Self::PyramidStairs(c) | Self::PyramidStairsInv(c) if size / c.step_width > 10_000.0 => {
                Some(("there would be too many steps", "raise step_width"))
            }
            _ => None,
        }
    }
}
