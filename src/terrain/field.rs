//! Tiles that are height fields.

use super::mesh::Mesh;
use super::tiles::Level;
use crate::components::EnvRng;
use crate::config::{
    HeightfieldConfig, MixtureConfig, ObstacleHeight, ObstaclesConfig, RoughConfig, SlopeConfig, TerrainConfig,
    WaveConfig,
};
use crate::dynamics::HeightGrid;
use crate::dynamics::lanes::Real;

/// A pyramid whose height is the product of one along x and one along y, cut off where the
/// platform's corners are.
pub(super) fn slope(c: &SlopeConfig, config: &TerrainConfig, slope: f64) -> Mesh {
    let mut field = Field::new(config, c.border_width);
    let [n, m] = field.inner();
    // the longest way up is half of the inner part along x, as in the reference
    let peak = (slope * 0.5 * n as f64 * config.horizontal_scale / config.vertical_scale).trunc();
    let share = |index: usize, count: usize| {
        let middle = (count / 2).max(1) as f64;
        1.0 - (middle - index as f64).abs() / middle
    };
    let height = |i: usize, j: usize| peak * share(i, n) * share(j, m);
    let reach = (0.5 * c.platform_width / config.horizontal_scale) as usize;
    let most = height((n / 2).saturating_sub(reach), (m / 2).saturating_sub(reach));
    for i in 0..n {
        for j in 0..m {
            field.set(i, j, height(i, j).clamp(most.min(0.0), most.max(0.0)).round_ties_even());
        }
    }
    field.mesh(config)
}

/// Heights in units of the vertical scale.
pub(super) struct Field {
    heights: Vec<f64>,
    size: [usize; 2],
    border: usize,
}

impl Field {
    pub(super) fn new(config: &TerrainConfig, border_width: f64) -> Self {
        let size = config.size.map(|x| ((x / config.horizontal_scale).round() as usize).max(1) + 1);
        let border = if border_width > 0.0 { (border_width / config.horizontal_scale + 1e-9) as usize + 1 } else { 0 };
        // at least the middle is left
        let border = border.min((size[0].min(size[1]) - 1) / 2);
        Self { heights: vec![0.0; size[0] * size[1]], size, border }
    }

    /// Vertices within the border.
    fn inner(&self) -> [usize; 2] {
        self.size.map(|n| n - 2 * self.border)
    }

    /// Sets a vertex within the border.
    fn set(&mut self, i: usize, j: usize, height: f64) {
        self.heights[(i + self.border) * self.size[1] + j + self.border] = height;
    }

    pub(super) fn rough(mut self, c: &RoughConfig, level: &Level, rng: &mut EnvRng) -> Mesh {
        let [n, m] = self.inner();
        let config = level.config;
        let [low, high] = c.noise_range.map(|x| x * level.scale / config.vertical_scale);
        let step = c.noise_step * level.scale / config.vertical_scale;
        let last = ((high - low) / step + 1e-9) as u32;
        for i in 0..n {
            for j in 0..m {
                self.set(i, j, (low + step * f64::from(rng.integer([0, last]))).round_ties_even());
            }
        }
        self.mesh(config)
    }

    /// Levels the square of this edge length in the middle, m, at the mean of its heights.
    fn level_middle(&mut self, width: f64, config: &TerrainConfig) {
        if width <= 0.0 {
            return;
        }
        let [n, m] = self.size;
        let scale = [config.size[0] / (n - 1) as f64, config.size[1] / (m - 1) as f64];
        let is_inside = |index: usize, axis: usize| {
            let place = index as f64 * scale[axis] - 0.5 * config.size[axis];
            place.abs() <= 0.5 * width + 1e-9
        };
        let inside = || (0..n * m).filter(|k| is_inside(k / m, 0) && is_inside(k % m, 1));
        let sum: f64 = inside().map(|k| self.heights[k]).sum();
        let mean = (sum / inside().count().max(1) as f64).round_ties_even();
        for k in inside() {
            self.heights[k] = mean;
        }
    }

