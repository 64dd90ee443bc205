//! The height of the ground where it is not a plane.

use super::lanes::{MOST_LANES, Real, Table};
use super::math::Vec3;
use super::settings::{HEIGHT_SQUARES, MAX_SLOPE, MIN_DROP};

/// Cells along each side of the squares in which heights are kept together, about as many as a page
/// of memory holds.
pub(super) const PAGE: usize = 32;
/// Points along each side of a page: those at its far edges are its neighbours' first ones too, so
/// that all corners of a cell are in one page.
pub(super) const EDGE: usize = PAGE + 1;
/// Points of a page.
pub(super) const PAGE_POINTS: usize = EDGE * EDGE;
/// Places that are looked up side by side: the lanes of a pack.
const GROUP: usize = MOST_LANES;
/// Most places that a height scanner looks up side by side.
pub const LARGE_GROUP: usize = 64;

/// Heights over a rectangle, on the points of a grid and on two triangles between four of them, cut
/// from the first to the last corner; beyond the rectangle its edge goes on.
#[derive(Clone, Debug, PartialEq)]
pub struct HeightGrid {
    /// Place of the first point, x and y, m.
    pub origin: [f32; 2],
    /// Distance of two points, m.
    pub cell: f32,
    /// Number of points along x and y, at least two each.
    pub size: [usize; 2],
    /// Heights, m, page by page: what is near in the world is near in memory, whatever the
    /// direction.
    pub(super) points: Vec<f32>,
    /// Number of pages along y.
    pub(super) columns: usize,
    /// The largest height.
    pub highest: f32,
    /// See [`HEIGHT_SQUARES`].
    squares: [Squares; 2],
}

/// Distance up to which the ground is of interest.
#[derive(Clone, Copy)]
pub(super) enum Near {
    /// Ground below a link.
    Link,
    /// Ground below a contact candidate.
    Candidate,
}

/// Largest heights of squares and the squares around them; empty until they are noted.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Squares {
    /// Points along an edge.
    pub stride: usize,
    /// Number of squares along x and y.
    pub num: [usize; 2],
    /// Row by row, m.
    pub highest: Vec<f32>,
}

/// Ground below the robots of a pack.
#[derive(Clone, Copy, Debug)]
pub struct Terrain<'a, S> {
    /// The heights.
    pub grid: &'a HeightGrid,
    /// Origin of each env in the grid's frame, m.
    pub origin: &'a [S; 2],
}

impl HeightGrid {
    /// A level grid; heights may then be changed, and [`note_squares`](Self::note_squares) must
    /// follow.
    pub fn level(origin: [f32; 2], cell: f32, size: [usize; 2], height: f32) -> Self {
        let [rows, columns] = size.map(|points| (points - 1).div_ceil(PAGE));
        let points = vec![height; rows * columns * PAGE_POINTS];
        Self { origin, cell, size, points, columns, highest: height, squares: Default::default() }
    }

    /// Index of a point of a page.
    fn place(&self, page: [usize; 2], within: [usize; 2]) -> usize {
        (page[0] * self.columns + page[1]) * PAGE_POINTS + within[0] * EDGE + within[1]
    }

    /// Height of a point, m: `i` along x, `j` along y.
    pub fn height(&self, i: usize, j: usize) -> f32 {
        let page = [0, 1].map(|axis| ([i, j][axis] / PAGE).min((self.size[axis] - 2) / PAGE));
        self.points[self.place(page, [i - page[0] * PAGE, j - page[1] * PAGE])]
    }

    /// Heights from a point along y to the end of its page, m.
    fn run(&self, i: usize, j: usize) -> &[f32] {
        let page = [0, 1].map(|axis| ([i, j][axis] / PAGE).min((self.size[axis] - 2) / PAGE));
        let first = j - page[1] * PAGE;
        let len = (self.size[1] - j).min(EDGE - first);
        &self.points[self.place(page, [i - page[0] * PAGE, first])..][..len]
    }

    /// Changes the height of a point, m.
    pub fn set_height(&mut self, i: usize, j: usize, height: f32) {
        // a point at the edge of a page belongs to the page before as well
        let pages = |k: usize, axis: usize| {
            let last = (self.size[axis] - 2) / PAGE;
            (k.saturating_sub(1) / PAGE).min(last)..=(k / PAGE).min(last)
        };
        for row in pages(i, 0) {
            for column in pages(j, 1) {
                let at = self.place([row, column], [i - row * PAGE, j - column * PAGE]);
                self.points[at] = height;
            }
        }
    }

