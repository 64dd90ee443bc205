//! Rays of an image against the ground: where each of them first meets the heights of a grid.
//!
//! A ray steps through squares of 16 cells, through squares of 4 and through cells. The highest and
//! the lowest point of each square are known. A falling ray goes on from where it is as high as the
//! highest point; it meets a level square there. In a cell the surface is two triangles, as
//! [`HeightGrid`] has them. The result is exact but for rounding: no feature is too thin.
//!
//! Rays that wait for the same step stand side by side in a [`Queue`], and a step takes a full
//! register of them. A step moves each ray to the queue of its next one. Lanes therefore wait for
//! no others, and the loads of many registers are under way together. Rays that fill no register
//! wait for those of the next chunk. The result of a ray depends on the ray alone.

use std::cell::Cell;

use super::lanes::{Kernel, Lanes, MOST_LANES, Real, WithLanes};
use super::math::{Mat3, Vec3};
use super::terrain::{EDGE, HeightGrid, PAGE, PAGE_POINTS};

/// Cells along an edge of the small squares, and small squares along an edge of the large ones.
const SHARE: usize = 4;
/// Cells along an edge of the squares of each level.
const EDGES: [usize; 2] = [SHARE, SHARE * SHARE];
/// Level of the small squares.
const SMALL: usize = 0;
/// Level of the large squares.
const LARGE: usize = 1;
/// Cells between the places that the cells of an image may be counted from: few enough that the
/// numbers of cells are small, and a multiple of both edges.
const BASE: f64 = 64.0;
/// Height above a square from which a ray is not looked at more closely, m: more than rounding.
const CLEAR: f32 = 1e-4;
/// Steepness below which a ray counts as level, per unit of distance.
const LEVEL: f32 = 1e-9;
/// Inverse of a direction without a component along an axis: it crosses nothing.
const FAR: f32 = 1e12;
/// Rays that start together. Their queues fit into the first-level cache.
const CHUNK: usize = 512;
/// Rays that are under way together, at most: a chunk, and in each queue less than a register of
/// the chunk before.
const MOST_RAYS: usize = CHUNK + 3 * MOST_LANES;
/// Numbers of the lanes of a register.
const LANE_NUMBERS: [f32; MOST_LANES] =
    [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0, 13.0, 14.0, 15.0];

/// Highest and lowest points of the squares of a grid.
#[derive(Clone, Debug)]
pub struct HeightBounds {
    /// Highest and lowest point of each square, those on its edges included, m: squares row by row,
    /// small ones first.
    bounds: Vec<f32>,
    /// Number of squares along x and y of each level.
    num: [[usize; 2]; 2],
    /// Squares before those of each level.
    first: [usize; 2],
}

impl HeightBounds {
    /// Finds the bounds of a grid, whose heights do not change afterwards.
    pub fn new(grid: &HeightGrid) -> Self {
        let num = EDGES.map(|edge| grid.size.map(|points| (points - 1).div_ceil(edge)));
        let first = [0, num[SMALL][0] * num[SMALL][1]];
        let mut bounds = Vec::with_capacity(2 * (first[LARGE] + num[LARGE][0] * num[LARGE][1]));
        for (level, edge) in EDGES.into_iter().enumerate() {
            let points = |at: usize, axis: usize| at * edge..=((at + 1) * edge).min(grid.size[axis] - 1);
            for i in 0..num[level][0] {
                for j in 0..num[level][1] {
                    let (mut highest, mut lowest) = (f32::MIN, f32::MAX);
                    for a in points(i, 0) {
                        for b in points(j, 1) {
                            let height = grid.height(a, b);
                            (highest, lowest) = (highest.max(height), lowest.min(height));
                        }
                    }
                    bounds.extend([highest, lowest]);
                }
            }
        }
        Self { bounds, num, first }
    }

