//! Rays against the ground: the first place where each of them meets the heights of a grid.
//!
//! A ray walks through squares of 16, then of 4 cells, whose highest points are known, and through
//! the cells of the squares that it may touch. In a cell the surface is two triangles, as
//! [`HeightGrid`] has them. The result is exact but for rounding: no step is skipped and no feature
//! is too thin.

use crate::dynamics::HeightGrid;

/// Cells along an edge of the squares, from the finest to the coarsest.
const EDGES: [i32; 3] = [4, 16, 64];
/// Height above a square or a cell from which a ray is not looked at more closely, m: more than
/// rounding.
const CLEAR: f32 = 1e-4;
/// Directions below this are level, per unit of distance.
const SMALL: f32 = 1e-9;
/// Inverse of a direction without a component along an axis: it crosses nothing.
const FAR: f32 = 1e12;

/// The heights of a grid, arranged for rays.
pub(super) struct HeightMap {
    origin: [f32; 2],
    /// Cells per m.
    per_metre: f32,
    /// Heights of the points, m.
    points: Table,
    /// Highest points of the squares of each edge length, those on their edges included, m.
    squares: [Table; 3],
}

/// Heights row by row, m.
struct Table {
    num: [i32; 2],
    heights: Vec<f32>,
}

impl Table {
    /// A height; beyond the table its edge goes on.
    #[inline(always)]
    fn at(&self, i: i32, j: i32) -> f32 {
        let (i, j) = (i.clamp(0, self.num[0] - 1), j.clamp(0, self.num[1] - 1));
        self.heights[(i * self.num[1] + j) as usize]
    }

    /// Largest heights of squares of `share` by `share` places, of one more where they share
    /// points.
    fn coarser(&self, share: i32, more: i32) -> Self {
        let num = self.num.map(|num| ((num - more + share - 1) / share).max(1));
        let mut heights = vec![f32::MIN; (num[0] * num[1]) as usize];
        for i in 0..num[0] {
            for j in 0..num[1] {
                let most = &mut heights[(i * num[1] + j) as usize];
                for a in i * share..i * share + share + more {
                    for b in j * share..j * share + share + more {
                        *most = most.max(self.at(a, b));
                    }
                }
            }
        }
        Self { num, heights }
    }
}

impl HeightMap {
    /// Copies the heights of a grid.
    pub(super) fn new(grid: &HeightGrid) -> Self {
        let points = Table { num: grid.size.map(|points| points as i32), heights: grid.heights() };
        let finest = points.coarser(EDGES[0], 1);
        let middle = finest.coarser(EDGES[1] / EDGES[0], 0);
        let coarsest = middle.coarser(EDGES[2] / EDGES[1], 0);
        Self { origin: grid.origin, per_metre: 1.0 / grid.cell, points, squares: [finest, middle, coarsest] }
    }

    /// No ground within `reach` of a place is higher than this, m.
    #[inline(always)]
    pub(super) fn highest_around(&self, [x, y]: [f32; 2], reach: f32) -> f32 {
        let squares = &self.squares[2];
        let range = |place: f32, axis: usize| {
            let of = |place: f32| {
                let square = (place - self.origin[axis]) * self.per_metre / EDGES[2] as f32;
                (square.floor() as i32).clamp(0, squares.num[axis] - 1)
            };
            of(place - reach)..=of(place + reach)
        };
        let columns = range(y, 1);
        let mut highest = f32::MIN;
        for i in range(x, 0) {
            for j in columns.clone() {
                highest = highest.max(squares.at(i, j));
            }
        }
        highest
    }

    /// Rays from a place in the world that reach no farther than this, m.
    #[inline(always)]
    pub(super) fn source(&self, [x, y, height]: [f32; 3], reach: f32) -> Source<'_> {
        let place = [(x - self.origin[0]) * self.per_metre, (y - self.origin[1]) * self.per_metre];
        // numbers stay small: cells are counted from the coarsest square of the place
        let base = place.map(|x| (x / EDGES[2] as f32).floor());
        Source {
            map: self,
            base: base.map(|x| x as i32 * EDGES[2]),
            place: [place[0] - base[0] * EDGES[2] as f32, place[1] - base[1] * EDGES[2] as f32],
            height,
            highest: self.highest_around([x, y], reach),
        }
    }
}

/// A place that rays start from. Lengths along x and y are in cells.
pub(super) struct Source<'a> {
    map: &'a HeightMap,
    /// Cell from which places are counted.
    base: [i32; 2],
    place: [f32; 2],
    height: f32,
    /// No ground in reach is higher, m.
    highest: f32,
}

/// A ray: x and y of its direction in cells, z in m, per unit of distance.
struct Ray<'a> {
    map: &'a HeightMap,
    base: [i32; 2],
    place: [f32; 2],
    height: f32,
    direction: [f32; 3],
    inverse: [f32; 2],
    /// 1 along an axis on which it rises, else 0.
    ahead: [i32; 2],
}

