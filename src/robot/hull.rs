//! Convex hulls with few points, for meshes with many.

use std::collections::{HashMap, HashSet};
use std::panic::{AssertUnwindSafe, catch_unwind};

use glam::{DVec3, Vec3};
use parry3d::query::PointQuery;
use parry3d::shape::Triangle;

/// Largest number of points of a hull: the simulator tests each of them against the ground.
pub(super) const MAX_POINTS: usize = 32;
/// Largest number of points that are all kept. A larger set keeps the extreme points along
/// [`DIRECTIONS`] directions and a few others: this bounds the work, and the recursion of the hull
/// algorithm.
const MANY: usize = 4096;
const DIRECTIONS: usize = 1024;
/// A hull with all its corners that leaves a point farther outside than this, relative to its size,
/// has failed.
const FAILURE: f64 = 1e-3;
/// Distances below this, relative to the size, are rounding.
const TOLERANCE: f64 = 1e-6;

/// Convex hull of a mesh.
pub(super) struct Hull {
    /// Points that are all vertices of the mesh, at most [`MAX_POINTS`]; or the corners of its
    /// bounding box.
    pub points: Vec<DVec3>,
    /// Distance by which the mesh reaches beyond the hull of `points`, m.
    pub deviation: f64,
    /// Whether the hull could not be computed and the bounding box stands for it.
    pub boxed: bool,
}

/// The hull of at least one finite point.
pub(super) fn hull(vertices: &[DVec3]) -> Hull {
    let frame = Frame::new(vertices);
    let all = frame.distinct(vertices);
    let directions = lattice_directions().chain(fibonacci_directions());
    let extreme = if all.len() > MANY { frame.extreme(&all, directions) } else { all.clone() };
    reduced(&frame, &all, &extreme).unwrap_or_else(|| {
        if extreme.len() <= MAX_POINTS {
            // with all points nothing is left out, whatever their hull is
            Hull { points: extreme, deviation: 0.0, boxed: false }
        } else {
            frame.bounding_box()
        }
    })
}

/// Outward triangles of the hull of points, as indices into them; empty where it cannot be
/// computed.
pub(crate) fn triangles(points: &[DVec3]) -> Vec<[usize; 3]> {
    let facets = Frame::new(points).facets(points);
    let index = |corner: DVec3| points.iter().position(|point| *point == corner);
    let corners = |[a, b, c]: [DVec3; 3]| Some([index(a)?, index(b)?, index(c)?]);
    facets.map_or_else(Vec::new, |facets| facets.triangles.into_iter().filter_map(corners).collect())
}

/// Corners of the hull of `extreme`, chosen so that they leave out little; `None` where the hull
/// cannot be computed.
fn reduced(frame: &Frame, all: &[DVec3], extreme: &[DVec3]) -> Option<Hull> {
    let tolerance = TOLERANCE * frame.size.length();
    let corners = frame.facets(extreme)?.points;
    let whole = corners.len() <= MAX_POINTS;
    let mut points = corners.clone();
    if !whole {
        // the point that sticks out most comes first; then, one after another, the point that is
        // farthest outside the hull so far
        points = frame.extreme(&corners, lattice_directions());
        while points.len() < MAX_POINTS {
            match frame.facets(&points)?.farthest(&corners) {
                Some((distance, corner)) if distance > tolerance => points.push(corner),
                _ => break,
            }
        }
    }
    let deviation = frame.facets(&points)?.farthest(all).map_or(0.0, |(distance, _)| distance);
    let failed = whole && deviation > FAILURE * frame.size.length();
    (!failed).then_some(Hull { points, deviation, boxed: false })
}

/// The bounding box of the points. Stretched to a cube it has the same hull, and no direction is
/// too thin for `f32`.
struct Frame {
    least: DVec3,
    size: DVec3,
}

impl Frame {
    fn new(points: &[DVec3]) -> Self {
        let least = points.iter().copied().reduce(DVec3::min).unwrap_or_default();
        let most = points.iter().copied().reduce(DVec3::max).unwrap_or_default();
        Self { least, size: most - least }
    }

    fn stretched(&self, point: DVec3) -> Vec3 {
        let scale = self.size.map(|length| if length > 0.0 { length } else { 1.0 });
        ((point - self.least) / scale).as_vec3()
    }