    /// No ground within `reach` cells of a place, in cells, is higher than this, m.
    fn highest_around(&self, place: [f64; 2], reach: f64) -> f32 {
        let num = self.num[LARGE];
        let range = |axis: usize| {
            let of = |place: f64| ((place / EDGES[LARGE] as f64) as usize).min(num[axis] - 1);
            of(place[axis] - reach)..=of(place[axis] + reach)
        };
        let mut highest = f32::MIN;
        for i in range(0) {
            for j in range(1) {
                highest = highest.max(self.bounds[2 * (self.first[LARGE] + i * num[1] + j)]);
            }
        }
        highest
    }
}

/// Rays from one place, a camera's pixels.
pub struct Rays<'a> {
    /// Ground that they meet.
    pub grid: &'a HeightGrid,
    /// Bounds of the grid's squares.
    pub bounds: &'a HeightBounds,
    /// Place that the rays start from, in the grid's frame, m.
    pub position: Vec3<f32>,
    /// Camera's axes as columns: x along the camera's axis, y to the left, z to the top.
    pub rotation: &'a Mat3<f32>,
    /// Directions in the camera's axes, x, y and z: `[3][rays]`. Their length is the unit of a
    /// ray's distances.
    pub directions: [&'a [f32]; 3],
    /// Largest distance.
    pub end: f32,
    /// No ray reaches farther than this from the camera, m.
    pub reach: f32,
    /// Distances at which the rays meet the ground, `end` where they meet none before, `[rays]`.
    pub distances: &'a mut [f32],
}

impl WithLanes for Rays<'_> {
    type Output = ();

    #[inline]
    fn run<L: Lanes>(self) {
        L::vectorize(self);
    }
}

impl<S: Real> Kernel<S> for Rays<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { grid, bounds, position, rotation, directions: [x, y, z], end, reach, distances } = self;
        let source = Source::<S>::new(grid, bounds, position, end, reach);
        // no closure: it would not be compiled for the instruction set
        let mut queues = QUEUES.take().unwrap_or_else(|| Box::new(Queues::new()));
        let count = distances.len();
        let mut first = 0;
        while first < count {
            let last = count.min(first + CHUNK);
            source.begin(rotation, first, [&x[first..last], &y[first..last], &z[first..last]], &mut queues);
            // the last rays wait for no others
            source.go_on(&mut queues, if last < count { S::LANES } else { 1 });
            let [rays, met] = &queues.done.numbers;
            for (ray, met) in rays.iter().zip(met).take(queues.done.len) {
                distances[*ray as usize] = *met;
            }
            queues.done.len = 0;
            first = last;
        }
        QUEUES.set(Some(queues));
    }
}

thread_local! {
    /// The queues of a thread: empty between two images.
    static QUEUES: Cell<Option<Box<Queues>>> = const { Cell::new(None) };
}

/// Rays that wait for the same step, and `N` numbers of each.
struct Queue<const N: usize> {
    len: usize,
    numbers: [[f32; MOST_RAYS + MOST_LANES]; N],
}

impl<const N: usize> Queue<N> {
    #[inline(always)]
    fn new() -> Self {
        Self { len: 0, numbers: [[0.0; MOST_RAYS + MOST_LANES]; N] }
    }

    /// The numbers of the rays from a place on.
    #[inline(always)]
    fn load<S: Real>(&self, at: usize) -> [S; N] {
        assert!(at < MOST_RAYS, "no ray is that far behind");
        let (mut out, mut k) = ([S::zero(); N], 0);
        while k < N {
            out[k] = S::load(&self.numbers[k][at..]);
            k += 1;
        }
        out
    }

    /// Lets the rays of a mask wait.
    #[inline(always)]
    fn push<S: Real>(&mut self, mask: S::Mask, numbers: [S; N]) {
        let Some(mask) = S::when(mask) else { return };
        let len = self.len;
        assert!(len <= MOST_RAYS, "a queue has room for all rays that are under way");
        let mut k = 0;
        while k < N {
            numbers[k].store_some(mask, &mut self.numbers[k][len..]);
            k += 1;
        }
        self.len = len + S::count(mask);
    }

