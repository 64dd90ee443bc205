//! Generated terrain: tiles of several types and levels of difficulty, as triangles.
//!
//! The shapes are those of Isaac Lab's terrain generator and a few more. Each tile is drawn from a
//! separate stream, so that it does not depend on the others.

mod field;
mod mesh;
mod rings;
mod scattered;
mod tiles;

pub use mesh::Mesh;

use crate::components::EnvRng;
use crate::config::TerrainConfig;

/// Tiles of a terrain: their places and types.
#[derive(Clone, Debug, PartialEq)]
pub struct TerrainLayout {
    /// Levels of difficulty: tiles along x.
    pub num_rows: u32,
    /// Tiles along y: those of each scale in turn.
    pub num_cols: u32,
    /// Tiles along y that the robots of one scale share.
    pub cols_per_scale: u32,
    /// Factors of the heights, gaps and widths that change with the difficulty.
    pub scales: Vec<f64>,
    /// Place in `scales` of each robot; empty where all robots share all columns.
    pub scale_of_robot: Vec<usize>,
    /// Edge lengths of a tile, m.
    pub size: [f32; 2],
    /// Index of each column's type.
    pub column_types: Vec<usize>,
    /// Names of the types.
    pub type_names: Vec<String>,
    /// Envs begin at levels from 0 to this one.
    pub max_init_level: u32,
}

/// Scales of robots are multiples of this.
const SCALE_STEP: f64 = 0.1;

impl TerrainLayout {
    /// Layout of a terrain's tiles, none of which is scaled.
    pub fn new(config: &TerrainConfig) -> Self {
        Self::for_robots(config, &[])
    }

    /// Layout of a terrain's tiles for robots with these leg lengths, m.
    pub fn for_robots(config: &TerrainConfig, legs: &[f64]) -> Self {
        let last = config.num_rows.saturating_sub(1);
        let legs = if config.scale_by.is_some() { legs } else { &[] };
        let most = config.max_scale.unwrap_or(f64::INFINITY);
        let steps = |leg: &f64| ((leg / config.reference_leg_length).min(most) / SCALE_STEP).round().max(1.0) as u32;
        let mut distinct: Vec<u32> = legs.iter().map(steps).collect();
        distinct.sort_unstable();
        distinct.dedup();
        let scale_of_robot = legs.iter().map(|leg| distinct.partition_point(|scale| *scale < steps(leg))).collect();
        let scales: Vec<f64> = match distinct.len() {
            0 => vec![1.0],
            _ => distinct.iter().map(|steps| f64::from(*steps) * SCALE_STEP).collect(),
        };
        Self {
            num_rows: config.num_rows,
            num_cols: config.num_cols * scales.len() as u32,
            cols_per_scale: config.num_cols,
            scale_of_robot,
            size: config.size.map(|x| x as f32),
            column_types: config.column_types().repeat(scales.len()),
            scales,
            type_names: config.sub_terrains.iter().map(|sub| sub.name.clone()).collect(),
            max_init_level: config.max_init_terrain_level.unwrap_or(last).min(last),
        }
    }

    /// The middle of a tile in the world, m.
    pub fn origin(&self, level: u32, column: u32) -> [f32; 2] {
        let middle = |index: u32, count: u32, size: f32| (index as f32 + 0.5 - 0.5 * count as f32) * size;
        [middle(level, self.num_rows, self.size[0]), middle(column, self.num_cols, self.size[1])]
    }

    /// First column of a robot, by its place among those of the task.
    pub fn first_column(&self, robot: usize) -> u32 {
        self.scale_of_robot.get(robot).map_or(0, |scale| *scale as u32 * self.cols_per_scale)
    }

    /// Factor of a column's tiles.
    pub fn scale(&self, column: u32) -> f64 {
        self.scales[(column / self.cols_per_scale) as usize]
    }

    /// Column of the env at `index` among its robot's envs, counted from the robot's first one. All
    /// columns get the same number of a robot's envs: `cols_per_scale` consecutive envs have all
    /// columns, a few have columns far apart.
    pub fn column_of(&self, index: usize) -> u32 {
        let columns = u64::from(self.cols_per_scale);
        let common = |a: u64, b: u64| {
            let (mut a, mut b) = (a, b);
            while b > 0 {
                (a, b) = (b, a % b);
            }
            a
        };
        // the golden section spreads best
        let stride = (columns * 618 / 1000..).find(|&stride| common(stride, columns) == 1).unwrap_or(1);
        (index as u64 % columns * stride % columns) as u32
    }
}

/// A tile's surface about its middle, and its place in the world.
pub struct Tile {
    /// Level of difficulty.
    pub row: u32,
    /// Place along y.
    pub column: u32,
    /// Surface about `origin`, m, world axes.
    pub mesh: Mesh,
    /// x and y of the middle, m.
    pub origin: [f32; 2],
}

/// All tiles, row by row, of a terrain whose tiles are not scaled.
pub fn generate(config: &TerrainConfig) -> Vec<Tile> {
    generate_in(config, &TerrainLayout::new(config))
}

/// All tiles of a layout, row by row. The random numbers of a tile do not depend on its scale.
pub fn generate_in(config: &TerrainConfig, layout: &TerrainLayout) -> Vec<Tile> {
    let tile = |row: u32, column: u32| {
        let stream = row * layout.cols_per_scale + column % layout.cols_per_scale;
        let mut rng = EnvRng::new(config.seed, u64::from(stream));
        let [low, high] = config.difficulty_range;
        let share = (f64::from(row) + f64::from(rng.unit())) / f64::from(config.num_rows);
        let shape = &config.sub_terrains[layout.column_types[column as usize]].shape;
        let level = tiles::Level { config, difficulty: low + (high - low) * share, scale: layout.scale(column) };
        let mesh = level.mesh(shape, &mut rng);
        Tile { row, column, mesh, origin: layout.origin(row, column) }
    };
    (0..layout.num_rows)
        .flat_map(|row| (0..layout.num_cols).map(move |column| (row, column)))
        .map(|(r, c)| tile(r, c))
        .collect()
}

/// The flat border around all tiles, m, world axes.
pub fn border(config: &TerrainConfig, layout: &TerrainLayout) -> Mesh {
    let half = [0, 1].map(|axis| 0.5 * config.size[axis] * f64::from([layout.num_rows, layout.num_cols][axis]));
    let mut mesh = Mesh::default();
    mesh.frame(half.map(|x| x + config.border_width), half, 0.0);
    mesh
}