    /// Gives all points of one height another, m.
    pub fn replace(&mut self, old: f32, new: f32) {
        self.points.iter_mut().filter(|height| **height == old).for_each(|height| *height = new);
    }

    /// All heights row by row, `[size[0] * size[1]]`, m.
    pub fn heights(&self) -> Vec<f32> {
        let [rows, columns] = self.size;
        (0..rows).flat_map(|i| (0..columns).map(move |j| self.height(i, j))).collect()
    }

    /// Notes the largest heights, after all heights are known.
    pub fn note_squares(&mut self) {
        self.squares = HEIGHT_SQUARES.map(|edge| self.squares_of(((edge / self.cell).round() as usize).max(1)));
        self.highest = self.squares[0].highest.iter().copied().fold(f32::MIN, f32::max);
    }

    /// Squares for links, and smaller ones for contact candidates.
    pub fn squares(&self) -> &[Squares; 2] {
        &self.squares
    }

    fn squares_of(&self, stride: usize) -> Squares {
        let [rows, columns] = self.size;
        let num = [rows.div_ceil(stride), columns.div_ceil(stride)];
        let mut own = vec![f32::MIN; num[0] * num[1]];
        // the largest heights of a row of squares, by column
        let mut most = vec![f32::MIN; columns];
        for (row, squares) in own.chunks_mut(num[1]).enumerate() {
            most.fill(f32::MIN);
            for i in row * stride..rows.min((row + 1) * stride) {
                let mut j = 0;
                while j < columns {
                    let run = self.run(i, j);
                    for (most, &height) in most[j..].iter_mut().zip(run) {
                        *most = if height > *most { height } else { *most };
                    }
                    j += run.len();
                }
            }
            for (square, heights) in squares.iter_mut().zip(most.chunks(stride)) {
                *square = heights.iter().copied().fold(f32::MIN, f32::max);
            }
        }
        let around = |at: usize, count: usize| at.saturating_sub(1)..(at + 2).min(count);
        let highest = (0..num[0] * num[1])
            .map(|k| {
                let places = around(k / num[1], num[0]).flat_map(|i| around(k % num[1], num[1]).map(move |j| (i, j)));
                places.map(|(i, j)| own[i * num[1] + j]).fold(f32::MIN, f32::max)
            })
            .collect();
        Squares { stride, num, highest }
    }

    /// Height, m, that no height within `reach` exceeds, for the first `n` places of a group.
    #[inline(always)]
    fn bound_group(
        &self,
        near: Near,
        x: &[f32; GROUP],
        y: &[f32; GROUP],
        reach: &[f32; GROUP],
        n: usize,
    ) -> [f32; GROUP] {
        let squares = &self.squares[near as usize];
        // the squares around hold what is within an edge length, less the cell between the last
        // point and the next square
        let far = (squares.stride as f32 - 1.0) * self.cell;
        let mut at = [0u32; GROUP];
        for k in 0..GROUP {
            at[k] = self.square(squares, x[k], 0) * squares.num[1] as u32 + self.square(squares, y[k], 1);
        }
        let mut bound = [self.highest; GROUP];
        for k in 0..n {
            bound[k] = if reach[k] > far { self.highest } else { squares.highest[at[k] as usize] };
        }
        bound
    }

    /// The square of a coordinate.
    #[inline(always)]
    fn square(&self, squares: &Squares, x: f32, axis: usize) -> u32 {
        let points = not_below_zero((x - self.origin[axis]) / self.cell);
        let last = (self.size[axis] - 1) as f32;
        let square = floor((if points < last { points } else { last }) / squares.stride as f32);
        let last = (squares.num[axis] - 1) as f32;
        whole(if square < last { square } else { last })
    }

    /// Height, m, and slope along x and y at a place. A place that is not finite has the height of
    /// a corner.
    pub fn sample(&self, x: f32, y: f32) -> (f32, [f32; 2]) {
        let mut found = Samples::zeros();
        self.sample_group(&[x; GROUP], &[y; GROUP], 1, &mut found);
        (found.height[0], [found.along_x[0], found.along_y[0]].map(|rise| self.slope(rise)))
    }