    /// Lets rays wait on that filled no register: those from a place to another, less than a
    /// register.
    #[inline(always)]
    fn wait_on<S: Real>(&mut self, from: usize, to: usize) {
        if from < to {
            let rest = self.load::<S>(from);
            self.push(S::load(&LANE_NUMBERS).lt(S::broadcast((to - from) as f32)), rest);
        }
    }
}

/// The queues of all steps.
///
/// A ray is its number, direction (x and y in cells, z in m per unit of distance), the inverses of
/// x and y, the distance that it has come, and the square or cell that it enters there. In cells,
/// the distance at which it leaves their square follows.
struct Queues {
    large: Queue<9>,
    small: Queue<9>,
    cells: Queue<10>,
    /// Numbers and distances of rays that have met something or reached their end.
    done: Queue<2>,
}

impl Queues {
    #[inline(always)]
    fn new() -> Self {
        Self { large: Queue::new(), small: Queue::new(), cells: Queue::new(), done: Queue::new() }
    }
}

/// The place that all rays start from. Lengths along x and y are in cells.
struct Source<'a, S> {
    grid: &'a HeightGrid,
    bounds: &'a HeightBounds,
    /// Cell from which places are counted.
    base: [f32; 2],
    place: [S; 2],
    height: S,
    /// Height above the highest ground in reach, m.
    above: f32,
    per_metre: S,
    /// Largest distance.
    end: S,
    /// Whether all ground in reach is on the grid; beyond it, its edge goes on.
    is_inside: bool,
}

/// A step through a square.
struct Step<S: Real> {
    /// Distance at which the ray leaves the square.
    leave: S,
    /// Whether it leaves the square and goes on.
    goes_on: S::Mask,
    /// The square behind it.
    next: [S; 2],
    /// Whether the ray may meet the ground in a part of the square.
    descends: S::Mask,
    /// Distance from which it may.
    from: S,
    /// Part of the square at that distance.
    part: [S; 2],
}

impl<'a, S: Real> Source<'a, S> {
    #[inline(always)]
    fn new(grid: &'a HeightGrid, bounds: &'a HeightBounds, position: Vec3<f32>, end: f32, reach: f32) -> Self {
        let per_metre = 1.0 / grid.cell;
        let (cells, scale) = (f64::from(reach * per_metre) + 2.0, f64::from(per_metre));
        // far from the origin, single precision would move edges by a hundredth of a millimetre
        let x = (f64::from(position[0]) - f64::from(grid.origin[0])) * scale;
        let y = (f64::from(position[1]) - f64::from(grid.origin[1])) * scale;
        let base = [(x / BASE).floor() * BASE, (y / BASE).floor() * BASE];
        let is_inside =
            x > cells && y > cells && x + cells < (grid.size[0] - 1) as f64 && y + cells < (grid.size[1] - 1) as f64;
        Self {
            grid,
            bounds,
            base: [base[0] as f32, base[1] as f32],
            place: [S::splat(x - base[0]), S::splat(y - base[1])],
            height: S::broadcast(position[2]),
            above: position[2] - bounds.highest_around([x, y], cells),
            per_metre: S::broadcast(per_metre),
            end: S::broadcast(end),
            is_inside,
        }
    }

