//! The surface of each type of tile, about its middle.

use super::field::Field;
use super::mesh::Mesh;
use super::{field, rings, scattered};
use crate::components::EnvRng;
use crate::config::{BoxesConfig, StairsConfig, SubTerrainShape, TerrainConfig};

/// Difficulty of a tile.
pub(super) struct Level<'a> {
    /// Config of the terrain that the tile belongs to.
    pub(super) config: &'a TerrainConfig,
    /// Difficulty, as a share of the ranges.
    pub(super) difficulty: f64,
    /// Factor of what changes with the difficulty.
    pub(super) scale: f64,
}

impl Level<'_> {
    /// Half the edge lengths of a tile, m.
    pub(super) fn half(&self) -> [f64; 2] {
        self.config.size.map(|x| 0.5 * x)
    }

    /// Number of a range without a unit of length.
    pub(super) fn ratio(&self, [low, high]: [f64; 2]) -> f64 {
        low + (high - low) * self.difficulty
    }

    /// Length of a range that is harder the longer it is, m.
    pub(super) fn rising(&self, range: [f64; 2]) -> f64 {
        self.ratio(range) * self.scale
    }

    /// Length of a range that is harder the shorter it is, m.
    pub(super) fn falling(&self, [low, high]: [f64; 2]) -> f64 {
        (high - (high - low) * self.difficulty) * self.scale
    }

    /// The nearest place where edges may be, m.
    pub(super) fn snap(&self, x: f64) -> f64 {
        (x / self.config.edge_step).round() * self.config.edge_step
    }

    /// The nearest width that edges may have and that is not zero, m.
    pub(super) fn snap_width(&self, x: f64) -> f64 {
        self.snap(x).max(self.config.edge_step)
    }

    /// A tile of this shape.
    pub(super) fn mesh(&self, shape: &SubTerrainShape, rng: &mut EnvRng) -> Mesh {
        match shape {
            SubTerrainShape::Flat {} => Mesh::terraces(&[(self.half(), 0.0)]),
            SubTerrainShape::PyramidStairs(c) if c.landing_every > 0 || c.riser_gap > 0.0 => {
                rings::flights(c, self, self.rising(c.step_height_range))
            }
            SubTerrainShape::PyramidStairsInv(c) if c.landing_every > 0 || c.riser_gap > 0.0 => {
                rings::flights(c, self, -self.rising(c.step_height_range))
            }
            SubTerrainShape::PyramidStairs(c) => stairs(c, self.half(), self.rising(c.step_height_range)),
            SubTerrainShape::PyramidStairsInv(c) => stairs(c, self.half(), -self.rising(c.step_height_range)),
            SubTerrainShape::PyramidRamps(c) => rings::ramps(c, self, 1.0),
            SubTerrainShape::PyramidRampsInv(c) => rings::ramps(c, self, -1.0),
            SubTerrainShape::Boxes(c) => boxes(c, self.half(), self.rising(c.grid_height_range), rng),
            SubTerrainShape::Box(c) => {
                rings::platform(self, c.platform_width, self.rising(c.box_height_range), c.double_box)
            }
            SubTerrainShape::Pit(c) => {
                rings::platform(self, c.platform_width, -self.rising(c.pit_depth_range), c.double_pit)
            }
            SubTerrainShape::Gap(c) => rings::gap(c, self),
            SubTerrainShape::Rails(c) => rings::rails(c, self),
            SubTerrainShape::FloatingRing(c) => rings::ring(c, self),
            SubTerrainShape::Star(c) => scattered::star(c, self),
            SubTerrainShape::Beams(c) => scattered::beams(c, self),
            SubTerrainShape::RepeatedBoxes(c) => scattered::boxes(c, self, rng),
            SubTerrainShape::RepeatedPyramids(c) => scattered::round(c, self, 4, rng),
            SubTerrainShape::RepeatedCylinders(c) => scattered::round(c, self, scattered::SIDES, rng),
            SubTerrainShape::HfSteppingStones(c) => scattered::stones(c, self, rng),
            SubTerrainShape::RandomRough(c) => Field::new(self.config, c.border_width).rough(c, self, rng),
            SubTerrainShape::HfPyramidSlope(c) => field::slope(c, self.config, self.ratio(c.slope_range)),
            SubTerrainShape::HfPyramidSlopeInv(c) => field::slope(c, self.config, -self.ratio(c.slope_range)),
            SubTerrainShape::HfDiscreteObstacles(c) => field::obstacles(c, self, rng),
            SubTerrainShape::HfWave(c) => field::wave(c, self),
            SubTerrainShape::Heightfield(c) => field::tables(c, self),
            SubTerrainShape::Mixture(c) => field::mixture(c, self, rng),
        }
    }
}

pub(super) fn both(half: f64) -> [f64; 2] {
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