    /// The slopes of rises from one point to the next.
    #[inline(always)]
    fn slopes(&self, rises: &[f32; GROUP]) -> [f32; GROUP] {
        let mut slopes = [0.0; GROUP];
        for k in 0..GROUP {
            slopes[k] = self.slope(rises[k]);
        }
        slopes
    }

    /// The slope of a rise from one point to the next.
    #[inline(always)]
    fn slope(&self, rise: f32) -> f32 {
        (rise / self.cell).clamp(-MAX_SLOPE, MAX_SLOPE)
    }

    /// Heights, m, and rises from one point to the next, below the first `n` places of a group.
    /// Without branches in its arithmetic, so that it runs in lanes and the loads of all places are
    /// under way together.
    #[inline(always)]
    fn sample_group(&self, x: &[f32; GROUP], y: &[f32; GROUP], n: usize, found: &mut Samples) {
        let (mut at, mut u, mut v) = ([0u32; GROUP], [0.0f32; GROUP], [0.0f32; GROUP]);
        for k in 0..GROUP {
            (at[k], u[k], v[k]) = self.cell_below(x[k], y[k]);
        }
        // two corners at a time
        let (mut near, mut far) = ([[0.0f32; 2]; GROUP], [[0.0f32; 2]; GROUP]);
        for k in 0..n {
            (near[k], far[k]) = self.corners(at[k]);
        }
        for k in 0..GROUP {
            let ([a, b], [c, d]) = (near[k], far[k]);
            let first = u[k] > v[k];
            let along_x = if first { c - a } else { d - b };
            let along_y = if first { d - c } else { b - a };
            found.height[k] = a + along_x * u[k] + along_y * v[k];
            (found.along_x[k], found.along_y[k]) = (along_x, along_y);
            (found.place[0][k], found.place[1][k]) = (u[k], v[k]);
            (found.near[0][k], found.near[1][k], found.far[0][k], found.far[1][k]) = (a, b, c, d);
        }
    }

    /// Index of the first corner of the cell below a place, and the place within the cell, 0 to 1
    /// along x and y.
    #[inline(always)]
    fn cell_below(&self, x: f32, y: f32) -> (u32, f32, f32) {
        let (i, u) = Self::split((x - self.origin[0]) / self.cell, self.size[0]);
        let (j, v) = Self::split((y - self.origin[1]) / self.cell, self.size[1]);
        let page = (i / PAGE as u32) * self.columns as u32 + j / PAGE as u32;
        (page * PAGE_POINTS as u32 + (i % PAGE as u32) * EDGE as u32 + j % PAGE as u32, u, v)
    }

    /// Heights of the corners of a cell at its smaller and its larger x, by y, m.
    #[inline(always)]
    fn corners(&self, at: u32) -> ([f32; 2], [f32; 2]) {
        // the four corners of a cell lie in one page
        let page = &self.points[at as usize..][..EDGE + 2];
        ([page[0], page[1]], [page[EDGE], page[EDGE + 1]])
    }

    /// Heights below places, m, as many as there is room for.
    #[inline(always)]
    pub fn heights_at(&self, mut places: impl Iterator<Item = [f32; 2]>, heights: &mut [f32]) {
        if heights.len() <= GROUP {
            return self.heights_of_group::<GROUP>(&mut places, heights);
        }
        for heights in heights.chunks_mut(LARGE_GROUP) {
            self.heights_of_group::<LARGE_GROUP>(&mut places, heights);
        }
    }

    #[inline(always)]
    fn heights_of_group<const N: usize>(&self, places: &mut impl Iterator<Item = [f32; 2]>, heights: &mut [f32]) {
        let (mut x, mut y) = ([0.0; N], [0.0; N]);
        for (place, (x, y)) in places.zip(x.iter_mut().zip(&mut y)).take(heights.len()) {
            [*x, *y] = place;
        }
        self.heights_below(&x, &y, heights);
    }

