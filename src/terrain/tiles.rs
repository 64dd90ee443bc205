//! The surface of each type of tile, about its middle.

use super::mesh::Mesh;
use crate::components::EnvRng;
use crate::config::{BoxesConfig, RoughConfig, SlopeConfig, StairsConfig, SubTerrainShape, TerrainConfig};

/// A tile of this shape and difficulty.
pub(super) fn mesh(shape: &SubTerrainShape, config: &TerrainConfig, difficulty: f64, rng: &mut EnvRng) -> Mesh {
    let half = config.size.map(|x| 0.5 * x);
    match shape {
        SubTerrainShape::Flat {} => {
            let mut mesh = Mesh::default();
            mesh.top([-half[0], half[0]], [-half[1], half[1]], 0.0);
            mesh
        }
        SubTerrainShape::PyramidStairs(c) => stairs(c, half, at(c.step_height_range, difficulty)),
        SubTerrainShape::PyramidStairsInv(c) => stairs(c, half, -at(c.step_height_range, difficulty)),
        SubTerrainShape::Boxes(c) => boxes(c, half, at(c.grid_height_range, difficulty), rng),
        SubTerrainShape::RandomRough(c) => Field::new(config, c.border_width).rough(c, config, rng),
        SubTerrainShape::HfPyramidSlope(c) => slope(c, config, at(c.slope_range, difficulty)),
        SubTerrainShape::HfPyramidSlopeInv(c) => slope(c, config, -at(c.slope_range, difficulty)),
    }
}

fn at([low, high]: [f64; 2], difficulty: f64) -> f64 {
    low + (high - low) * difficulty
}

fn both(half: f64) -> [f64; 2] {
    [-half, half]
}

/// Rings of one step each and a platform one step beyond the last ring; `step` is negative where
/// they go down.
fn stairs(c: &StairsConfig, half: [f64; 2], step: f64) -> Mesh {
    let ring = |k: u32| half.map(|x| x - c.border_width - f64::from(k) * c.step_width);
    let inner = 2.0 * (half[0].min(half[1]) - c.border_width);
    let mut rings = ((inner - c.platform_width) / (2.0 * c.step_width) + 1e-9) as u32 + 1;
    // a platform narrower than two steps would vanish
    while rings > 0 && ring(rings).iter().any(|x| *x <= 1e-6) {
        rings -= 1;
    }
    let mut mesh = Mesh::default();
    if c.border_width > 0.0 {
        mesh.frame(half, ring(0), 0.0);
    }
    for k in 0..=rings {
        let height = f64::from(k + 1) * step;
        let [x, y] = ring(k);
        mesh.walls(both(x), both(y), [height.min(height - step), height.max(height - step)]);
        if k < rings {
            mesh.frame([x, y], ring(k + 1), height);
        } else {
            mesh.top(both(x), both(y), height);
        }
    }
    mesh
}

/// Blocks of heights up to `amplitude` above and below 0.
fn boxes(c: &BoxesConfig, half: [f64; 2], amplitude: f64, rng: &mut EnvRng) -> Mesh {
    let counts = half.map(|x| (2.0 * x / c.grid_width + 1e-9) as u32);
    let inner = counts.map(|n| 0.5 * f64::from(n) * c.grid_width);
    let mut mesh = Mesh::default();
    mesh.frame(half, inner, 0.0);
    mesh.walls(both(inner[0]), both(inner[1]), [-amplitude, 0.0]);
    let edge = |index: u32, axis: usize| {
        let low = f64::from(index) * c.grid_width - inner[axis];
        [low, low + c.grid_width]
    };
    for i in 0..counts[0] {
        for j in 0..counts[1] {
            let height = (2.0 * f64::from(rng.unit()) - 1.0) * amplitude;
            mesh.top(edge(i, 0), edge(j, 1), height);
            mesh.walls(edge(i, 0), edge(j, 1), [-amplitude, height]);
        }
    }
    let platform = both(0.5 * c.platform_width);
    mesh.top(platform, platform, amplitude);
    mesh.walls(platform, platform, [-amplitude, amplitude]);
    mesh
}

/// A pyramid whose height is the product of one along x and one along y, cut off where the
/// platform's corners are.
fn slope(c: &SlopeConfig, config: &TerrainConfig, slope: f64) -> Mesh {
    let mut field = Field::new(config, c.border_width);
    let [n, m] = field.inner();
    // as in the reference: the longest way up is half of the inner part along x
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
struct Field {
    heights: Vec<f64>,
    size: [usize; 2],
    border: usize,
}

impl Field {
    fn new(config: &TerrainConfig, border_width: f64) -> Self {
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

    fn rough(mut self, c: &RoughConfig, config: &TerrainConfig, rng: &mut EnvRng) -> Mesh {
        let [n, m] = self.inner();
        let [low, high] = c.noise_range.map(|x| x / config.vertical_scale);
        let step = c.noise_step / config.vertical_scale;
        let last = ((high - low) / step + 1e-9) as u32;
        for i in 0..n {
            for j in 0..m {
                self.set(i, j, (low + step * f64::from(rng.integer([0, last]))).round_ties_even());
            }
        }
        self.mesh(config)
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