    /// Starts the rays of a chunk.
    #[inline(always)]
    fn begin(&self, r: &Mat3<f32>, first: usize, [x, y, z]: [&[f32]; 3], queues: &mut Queues) {
        let (lanes, zero, one) = (S::load(&LANE_NUMBERS), S::zero(), S::one());
        let per_edge = S::broadcast(1.0 / EDGES[LARGE] as f32);
        let mut k = 0;
        while k < x.len() {
            let is_ray = lanes.lt(S::broadcast((x.len() - k) as f32));
            let local = [load_or_zero::<S>(&x[k..]), load_or_zero(&y[k..]), load_or_zero(&z[k..])];
            let dx = self.per_metre * turn(&r[0], &local);
            let dy = self.per_metre * turn(&r[1], &local);
            let dz = turn(&r[2], &local);
            let ray = S::broadcast((first + k) as f32) + lanes;
            let (mut start, mut is_low) = (zero, zero.lt(self.end));
            if self.above > 0.0 {
                // above all ground in reach there is nothing to meet
                let falls = dz.lt(S::broadcast(-LEVEL));
                start = S::broadcast(-self.above * (1.0 - 1e-5)) / S::select(falls, dz, -one);
                is_low = S::and(falls, start.lt(self.end));
            }
            queues.done.push(S::and(is_ray, S::not(is_low)), [ray, self.end]);
            let goes_on = S::and(is_ray, is_low);
            if let Some(goes_on) = S::when(goes_on) {
                let i = (dx.mul_add(start, self.place[0]) * per_edge).floor();
                let j = (dy.mul_add(start, self.place[1]) * per_edge).floor();
                self.step_large(goes_on, [ray, dx, dy, dz, inverse(dx), inverse(dy), start, i, j], queues);
            }
            k += S::LANES;
        }
    }

    /// Takes steps while `least` rays or more wait for the same one, a register of them at a time.
    #[inline(always)]
    fn go_on(&self, queues: &mut Queues, least: usize) {
        let lanes = S::load(&LANE_NUMBERS);
        // the number of those of `len` rays that take the step now
        let whole = |len: usize| if least == 1 { len } else { len - len % S::LANES };
        while queues.large.len.max(queues.small.len).max(queues.cells.len) >= least {
            // rays that wait on are written to places that were read before
            while queues.large.len >= least {
                let (len, mut k) = (std::mem::take(&mut queues.large.len), 0);
                while k < whole(len) {
                    let is_ray = lanes.lt(S::broadcast((len - k) as f32));
                    self.step_large(is_ray, queues.large.load(k), queues);
                    k += S::LANES;
                }
                queues.large.wait_on::<S>(k, len);
            }
            while queues.small.len >= least {
                let (len, mut k) = (std::mem::take(&mut queues.small.len), 0);
                while k < whole(len) {
                    let is_ray = lanes.lt(S::broadcast((len - k) as f32));
                    self.step_small(is_ray, queues.small.load(k), queues);
                    k += S::LANES;
                }
                queues.small.wait_on::<S>(k, len);
            }
            while queues.cells.len >= least {
                let (len, mut k) = (std::mem::take(&mut queues.cells.len), 0);
                while k < whole(len) {
                    let is_ray = lanes.lt(S::broadcast((len - k) as f32));
                    self.step_cells(is_ray, queues.cells.load(k), queues);
                    k += S::LANES;
                }
                queues.cells.wait_on::<S>(k, len);
            }
        }
    }

    #[inline(always)]
    fn step_large(&self, is_ray: S::Mask, ray: [S; 9], queues: &mut Queues) {
        let [number, dx, dy, dz, vx, vy, ..] = ray;
        let s = self.step::<LARGE>(is_ray, ray, &mut queues.done);
        queues.large.push(s.goes_on, [number, dx, dy, dz, vx, vy, s.leave, s.next[0], s.next[1]]);
        queues.small.push(s.descends, [number, dx, dy, dz, vx, vy, s.from, s.part[0], s.part[1]]);
    }

