//! The height of the ground where it is not a plane.

use super::lanes::Real;
use super::math::Vec3;

/// The steepest slope that a contact feels, rise over run: in a grid a wall is a slope within one cell.
const STEEPEST: f32 = 10.0;

/// Heights over a rectangle of an env, linear between the points of a grid; beyond the rectangle its edge goes on.
#[derive(Clone, Debug, PartialEq)]
pub struct HeightGrid {
    /// Where the first point is, x and y in the env's frame, m.
    pub origin: [f32; 2],
    /// Distance of two points, m.
    pub cell: f32,
    /// Number of points along x and y, at least two each.
    pub size: [usize; 2],
    /// `heights[i * size[1] + j]`, m: `i` along x, `j` along y.
    pub heights: Vec<f32>,
    /// The largest of them.
    pub highest: f32,
}

impl HeightGrid {
    /// Height, m, and slope along x and y at a place. A place that is not finite has the height of a corner.
    pub fn sample(&self, x: f32, y: f32) -> (f32, [f32; 2]) {
        let (i, u) = Self::split((x - self.origin[0]) / self.cell, self.size[0]);
        let (j, v) = Self::split((y - self.origin[1]) / self.cell, self.size[1]);
        let at = i * self.size[1] + j;
        let (a, b) = (self.heights[at], self.heights[at + 1]);
        let (c, d) = (self.heights[at + self.size[1]], self.heights[at + self.size[1] + 1]);
        let (along_x, along_y) = ((c - a) + ((d - c) - (b - a)) * v, (b - a) + ((d - c) - (b - a)) * u);
        let height = a + (c - a) * u + ((b - a) + ((d - c) - (b - a)) * u) * v;
        (height, [along_x, along_y].map(|rise| (rise / self.cell).clamp(-STEEPEST, STEEPEST)))
    }

    /// The cell of a coordinate in cells, and where in it.
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

    /// Height and unit normal below places, lane by lane.
    #[inline(always)]
    pub(super) fn below<S: Real>(&self, x: S, y: S) -> (S, Vec3<S>) {
        let mut height = S::zero();
        let mut slope = [S::zero(); 2];
        for lane in 0..S::LANES {
            let (h, [along_x, along_y]) = self.sample(x.lane(lane) as f32, y.lane(lane) as f32);
            height.set_lane(lane, f64::from(h));
            slope[0].set_lane(lane, f64::from(along_x));
            slope[1].set_lane(lane, f64::from(along_y));
        }
        let one = S::one();
        let up = one / slope[0].mul_add(slope[0], slope[1].mul_add(slope[1], one)).sqrt();
        (height, [-(slope[0] * up), -(slope[1] * up), up])
    }
}
