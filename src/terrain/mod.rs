//! Generated terrain: tiles of several types and levels of difficulty, as triangles.
//!
//! The shapes are those of Isaac Lab's rough terrain. Each tile is drawn from a separate stream, so
//! that it does not depend on the others.

mod mesh;
mod tiles;

pub use mesh::Mesh;

use crate::components::EnvRng;
use crate::config::TerrainConfig;

/// Tiles of a terrain: their places and types.
#[derive(Clone, Debug, PartialEq)]
pub struct TerrainLayout {
    /// Levels of difficulty: tiles along x.
    pub num_rows: u32,
    /// Tiles along y.
    pub num_cols: u32,
    /// Edge lengths of a tile, m.
    pub size: [f32; 2],
    /// Index of each column's type.
    pub column_types: Vec<usize>,
    /// Names of the types.
    pub type_names: Vec<String>,
    /// Envs begin at levels from 0 to this one.
    pub max_init_level: u32,
}

impl TerrainLayout {
    /// Layout of a terrain's tiles.
    pub fn new(config: &TerrainConfig) -> Self {
        let last = config.num_rows.saturating_sub(1);
        Self {
            num_rows: config.num_rows,
            num_cols: config.num_cols,
            size: config.size.map(|x| x as f32),
            column_types: config.column_types(),
            type_names: config.sub_terrains.iter().map(|sub| sub.name.clone()).collect(),
            max_init_level: config.max_init_terrain_level.unwrap_or(last).min(last),
        }
    }

    /// The middle of a tile in the world, m.
    pub fn origin(&self, level: u32, column: u32) -> [f32; 2] {
        let middle = |index: u32, count: u32, size: f32| (index as f32 + 0.5 - 0.5 * count as f32) * size;
        [middle(level, self.num_rows, self.size[0]), middle(column, self.num_cols, self.size[1])]
    }

    /// Column of the env at `index` among its robot's envs. All columns get the same number of a
    /// robot's envs: `num_cols` consecutive envs have all columns, a few have columns far apart.
    pub fn column_of(&self, index: usize) -> u32 {
        let columns = u64::from(self.num_cols);
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

/// All tiles, row by row.
pub fn generate(config: &TerrainConfig) -> Vec<Tile> {
    let layout = TerrainLayout::new(config);
    let tile = |row: u32, column: u32| {
        let mut rng = EnvRng::new(config.seed, u64::from(row * config.num_cols + column));
        let [low, high] = config.difficulty_range;
        let share = (f64::from(row) + f64::from(rng.unit())) / f64::from(config.num_rows);
        let shape = &config.sub_terrains[layout.column_types[column as usize]].shape;
        let mesh = tiles::mesh(shape, config, low + (high - low) * share, &mut rng);
        Tile { row, column, mesh, origin: layout.origin(row, column) }
    };
    (0..config.num_rows)
        .flat_map(|row| (0..config.num_cols).map(move |column| (row, column)))
        .map(|(r, c)| tile(r, c))
        .collect()
}

/// The flat border around all tiles, m, world axes.
pub fn border(config: &TerrainConfig) -> Mesh {
    let half = [0, 1].map(|axis| 0.5 * config.size[axis] * f64::from([config.num_rows, config.num_cols][axis]));
    let mut mesh = Mesh::default();
    mesh.frame(half.map(|x| x + config.border_width), half, 0.0);
    mesh
}