    #[inline(always)]
    fn step_small(&self, is_ray: S::Mask, ray: [S; 9], queues: &mut Queues) {
        let [number, dx, dy, dz, vx, vy, _, i, j] = ray;
        let s = self.step::<SMALL>(is_ray, ray, &mut queues.done);
        queues.cells.push(s.descends, [number, dx, dy, dz, vx, vy, s.from, s.part[0], s.part[1], s.leave]);
        // behind the last square of a large one lies a large one
        let per_edge = S::broadcast(1.0 / SHARE as f32);
        let [large_i, large_j] = [(s.next[0] * per_edge).floor(), (s.next[1] * per_edge).floor()];
        let across = ((i * per_edge).floor() - large_i).abs() + ((j * per_edge).floor() - large_j).abs();
        let is_out = S::zero().lt(across);
        let out = [number, dx, dy, dz, vx, vy, s.leave, large_i, large_j];
        queues.large.push(S::and(s.goes_on, is_out), out);
        let on = [number, dx, dy, dz, vx, vy, s.leave, s.next[0], s.next[1]];
        queues.small.push(S::and(s.goes_on, S::not(is_out)), on);
    }

    /// A step through the squares of a level.
    #[inline(always)]
    fn step<const AT: usize>(&self, is_ray: S::Mask, ray: [S; 9], done: &mut Queue<2>) -> Step<S> {
        let (zero, one) = (S::zero(), S::one());
        let [number, dx, dy, dz, vx, vy, enter, i, j] = ray;
        let (is_back_x, is_back_y) = (vx.lt(zero), vy.lt(zero));
        let (ahead_i, ahead_j) = (i + one, j + one);
        let edge = S::broadcast(EDGES[AT] as f32);
        let to_x = (S::select(is_back_x, i, ahead_i) * edge - self.place[0]) * vx;
        let to_y = (S::select(is_back_y, j, ahead_j) * edge - self.place[1]) * vy;
        let leave = to_x.min(to_y).max(enter).min(self.end);
        let is_along_x = to_x.lt(to_y);
        let [highest, lowest] = self.bounds::<AT>(i, j);
        let falls = dz.lt(S::broadcast(-LEVEL));
        // where a falling ray is as high as the highest point
        let down = S::select(falls, (highest - self.height) / S::select(falls, dz, -one), zero);
        let is_level = S::and(falls, S::not(lowest.lt(highest)));
        let low = dz.mul_add(S::select(falls, leave, enter), self.height) - S::broadcast(CLEAR);
        let is_over = S::or(highest.lt(low), S::and(is_level, leave.lt(down)));
        let (passes, touches) = (S::and(is_ray, is_over), S::and(is_ray, S::not(is_over)));
        let meets = S::and(touches, is_level);
        let is_before_end = leave.lt(self.end);
        let stops = S::or(meets, S::and(passes, S::not(is_before_end)));
        done.push(stops, [number, S::select(meets, enter.max(down), self.end)]);
        let from = enter.max(down * S::broadcast(1.0 - 1e-6)).min(leave);
        let per_part = S::broadcast(SHARE as f32 / EDGES[AT] as f32);
        let (share, most) = (S::broadcast(SHARE as f32), S::broadcast(SHARE as f32 - 1.0));
        let (first_i, first_j) = (i * share, j * share);
        let part_i = (dx.mul_add(from, self.place[0]) * per_part).floor().max(first_i).min(first_i + most);
        let part_j = (dy.mul_add(from, self.place[1]) * per_part).floor().max(first_j).min(first_j + most);
        let next_i = S::select(is_along_x, S::select(is_back_x, i - one, ahead_i), i);
        let next_j = S::select(is_along_x, j, S::select(is_back_y, j - one, ahead_j));
        Step {
            leave,
            goes_on: S::and(passes, is_before_end),
            next: [next_i, next_j],
            descends: S::and(touches, S::not(is_level)),
            from,
            part: [part_i, part_j],
        }
    }