    /// Heights below the first of a group of places, m, as many as there is room for. The loops of
    /// [`sample_group`](Self::sample_group), with nothing kept but heights.
    #[inline(always)]
    pub fn heights_below<const N: usize>(&self, x: &[f32; N], y: &[f32; N], heights: &mut [f32]) {
        let (mut at, mut u, mut v) = ([0u32; N], [0.0f32; N], [0.0f32; N]);
        for k in 0..N {
            (at[k], u[k], v[k]) = self.cell_below(x[k], y[k]);
        }
        let (mut near, mut far) = ([[0.0f32; 2]; N], [[0.0f32; 2]; N]);
        for k in 0..heights.len() {
            (near[k], far[k]) = self.corners(at[k]);
        }
        let mut found = [0.0f32; N];
        for k in 0..N {
            let ([a, b], [c, d]) = (near[k], far[k]);
            let first = u[k] > v[k];
            let along_x = if first { c - a } else { d - b };
            let along_y = if first { d - c } else { b - a };
            found[k] = a + along_x * u[k] + along_y * v[k];
        }
        heights.copy_from_slice(&found[..heights.len()]);
    }

    /// The cell of a coordinate in cells, and where in it; the first cell for a NaN.
    #[inline(always)]
    fn split(x: f32, points: usize) -> (u32, f32) {
        let x = not_below_zero(x);
        let x = if x < (points - 1) as f32 { x } else { (points - 1) as f32 };
        let i = floor(x);
        let i = if i < (points - 2) as f32 { i } else { (points - 2) as f32 };
        (whole(i), x - i)
    }

    /// The largest height of the points within a square about a place, m.
    pub fn highest_near(&self, x: f32, y: f32, half: f32) -> f32 {
        let range = |centre: f32, axis: usize| {
            let of = |x: f32| Self::split((x - self.origin[axis]) / self.cell, self.size[axis]).0;
            of(centre - half) as usize..=of(centre + half) as usize + 1
        };
        let (rows, columns) = (range(x, 0), range(y, 1));
        rows.flat_map(|i| columns.clone().map(move |j| self.height(i, j))).fold(f32::MIN, f32::max)
    }
}

/// Samples below a group of places: heights, and rises from one point to the next along x and y, m.
struct Samples {
    height: [f32; GROUP],
    along_x: [f32; GROUP],
    along_y: [f32; GROUP],
    /// Place within its cell, 0 to 1 along x and y.
    place: [[f32; GROUP]; 2],
    /// Heights of the cell's corners at its smaller x, by y.
    near: [[f32; GROUP]; 2],
    /// Heights of the cell's corners at its larger x, by y.
    far: [[f32; GROUP]; 2],
}

impl Samples {
    #[inline(always)]
    fn zeros() -> Self {
        let zeros = [0.0; GROUP];
        Self { height: zeros, along_x: zeros, along_y: zeros, place: [zeros; 2], near: [zeros; 2], far: [zeros; 2] }
    }
}

/// Least number from which on single precision has no digits after the point.
const WHOLE: f32 = 8_388_608.0;

/// Returns the number, or 0 where it is negative or a NaN.
#[inline(always)]
fn not_below_zero(x: f32) -> f32 {
    if x > 0.0 { x } else { 0.0 }
}

/// The largest whole number up to a number of 0 to 4 million, by operations that every instruction
/// set has in lanes.
#[inline(always)]
fn floor(x: f32) -> f32 {
    let nearest = (x + WHOLE) - WHOLE;
    if nearest > x { nearest - 1.0 } else { nearest }
}

/// A whole number of 0 to 4 million as an integer.
#[inline(always)]
fn whole(x: f32) -> u32 {
    (x + WHOLE).to_bits() - WHOLE.to_bits()
}

/// The ground below places: samples of a grid by x and y.
struct Below<'a>(&'a HeightGrid);

impl Table<2> for Below<'_> {
    type Found = Samples;

    #[inline(always)]
    fn look_up(&self, [x, y]: &[[f32; GROUP]; 2], lanes: usize) -> Self::Found {
        let mut found = Samples::zeros();
        self.0.sample_group(x, y, lanes, &mut found);
        found
    }
}

/// The highest ground near places: heights that none within a reach exceeds, by x, y and reach.
struct Bounds<'a>(&'a HeightGrid, Near);

impl Table<3> for Bounds<'_> {
    type Found = [f32; GROUP];

    #[inline(always)]
    fn look_up(&self, [x, y, reach]: &[[f32; GROUP]; 3], lanes: usize) -> Self::Found {
        self.0.bound_group(self.1, x, y, reach, lanes)
    }
}