    /// The surface; the foot of a face beyond the slope threshold moves under its upper edge.
    fn mesh(&self, config: &TerrainConfig) -> Mesh {
        let [n, m] = self.size;
        let scale = [config.size[0] / (n - 1) as f64, config.size[1] / (m - 1) as f64];
        let height = |i: usize, j: usize| self.heights[i * m + j] * config.vertical_scale;
        let shift = |here: f64, before: Option<f64>, after: Option<f64>, scale: f64| {
            let steep = |other: Option<f64>| other.is_some_and(|other| other - here > config.slope_threshold * scale);
            f64::from(steep(after)) - f64::from(steep(before))
        };
        let vertex = |i: usize, j: usize| {
            let here = height(i, j);
            let along_x =
                shift(here, i.checked_sub(1).map(|i| height(i, j)), (i + 1 < n).then(|| height(i + 1, j)), scale[0]);
            let along_y =
                shift(here, j.checked_sub(1).map(|j| height(i, j)), (j + 1 < m).then(|| height(i, j + 1)), scale[1]);
            let place = |index: usize, shift: f64, axis: usize| {
                ((index as f64 + shift) * scale[axis] - 0.5 * config.size[axis]) as f32
            };
            [place(i, along_x, 0), place(j, along_y, 1), here as f32]
        };
        Mesh::field((0..n * m).map(|k| vertex(k / m, k % m)).collect(), m)
    }
}

/// Rectangles at random places, each at one height, and a platform at height 0.
pub(super) fn obstacles(c: &ObstaclesConfig, level: &Level, rng: &mut EnvRng) -> Mesh {
    let config = level.config;
    let mut field = Field::new(config, c.border_width);
    let [n, m] = field.inner();
    if n.min(m) < 2 {
        return field.mesh(config);
    }
    let height = (level.rising(c.obstacle_height_range) / config.vertical_scale).round_ties_even();
    for _ in 0..c.num_obstacles {
        let [low, high] = c.obstacle_width_range;
        // cells of an obstacle along x and y; both draws are made for every obstacle
        let cells = [n, m].map(|most| {
            let width = low + (high - low) * f64::from(rng.unit());
            ((width / config.horizontal_scale).round() as usize).clamp(1, most - 1)
        });
        let first = [0, 1].map(|axis| rng.integer([0, ([n, m][axis] - 1 - cells[axis]) as u32]) as usize);
        let choice = rng.integer([0, 3]);
        let height = match (c.obstacle_height_mode, choice) {
            (ObstacleHeight::Fixed, _) | (ObstacleHeight::Choice, 0) => height,
            (ObstacleHeight::Choice, 1) => (0.5 * height).round_ties_even(),
            (ObstacleHeight::Choice, 2) => (-0.5 * height).round_ties_even(),
            (ObstacleHeight::Choice, _) => -height,
        };
        // the upper edge of a vertical face stays: a hole has its foot one vertex further in
        let shrunk = usize::from(height < 0.0);
        for i in first[0] + shrunk..=first[0] + cells[0] - shrunk {
            for j in first[1] + shrunk..=first[1] + cells[1] - shrunk {
                field.set(i, j, height);
            }
        }
    }
    let reach = (0.5 * c.platform_width / config.horizontal_scale + 1e-9) as usize;
    let around = |count: usize| (count / 2).saturating_sub(reach)..=(count / 2 + reach).min(count - 1);
    for i in around(n) {
        for j in around(m) {
            field.set(i, j, 0.0);
        }
    }
    field.mesh(config)
}