    /// A step through the cells of a small square.
    #[inline(always)]
    fn step_cells(&self, is_ray: S::Mask, ray: [S; 10], queues: &mut Queues) {
        let (zero, one) = (S::zero(), S::one());
        let [number, dx, dy, dz, vx, vy, enter, i, j, until] = ray;
        let (is_back_x, is_back_y) = (vx.lt(zero), vy.lt(zero));
        let (step_x, step_y) = (S::select(is_back_x, -one, one), S::select(is_back_y, -one, one));
        let to_x = (S::select(is_back_x, i, i + one) - self.place[0]) * vx;
        let to_y = (S::select(is_back_y, j, j + one) - self.place[1]) * vy;
        let leave = to_x.min(to_y).max(enter).min(until);
        let is_along_x = to_x.lt(to_y);
        let [a, b, c, d] = self.corners(i, j);
        let (u, v) = (self.place[0] - i, self.place[1] - j);
        let ray = Path { direction: [dx, dy, dz], u, v, height: self.height - a };
        let [first, second] = [[c - a, d - c], [d - b, b - a]];
        let before = ray.gap(enter, first, second);
        // the surface bends on the diagonal
        let across = (u - v) * inverse(dy - dx);
        let bend = S::select(S::and(enter.lt(across), across.lt(leave)), across, leave);
        let (middle, after) = (ray.gap(bend, first, second), ray.gap(leave, first, second));
        let is_near = S::not(zero.lt(middle));
        let (from, to) = (S::select(is_near, enter, bend), S::select(is_near, bend, leave));
        let (high, low) = (S::select(is_near, before, middle), S::select(is_near, middle, after));
        let is_below = S::not(zero.lt(before));
        let met = S::select(is_below, enter, (to - from).mul_add(high / (high - low), from));
        let meets = S::and(is_ray, S::or(is_below, S::not(zero.lt(low))));
        let passes = S::and(is_ray, S::not(meets));
        let is_within = leave.lt(until);
        let leaves = S::and(passes, S::not(is_within));
        let is_before_end = leave.lt(self.end);
        let stops = S::or(meets, S::and(leaves, S::not(is_before_end)));
        queues.done.push(stops, [number, S::select(meets, met, self.end)]);
        if let Some(out) = S::when(S::and(leaves, is_before_end)) {
            // behind the last cell of a square lies a square
            let (edge, per_edge) = (S::broadcast(SHARE as f32), S::broadcast(1.0 / SHARE as f32));
            let (small_i, small_j) = ((i * per_edge).floor(), (j * per_edge).floor());
            let to_x = (S::select(is_back_x, small_i, small_i + one) * edge - self.place[0]) * vx;
            let to_y = (S::select(is_back_y, small_j, small_j + one) * edge - self.place[1]) * vy;
            let is_along_x = to_x.lt(to_y);
            let next_i = S::select(is_along_x, small_i + step_x, small_i);
            let next_j = S::select(is_along_x, small_j, small_j + step_y);
            queues.small.push(out, [number, dx, dy, dz, vx, vy, leave, next_i, next_j]);
        }
        let next_i = S::select(is_along_x, i + step_x, i);
        let next_j = S::select(is_along_x, j, j + step_y);
        let on = [number, dx, dy, dz, vx, vy, leave, next_i, next_j, until];
        queues.cells.push(S::and(passes, is_within), on);
    }

    /// Highest and lowest points of squares of a level, m.
    #[inline(always)]
    fn bounds<const AT: usize>(&self, i: S, j: S) -> [S; 2] {
        let edge = EDGES[AT] as f32;
        let ([rows, columns], first) = (self.bounds.num[AT], self.bounds.first[AT] as f32);
        let (mut i, mut j) = (i + S::broadcast(self.base[0] / edge), j + S::broadcast(self.base[1] / edge));
        if !self.is_inside {
            i = i.clamp(S::zero(), S::broadcast((rows - 1) as f32));
            j = j.clamp(S::zero(), S::broadcast((columns - 1) as f32));
        }
        let square = i.mul_add(S::broadcast(columns as f32), j + S::broadcast(first));
        S::gather_pair(&self.bounds.bounds, square, 2, S::zero())
    }