impl Source<'_> {
    /// Distance at which a ray meets the ground, if that is below `end`. The direction may have any
    /// length, which is the unit of distances.
    #[inline(always)]
    pub(super) fn cast(&self, [x, y, z]: [f32; 3], end: f32) -> Option<f32> {
        let above = self.height - self.highest;
        let start = match above > 0.0 {
            // above all ground in reach there is nothing to meet
            true if z > -SMALL => return None,
            true => above / -z * (1.0 - 1e-5),
            false => 0.0,
        };
        if start >= end {
            return None;
        }
        let direction = [x * self.map.per_metre, y * self.map.per_metre, z];
        let inverse = |x: f32| if x.abs() < 1.0 / FAR { FAR } else { 1.0 / x };
        let ray = Ray {
            map: self.map,
            base: self.base,
            place: self.place,
            height: self.height,
            direction,
            inverse: [inverse(direction[0]), inverse(direction[1])],
            ahead: [i32::from(x >= 0.0), i32::from(y >= 0.0)],
        };
        let mut square = ray.square(start, EDGES[1]);
        let mut enter = start;
        loop {
            let (leave, axis) = ray.leave(square, EDGES[1], enter, end);
            if ray.lowest(enter, leave) <= ray.highest(1, square)
                && let Some(met) = ray.walk_squares(square, enter, leave)
            {
                return Some(met);
            }
            if leave >= end {
                return None;
            }
            square[axis] += 2 * ray.ahead[axis] - 1;
            enter = leave;
        }
    }
}

impl Ray<'_> {
    /// The square at a distance.
    #[inline(always)]
    fn square(&self, at: f32, edge: i32) -> [i32; 2] {
        [0, 1].map(|axis| ((self.place[axis] + self.direction[axis] * at) / edge as f32).floor() as i32)
    }

    /// Where it leaves a square, but not beyond `last`, and the axis along which the next one lies.
    #[inline(always)]
    fn leave(&self, square: [i32; 2], edge: i32, enter: f32, last: f32) -> (f32, usize) {
        let to =
            |axis: usize| (((square[axis] + self.ahead[axis]) * edge) as f32 - self.place[axis]) * self.inverse[axis];
        let (x, y) = (to(0), to(1));
        let (nearer, axis) = if x < y { (x, 0) } else { (y, 1) };
        (nearer.max(enter).min(last), axis)
    }

    /// Its lowest height between two distances, less than rounding, m.
    #[inline(always)]
    fn lowest(&self, enter: f32, leave: f32) -> f32 {
        let z = self.direction[2];
        self.height + z * if z < 0.0 { leave } else { enter } - CLEAR
    }

    /// The highest point of a square, m.
    #[inline(always)]
    fn highest(&self, level: usize, [i, j]: [i32; 2]) -> f32 {
        let edge = EDGES[level];
        self.map.squares[level].at(self.base[0] / edge + i, self.base[1] / edge + j)
    }

    /// Walks through the squares of 4 cells in one of 16, between two distances.
    #[inline(always)]
    fn walk_squares(&self, outer: [i32; 2], mut enter: f32, last: f32) -> Option<f32> {
        let mut square = self.within(outer, EDGES[1] / EDGES[0], self.square(enter, EDGES[0]));
        loop {
            let (leave, axis) = self.leave(square, EDGES[0], enter, last);
            if self.lowest(enter, leave) <= self.highest(0, square)
                && let Some(met) = self.walk_cells(square, enter, leave)
            {
                return Some(met);
            }
            if leave >= last {
                return None;
            }
            square[axis] += 2 * self.ahead[axis] - 1;
            enter = leave;
        }
    }

    /// The part of a larger square that is nearest to `inner`.
    #[inline(always)]
    fn within(&self, outer: [i32; 2], share: i32, inner: [i32; 2]) -> [i32; 2] {
        [0, 1].map(|axis| inner[axis].clamp(outer[axis] * share, outer[axis] * share + share - 1))
    }

    /// Walks through the cells of a square of 4, between two distances.
    #[inline(always)]
    fn walk_cells(&self, outer: [i32; 2], mut enter: f32, last: f32) -> Option<f32> {
        let mut cell = self.within(outer, EDGES[0], self.square(enter, 1));
        loop {
            let (leave, axis) = self.leave(cell, 1, enter, last);
            let (i, j) = (self.base[0] + cell[0], self.base[1] + cell[1]);
            let points = &self.map.points;
            let corners = [points.at(i, j), points.at(i, j + 1), points.at(i + 1, j), points.at(i + 1, j + 1)];
            let [a, b, c, d] = corners;
            if self.lowest(enter, leave) <= a.max(b).max(c.max(d))
                && let Some(met) = self.meet(cell, corners, enter, leave)
            {
                return Some(met);
            }
            if leave >= last {
                return None;
            }
            cell[axis] += 2 * self.ahead[axis] - 1;
            enter = leave;
        }
    }

    /// Where it meets the two triangles of a cell, between two distances.
    #[inline(always)]
    fn meet(&self, cell: [i32; 2], [a, b, c, d]: [f32; 4], enter: f32, leave: f32) -> Option<f32> {
        let ([x, y], [dx, dy, dz]) = (self.place, self.direction);
        let (u, v) = (x - cell[0] as f32, y - cell[1] as f32);
        let gap = |t: f32| {
            let (u, v) = (u + dx * t, v + dy * t);
            let (along_x, along_y) = if u > v { (c - a, d - c) } else { (d - b, b - a) };
            (self.height - a) + dz * t - along_x * u - along_y * v
        };
        let before = gap(enter);
        if before <= 0.0 {
            return Some(enter);
        }
        // the surface bends on the diagonal
        let across = (u - v) / (dy - dx);
        let bend = if across > enter && across < leave { across } else { leave };
        let middle = gap(bend);
        if middle <= 0.0 {
            return Some(enter + (bend - enter) * (before / (before - middle)));
        }
        let after = gap(leave);
        (after <= 0.0).then(|| bend + (leave - bend) * (middle / (middle - after)))
    }
}