/// A cosine along x and a sine along y, each of half the amplitude.
pub(super) fn wave(c: &WaveConfig, level: &Level) -> Mesh {
    let config = level.config;
    let mut field = Field::new(config, c.border_width);
    let [n, m] = field.inner();
    let amplitude = 0.5 * level.rising(c.amplitude_range) / config.vertical_scale;
    let angle = |index: usize, count: usize| {
        std::f64::consts::TAU * f64::from(c.num_waves) * index as f64 / (count - 1).max(1) as f64
    };
    for i in 0..n {
        for j in 0..m {
            let (along_x, along_y) = (Real::sin_cos(angle(i, n)).1, Real::sin_cos(angle(j, m)).0);
            field.set(i, j, (amplitude * (along_x + along_y)).round_ties_even());
        }
    }
    field.level_middle(c.platform_width, config);
    field.mesh(config)
}

/// The table of the level, laid over the tile within its border, with walls down to the border.
pub(super) fn tables(c: &HeightfieldConfig, level: &Level) -> Mesh {
    let last = c.levels.len() - 1;
    let rows = &c.levels[((level.difficulty * c.levels.len() as f64).max(0.0) as usize).min(last)];
    let factor = level.rising(c.height_scale_range);
    let (half, inner) = (level.half(), level.half().map(|x| x - c.border_width));
    let (n, m) = (rows.len(), rows[0].len());
    let place = |index: usize, count: usize, axis: usize| (2.0 * index as f64 / (count - 1) as f64 - 1.0) * inner[axis];
    let is_inside = |i: usize, j: usize| {
        let reach = 0.5 * c.platform_width + 1e-9;
        c.platform_width > 0.0 && place(i, n, 0).abs() <= reach && place(j, m, 1).abs() <= reach
    };
    let inside = || (0..n * m).filter(|k| is_inside(k / m, k % m));
    let mean = inside().map(|k| rows[k / m][k % m]).sum::<f64>() / inside().count().max(1) as f64;
    let height = |i: usize, j: usize| factor * if is_inside(i, j) { mean } else { rows[i][j] };
    let vertex = |i: usize, j: usize| [place(i, n, 0), place(j, m, 1), height(i, j)];
    let vertices = (0..n * m).map(|k| vertex(k / m, k % m).map(|x| x as f32)).collect();
    let mut mesh = Mesh::field(vertices, m);
    if c.border_width > 0.0 {
        mesh.frame(half, inner, 0.0);
    }
    let along_x = (1..n).flat_map(|i| [0, m - 1].map(|j| [vertex(i - 1, j), vertex(i, j)]));
    let along_y = (1..m).flat_map(|j| [0, n - 1].map(|i| [vertex(i, j - 1), vertex(i, j)]));
    for edge in along_x.chain(along_y).filter(|edge| edge.iter().any(|corner| corner[2] != 0.0)) {
        mesh.skirt(edge);
    }
    mesh
}

/// The sum of the heights of several shapes on the vertices of a height field.
pub(super) fn mixture(c: &MixtureConfig, level: &Level, rng: &mut EnvRng) -> Mesh {
    let config = level.config;
    let mut field = Field::new(config, 0.0);
    let [n, m] = field.size;
    for shape in &c.of {
        let mut mesh = level.mesh(shape, rng);
        // to a grid whose cells have an edge length of 1
        for vertex in &mut mesh.vertices {
            for (axis, x) in vertex.iter_mut().take(2).enumerate() {
                let share = f64::from(*x) / config.size[axis] + 0.5;
                *x = (share * (field.size[axis] - 1) as f64) as f32;
            }
        }
        let mut grid = HeightGrid::level([0.0; 2], 1.0, [n, m], f32::MIN);
        mesh.rasterise([0.0; 2], &mut grid);
        grid.replace(f32::MIN, 0.0);
        for k in 0..n * m {
            field.heights[k] += f64::from(grid.height(k / m, k % m)) / config.vertical_scale;
        }
    }
    field.heights.iter_mut().for_each(|height| *height = height.round_ties_even());
    field.level_middle(c.platform_width, config);
    field.mesh(config)
}