impl<S: Real> Terrain<'_, S> {
    /// Samples below places of the envs.
    #[inline(always)]
    fn sample(&self, x: S, y: S) -> Samples {
        S::gather(&Below(self.grid), [x + self.origin[0], y + self.origin[1]])
    }

    /// Gap of spheres (points, where the radius is zero) above the ground, m, and the unit normal
    /// of the contact, lane by lane: `place` are the centres about the envs' origins.
    ///
    /// The plane of the ground below the centre counts. Where the ground falls away from that plane
    /// before it comes nearest, on the edge of a step, a sphere touches the edge, and the normal
    /// turns as the foot leaves it.
    #[inline(always)]
    pub(super) fn gap(&self, place: &Vec3<S>, radius: S) -> (S, Vec3<S>) {
        let found = self.sample(place[0], place[1]);
        let slope = [S::load(&self.grid.slopes(&found.along_x)), S::load(&self.grid.slopes(&found.along_y))];
        let (zero, one) = (S::zero(), S::one());
        let up = one / slope[0].mul_add(slope[0], slope[1].mul_add(slope[1], one)).sqrt();
        let normal = [-(slope[0] * up), -(slope[1] * up), up];
        let above = place[2] - S::load(&found.height);
        let distance = above * up;
        // where the plane comes nearest, in cells
        let inverse = S::splat(1.0 / f64::from(self.grid.cell));
        let (u, v) = (S::load(&found.place[0]), S::load(&found.place[1]));
        let along = distance * inverse;
        let at = [normal[0].neg_mul_add(along, u), normal[1].neg_mul_add(along, v)];
        let within = [at[0].clamp(zero, one), at[1].clamp(zero, one)];
        let off = (within[0] - at[0]).abs().max((within[1] - at[1]).abs());
        let beyond = S::and(zero.lt(off), S::and(zero.lt(distance), zero.lt(radius)));
        let Some(beyond) = S::when(beyond) else {
            return (distance - radius, normal);
        };
        let foot = [
            normal[0].neg_mul_add(distance, place[0]),
            normal[1].neg_mul_add(distance, place[1]),
            normal[2].neg_mul_add(distance, place[2]),
        ];
        let ground = S::load(&self.sample(foot[0], foot[1]).height);
        let Some(edge) = S::when(S::and(beyond, (ground + S::splat(MIN_DROP)).lt(foot[2]))) else {
            return (distance - radius, normal);
        };
        // the point of the cell that is nearest to there, on one of its sides
        let first = within[1].lt(within[0]);
        let (a, b) = (S::load(&found.near[0]), S::load(&found.near[1]));
        let (c, d) = (S::load(&found.far[0]), S::load(&found.far[1]));
        let (along_x, along_y) = (S::select(first, c - a, d - b), S::select(first, d - c, b - a));
        let height = along_x.mul_add(within[0], along_y.mul_add(within[1], a));
        let cell = S::splat(f64::from(self.grid.cell));
        let from = [(u - within[0]) * cell, (v - within[1]) * cell, place[2] - height];
        let squared = from[0].mul_add(from[0], from[1].mul_add(from[1], from[2] * from[2]));
        let length = squared.max(S::splat(1e-12)).sqrt();
        let inverse = one / length;
        // an edge next to the centre belongs to a wall, whose plane is no steeper either
        let rounds = S::and(edge, (length * S::splat(1.0 / f64::from(MAX_SLOPE))).lt(from[2]));
        let turned = [
            S::select(rounds, from[0] * inverse, normal[0]),
            S::select(rounds, from[1] * inverse, normal[1]),
            S::select(rounds, from[2] * inverse, normal[2]),
        ];
        (S::select(rounds, length, distance) - radius, turned)
    }

    /// No height within `reach` of places of the envs is larger than this, m, lane by lane.
    #[inline(always)]
    pub(super) fn bound(&self, near: Near, x: S, y: S, reach: S) -> S {
        S::load(&S::gather(&Bounds(self.grid, near), [x + self.origin[0], y + self.origin[1], reach]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CELL: f32 = 0.025;

    /// Gap and normal of a sphere of 2 cm over a surface that depends on x alone.
    fn over(profile: impl Fn(f32) -> f32, centre: [f64; 2]) -> (f64, Vec3<f64>) {
        let mut grid = HeightGrid::level([0.0, 0.0], CELL, [41, 9], 0.0);
        for i in 0..41 {
            (0..9).for_each(|j| grid.set_height(i, j, profile(i as f32 * CELL)));
        }
        let terrain = Terrain { grid: &grid, origin: &[0.0; 2] };
        terrain.gap(&[centre[0], 0.113, centre[1]], 0.02)
    }

    fn step(x: f32) -> f32 {
        if x < 0.51 { 0.15 } else { 0.0 }
    }

    #[test]
    fn a_foot_rolls_over_the_edge_of_a_step() {
        for place in 0..25 {
            for height in 0..20 {
                let (x, z) = (0.49 + 0.001 * f64::from(place), 0.1605 + 0.001 * f64::from(height));
                let (gap, normal) = over(step, [x, z]);
                // the tread before the edge at 0.5 m, and the edge beyond
                let from = [(x - 0.5).max(0.0), z - 0.15];
                let exact = from[0].hypot(from[1]);
                let what = format!("{x} m, {z} m: {gap} and {normal:?}");
                if from[1] < 0.11 * exact {
                    continue;
                }
                assert!((gap - (exact - 0.02)).abs() < 2e-6, "{what}, not {}", exact - 0.02);
                assert!((normal[0] - from[0] / exact).abs() < 1e-4 && normal[1].abs() < 1e-6, "{what}");
                assert!((normal[2] - from[1] / exact).abs() < 1e-4, "{what}");
            }
        }
    }

    /// An uneven grid of three by two pages, the last ones of each row in part.
    fn uneven() -> HeightGrid {
        let mut grid = HeightGrid::level([-1.0, 0.5], CELL, [70, 41], 0.0);
        for i in 0..70 {
            (0..41).for_each(|j| grid.set_height(i, j, ((i * 31 + j * 17) % 97) as f32 * 0.01 - 0.4));
        }
        grid
    }

    #[test]
    fn heights_of_many_places_are_those_of_each() {
        let grid = uneven();
        let x: [f32; 59] = std::array::from_fn(|k| -1.2 + 0.037 * k as f32);
        let y: [f32; 59] = std::array::from_fn(|k| 1.7 - 0.023 * k as f32);
        for count in [1, 15, 16, 17, 32, 58, 59] {
            let (mut below, mut at) = ([0.0; 59], [0.0; 59]);
            grid.heights_below(&x, &y, &mut below[..count]);
            grid.heights_at(x.iter().zip(&y).map(|(x, y)| [*x, *y]), &mut at[..count]);
            for k in 0..count {
                let (height, _) = grid.sample(x[k], y[k]);
                assert!(height.to_bits() == below[k].to_bits() && below[k] == at[k], "{k} of {count}");
            }
            assert!(below[count..].iter().chain(&at[count..]).all(|height| *height == 0.0));
        }
    }

    #[test]
    fn squares_know_the_highest_point_in_them_and_around_them() {
        let grid = uneven();
        for stride in [1, 3, 8, 32, 33, 100] {
            let squares = grid.squares_of(stride);
            for a in 0..squares.num[0] {
                for b in 0..squares.num[1] {
                    let around = |at: usize, axis: usize| {
                        at.saturating_sub(1) * stride..((at + 2) * stride).min(grid.size[axis])
                    };
                    let points = around(a, 0).flat_map(|i| around(b, 1).map(move |j| (i, j)));
                    let most = points.map(|(i, j)| grid.height(i, j)).fold(f32::MIN, f32::max);
                    assert_eq!(squares.highest[a * squares.num[1] + b], most, "{stride}: {a}, {b}");
                }
            }
        }
    }

    #[test]
    fn a_wall_pushes_out_what_is_inside() {
        let (gap, normal) = over(step, [0.51, 0.02]);
        assert!(gap < -0.02 && normal[0] > 0.9, "{gap}, {normal:?}");
    }

    #[test]
    fn a_slope_is_one_plane_on_all_its_cells() {
        for rise in [0.1f32, 0.4, 1.5] {
            let slope = f64::from(rise);
            let up = 1.0 / (1.0 + slope * slope).sqrt();
            for k in 0..200 {
                let x = 0.2 + 0.003 * f64::from(k);
                let (gap, normal) = over(|x| rise * x, [x, slope * x + 0.021 / up]);
                assert!((gap - 0.001).abs() < 2e-6, "{x}: {gap}");
                assert!((normal[2] - up).abs() < 1e-5 && (normal[0] + slope * up).abs() < 1e-5, "{x}: {normal:?}");
            }
        }
    }
}