    /// One of each set of points that are the same to `f32`, in their order.
    fn distinct(&self, points: &[DVec3]) -> Vec<DVec3> {
        let mut seen = HashSet::with_capacity(points.len());
        points.iter().copied().filter(|point| seen.insert(key(self.stretched(*point)))).collect()
    }

    /// The points that reach farthest along each direction, without repetitions; the last one among
    /// equals.
    fn extreme(&self, points: &[DVec3], directions: impl Iterator<Item = DVec3>) -> Vec<DVec3> {
        let stretched: Vec<DVec3> = points.iter().map(|point| self.stretched(*point).as_dvec3()).collect();
        let cells = Cells::new(&stretched);
        let mut chosen: Vec<usize> = directions.filter_map(|direction| cells.farthest(&stretched, direction)).collect();
        chosen.sort_unstable();
        chosen.dedup();
        chosen.into_iter().map(|index| points[index]).collect()
    }

    /// The faces of the hull; `None` where they cannot be computed.
    fn facets(&self, points: &[DVec3]) -> Option<Facets> {
        let stretched: Vec<Vec3> = points.iter().map(|point| self.stretched(*point)).collect();
        // The library panics on degenerate input.
        let hull = catch_unwind(AssertUnwindSafe(|| parry3d::transformation::try_convex_hull(&stretched)));
        let (corners, triangles) = hull.ok()?.ok()?;
        let by_key: HashMap<_, _> = stretched.iter().zip(points).map(|(s, p)| (key(*s), *p)).collect();
        let points: Vec<DVec3> = corners.iter().map(|c| by_key.get(&key(*c)).copied()).collect::<Option<_>>()?;
        let triangles = triangles
            .into_iter()
            .map(|[a, b, c]| {
                let corner = |index: u32| points.get(index as usize).copied();
                Some([corner(a)?, corner(b)?, corner(c)?])
            })
            .collect::<Option<Vec<[DVec3; 3]>>>()?;
        Some(Facets::new(points, triangles, self))
    }

    fn bounding_box(&self) -> Hull {
        let corner = |corner: u32| {
            let side = |bit: u32| f64::from(corner >> bit & 1);
            self.least + self.size * DVec3::new(side(0), side(1), side(2))
        };
        let mut points: Vec<DVec3> = (0..8).map(corner).collect();
        points.dedup();
        Hull { points, deviation: 0.0, boxed: true }
    }
}

/// Points in the cells of a grid over the unit cube, so that a search along a direction skips most
/// of them.
struct Cells {
    /// Corners of the box about the points of each cell that holds any, and where its points are in
    /// `order`.
    boxes: Vec<(DVec3, DVec3, std::ops::Range<usize>)>,
    /// Indices of the points, cell by cell.
    order: Vec<u32>,
}

impl Cells {
    /// Cells along each axis.
    const SIDE: usize = 16;
    /// Largest rounding error of a reach, for points in the unit cube along directions of length
    /// two at most.
    const ROUNDING: f64 = 1e-12;

    fn new(points: &[DVec3]) -> Self {
        let side = Self::SIDE as f64;
        let cell = |point: &DVec3| {
            let [x, y, z] = point.to_array().map(|x| ((x * side) as usize).min(Self::SIDE - 1));
            (x * Self::SIDE + y) * Self::SIDE + z
        };
        let mut ends = vec![0; Self::SIDE.pow(3) + 1];
        points.iter().for_each(|point| ends[cell(point) + 1] += 1);
        for at in 1..ends.len() {
            ends[at] += ends[at - 1];
        }
        let starts = ends.clone();
        let mut order = vec![0; points.len()];
        for (index, point) in points.iter().enumerate() {
            let end = &mut ends[cell(point)];
            order[*end] = index as u32;
            *end += 1;
        }
        let mut boxes = Vec::new();
        for range in starts.windows(2).map(|window| window[0]..window[1]).filter(|range| !range.is_empty()) {
            let own = || order[range.clone()].iter().map(|index| points[*index as usize]);
            let low = own().reduce(DVec3::min).unwrap_or_default();
            let high = own().reduce(DVec3::max).unwrap_or_default();
            boxes.push((low, high, range));
        }
        Self { boxes, order }
    }