    /// Heights of the corners of cells, m: the first along x and y, the next along y, along x, and
    /// along both.
    #[inline(always)]
    fn corners(&self, i: S, j: S) -> [S; 4] {
        let (grid, zero) = (self.grid, S::zero());
        let (i, j) = (i + S::broadcast(self.base[0]), j + S::broadcast(self.base[1]));
        let last = [S::broadcast((grid.size[0] - 2) as f32), S::broadcast((grid.size[1] - 2) as f32)];
        let (mut row, mut column) = (i, j);
        if !self.is_inside {
            (row, column) = (i.clamp(zero, last[0]), j.clamp(zero, last[1]));
        }
        let per_page = S::broadcast(1.0 / PAGE as f32);
        let (page_i, page_j) = ((row * per_page).floor(), (column * per_page).floor());
        let (row, column) =
            (S::broadcast(PAGE as f32).neg_mul_add(page_i, row), S::broadcast(PAGE as f32).neg_mul_add(page_j, column));
        let page = page_i.mul_add(S::broadcast(grid.columns as f32), page_j);
        let at = row.mul_add(S::broadcast(EDGE as f32), column);
        let beyond = at + S::broadcast(EDGE as f32);
        let [mut a, mut b] = S::gather_pair(&grid.points, page, PAGE_POINTS as u32, at);
        let [mut c, mut d] = S::gather_pair(&grid.points, page, PAGE_POINTS as u32, beyond);
        if !self.is_inside {
            // beyond the grid its edge goes on
            let (is_before, is_after) = (i.lt(zero), last[0].lt(i));
            (a, c) = (S::select(is_after, c, a), S::select(is_before, a, c));
            (b, d) = (S::select(is_after, d, b), S::select(is_before, b, d));
            let (is_before, is_after) = (j.lt(zero), last[1].lt(j));
            (a, b) = (S::select(is_after, b, a), S::select(is_before, a, b));
            (c, d) = (S::select(is_after, d, c), S::select(is_before, c, d));
        }
        [a, b, c, d]
    }
}

/// A ray over a cell: its direction, and where it starts from the cell's first corner.
struct Path<S> {
    direction: Vec3<S>,
    u: S,
    v: S,
    height: S,
}

impl<S: Real> Path<S> {
    /// Height above the surface at a distance, m; `first` and `second` are the rises along x and y
    /// of the two triangles.
    #[inline(always)]
    fn gap(&self, at: S, first: [S; 2], second: [S; 2]) -> S {
        let [dx, dy, dz] = self.direction;
        let (u, v) = (dx.mul_add(at, self.u), dy.mul_add(at, self.v));
        let is_first = v.lt(u);
        let (along_x, along_y) = (S::select(is_first, first[0], second[0]), S::select(is_first, first[1], second[1]));
        along_y.neg_mul_add(v, along_x.neg_mul_add(u, dz.mul_add(at, self.height)))
    }
}

/// A component of turned directions.
#[inline(always)]
fn turn<S: Real>(row: &Vec3<f32>, [x, y, z]: &[S; 3]) -> S {
    S::broadcast(row[0]) * *x + (S::broadcast(row[1]) * *y + S::broadcast(row[2]) * *z)
}

/// One divided by a number, but of limited size.
#[inline(always)]
fn inverse<S: Real>(x: S) -> S {
    let is_small = x.abs().lt(S::broadcast(1.0 / FAR));
    S::select(is_small, S::broadcast(FAR), S::one() / S::select(is_small, S::one(), x))
}

/// The first numbers of a slice, zeros where it ends.
#[inline(always)]
fn load_or_zero<S: Real>(from: &[f32]) -> S {
    if from.len() >= S::LANES {
        return S::load(from);
    }
    let mut lanes = [0.0; MOST_LANES];
    lanes[..from.len()].copy_from_slice(from);
    S::load(&lanes)
}
