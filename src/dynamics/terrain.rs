//! The height of the ground where it is not a plane.

use super::lanes::Real;
use super::math::Vec3;

/// The steepest slope that a contact feels, rise over run: in a grid a wall is a slope within one cell.
const STEEPEST: f32 = 10.0;
/// Edge length of the squares of which the largest height is known, m.
const BLOCK: f32 = 0.5;

/// Heights over a rectangle, on the points of a grid and on two triangles between four of them, cut from the first to the last
/// corner; beyond the rectangle its edge goes on.
#[derive(Clone, Debug, PartialEq)]
pub struct HeightGrid {
    /// Where the first point is, x and y, m.
    pub origin: [f32; 2],
    /// Distance of two points, m.
    pub cell: f32,
    /// Number of points along x and y, at least two each.
    pub size: [usize; 2],
    /// `heights[i * size[1] + j]`, m: `i` along x, `j` along y.
    pub heights: Vec<f32>,
    /// The largest of them.
    pub highest: f32,
    /// Largest heights of squares of `BLOCK` and the squares around them, like `heights`; empty until they are noted.
    blocks: Vec<f32>,
    /// Number of squares along x and y.
    num_blocks: [usize; 2],
}

/// What the robots of a pack stand on.
#[derive(Clone, Copy, Debug)]
pub struct Terrain<'a, S> {
    /// The heights.
    pub grid: &'a HeightGrid,
    /// Where the origin of each env is in the grid's frame, m.
    pub origin: &'a [S; 2],
}

impl HeightGrid {
    /// A level grid; `heights` may then be changed, and [`note_blocks`](Self::note_blocks) must follow.
    pub fn level(origin: [f32; 2], cell: f32, size: [usize; 2], height: f32) -> Self {
        let heights = vec![height; size[0] * size[1]];
        Self { origin, cell, size, heights, highest: height, blocks: Vec::new(), num_blocks: [0; 2] }
    }

    /// Notes the largest heights, after all heights are known.
    pub fn note_blocks(&mut self) {
        let [rows, columns] = self.size;
        let stride = ((BLOCK / self.cell).round() as usize).max(1);
        let num = [rows.div_ceil(stride), columns.div_ceil(stride)];
        let mut own = vec![f32::MIN; num[0] * num[1]];
        for (i, row) in self.heights.chunks_exact(columns).enumerate() {
            for (j, points) in row.chunks(stride).enumerate() {
                let most = &mut own[i / stride * num[1] + j];
                *most = points.iter().copied().fold(*most, f32::max);
            }
        }
        let around = |at: usize, count: usize| at.saturating_sub(1)..(at + 2).min(count);
        self.blocks = (0..num[0] * num[1])
            .map(|k| {
                let places = around(k / num[1], num[0]).flat_map(|i| around(k % num[1], num[1]).map(move |j| (i, j)));
                places.map(|(i, j)| own[i * num[1] + j]).fold(f32::MIN, f32::max)
            })
            .collect();
        self.num_blocks = num;
        self.highest = own.iter().copied().fold(f32::MIN, f32::max);
    }

    /// No height within `reach` of a place is larger than this, m.
    #[inline(always)]
    fn bound(&self, x: f32, y: f32, reach: f32) -> f32 {
        let stride = (BLOCK / self.cell).round().max(1.0);
        // the squares around hold what is within an edge length, less the cell between the last point and the next square
        if reach > (stride - 1.0) * self.cell {
            return self.highest;
        }
        let block = |x: f32, axis: usize| {
            let points = ((x - self.origin[axis]) / self.cell).clamp(0.0, (self.size[axis] - 1) as f32);
            ((points / stride) as usize).min(self.num_blocks[axis] - 1)
        };
        self.blocks[block(x, 0) * self.num_blocks[1] + block(y, 1)]
    }

    /// Height, m, and slope along x and y at a place. A place that is not finite has the height of a corner.
    #[inline(always)]
    pub fn sample(&self, x: f32, y: f32) -> (f32, [f32; 2]) {
        let (i, u) = Self::split((x - self.origin[0]) / self.cell, self.size[0]);
        let (j, v) = Self::split((y - self.origin[1]) / self.cell, self.size[1]);
        let at = i * self.size[1] + j;
        let (a, b) = (self.heights[at], self.heights[at + 1]);
        let (c, d) = (self.heights[at + self.size[1]], self.heights[at + self.size[1] + 1]);
        let (along_x, along_y) = if u > v { (c - a, d - c) } else { (d - b, b - a) };
        let height = a + along_x * u + along_y * v;
        (height, [along_x, along_y].map(|rise| (rise / self.cell).clamp(-STEEPEST, STEEPEST)))
    }

    /// The cell of a coordinate in cells, and where in it.
    #[inline(always)]
    fn split(x: f32, points: usize) -> (usize, f32) {
        // a NaN becomes 0 in the cast
        let x = x.clamp(0.0, (points - 1) as f32);
        let i = (x as usize).min(points - 2);
        (i, x - i as f32)
    }

    /// The largest height of the points within a square about a place, m.
    pub fn highest_near(&self, x: f32, y: f32, half: f32) -> f32 {
        let range = |centre: f32, axis: usize| {
            let of = |x: f32| Self::split((x - self.origin[axis]) / self.cell, self.size[axis]).0;
            of(centre - half)..=of(centre + half) + 1
        };
        let (rows, columns) = (range(x, 0), range(y, 1));
        rows.flat_map(|i| columns.clone().map(move |j| self.heights[i * self.size[1] + j])).fold(f32::MIN, f32::max)
    }
}

impl<S: Real> Terrain<'_, S> {
    /// Height and unit normal below places of the envs, lane by lane.
    #[inline(always)]
    pub(super) fn below(&self, x: S, y: S) -> (S, Vec3<S>) {
        let (x, y) = (x + self.origin[0], y + self.origin[1]);
        let mut height = S::zero();
        let mut slope = [S::zero(); 2];
        for lane in 0..S::LANES {
            let (h, [along_x, along_y]) = self.grid.sample(x.lane(lane) as f32, y.lane(lane) as f32);
            height.set_lane(lane, f64::from(h));
            slope[0].set_lane(lane, f64::from(along_x));
            slope[1].set_lane(lane, f64::from(along_y));
        }
        let one = S::one();
        let up = one / slope[0].mul_add(slope[0], slope[1].mul_add(slope[1], one)).sqrt();
        (height, [-(slope[0] * up), -(slope[1] * up), up])
    }

    /// No height within `reach` of places of the envs is larger than this, m, lane by lane.
    #[inline(always)]
    pub(super) fn bound(&self, x: S, y: S, reach: S) -> S {
        let (x, y) = (x + self.origin[0], y + self.origin[1]);
        let mut bound = S::zero();
        for lane in 0..S::LANES {
            let most = self.grid.bound(x.lane(lane) as f32, y.lane(lane) as f32, reach.lane(lane) as f32);
            bound.set_lane(lane, f64::from(most));
        }
        bound
    }
}