    /// Index of the point that reaches farthest along a direction; the last one among equals.
    fn farthest(&self, points: &[DVec3], direction: DVec3) -> Option<usize> {
        let bounds: Vec<f64> =
            self.boxes.iter().map(|(low, high, _)| (direction * *low).max(direction * *high).element_sum()).collect();
        let first = (0..bounds.len()).max_by(|a, b| bounds[*a].total_cmp(&bounds[*b]))?;
        let mut best: Option<(f64, usize)> = None;
        let search = |cell: usize, best: &mut Option<(f64, usize)>| {
            for &index in &self.order[self.boxes[cell].2.clone()] {
                let own = (points[index as usize].dot(direction), index as usize);
                if best.is_none_or(|best| own.0.total_cmp(&best.0).then(own.1.cmp(&best.1)).is_gt()) {
                    *best = Some(own);
                }
            }
        };
        search(first, &mut best);
        for (cell, bound) in bounds.iter().enumerate() {
            if cell != first && best.is_none_or(|(reach, _)| *bound + Self::ROUNDING >= reach) {
                search(cell, &mut best);
            }
        }
        best.map(|(_, index)| index)
    }
}

/// Outward triangles of a hull.
struct Facets {
    points: Vec<DVec3>,
    triangles: Vec<[DVec3; 3]>,
    /// Outward unit normal of each triangle.
    normals: Vec<DVec3>,
    /// The triangles from `origin`, as precise as distances are measured.
    near: Vec<Triangle>,
    origin: DVec3,
    tolerance: f64,
}

impl Facets {
    fn new(points: Vec<DVec3>, triangles: Vec<[DVec3; 3]>, frame: &Frame) -> Self {
        let origin = frame.least;
        let near = |p: DVec3| (p - origin).as_vec3();
        Self {
            normals: triangles.iter().map(|[a, b, c]| (*b - *a).cross(*c - *a).normalize_or_zero()).collect(),
            near: triangles.iter().map(|[a, b, c]| Triangle::new(near(*a), near(*b), near(*c))).collect(),
            points,
            triangles,
            origin,
            tolerance: TOLERANCE * frame.size.length(),
        }
    }

    /// The last of the points that lie farthest outside, and their distance, m.
    fn farthest(&self, points: &[DVec3]) -> Option<(f64, DVec3)> {
        let mut best: Option<(f64, DVec3)> = None;
        for &point in points {
            let least = best.map_or(0.0, |(distance, _)| distance);
            if let Some(distance) = self.distance(point, least) {
                best = Some((distance, point));
            }
        }
        best
    }

    /// Distance of `point` outside the hull, m; `None` where that is less than `least`.
    fn distance(&self, point: DVec3, least: f64) -> Option<f64> {
        let heights = self.triangles.iter().zip(&self.normals).map(|([a, ..], normal)| normal.dot(point - *a));
        // deep inside a hull that is not flat
        if heights.clone().all(|height| height < -self.tolerance) {
            return (least == 0.0).then_some(0.0);
        }
        let near = (point - self.origin).as_vec3();
        let mut nearest = f32::INFINITY;
        // the face opposite the point is probably the nearest, and soon shows that others lie
        // farther outside
        let facing = heights.enumerate().max_by(|a, b| a.1.total_cmp(&b.1)).map(|(index, _)| index);
        for triangle in facing.into_iter().chain(0..self.near.len()) {
            nearest = nearest.min(self.near[triangle].distance_to_local_point(near, false));
            if f64::from(nearest) < least {
                return None;
            }
        }
        Some(f64::from(nearest))
    }
}

/// The bits of a point; zeros of both signs have the same.
fn key(point: Vec3) -> [u32; 3] {
    (point + 0.0).to_array().map(f32::to_bits)
}

/// Directions along the axes and the diagonals of a cube.
fn lattice_directions() -> impl Iterator<Item = DVec3> {
    let axes = [DVec3::X, DVec3::Y, DVec3::Z].into_iter().flat_map(|axis| [axis, -axis]);
    let diagonals = (0..8u32).map(|corner| {
        let sign = |bit: u32| if corner >> bit & 1 == 0 { 1.0 } else { -1.0 };
        DVec3::new(sign(0), sign(1), sign(2))
    });
    axes.chain(diagonals)
}

/// Directions spread evenly over the sphere, along the golden spiral.
fn fibonacci_directions() -> impl Iterator<Item = DVec3> {
    let golden_angle = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    (0..DIRECTIONS).map(move |i| {
        let z = 1.0 - (2.0 * i as f64 + 1.0) / DIRECTIONS as f64;
        let (sine, cosine) = (golden_angle * i as f64).sin_cos();
        let across = (1.0 - z * z).sqrt();
        DVec3::new(across * cosine, across * sine, z)
    })
}
