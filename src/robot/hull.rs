//! Convex hulls of few points, for meshes of many.

use std::collections::{HashMap, HashSet};
use std::panic::{AssertUnwindSafe, catch_unwind};

use glam::{DVec3, Vec3};
use parry3d::query::PointQuery;
use parry3d::shape::Triangle;

/// A hull has at most this many points: the simulator tests each of them against the ground.
pub(super) const MAX_POINTS: usize = 32;
/// Of more points than this, only the extreme ones along [`DIRECTIONS`] directions and a few go on: it bounds the work,
/// and the recursion of the hull algorithm.
const MANY: usize = 4096;
const DIRECTIONS: usize = 1024;
/// A hull with all its corners that leaves a point farther outside than this, relative to its size, has failed.
const FAILURE: f64 = 1e-3;
/// Distances below this, relative to the size, are rounding.
const TOLERANCE: f64 = 1e-6;

/// Convex hull of a mesh.
pub(super) struct Hull {
    /// Points that are all vertices of the mesh, at most [`MAX_POINTS`]; or the corners of its bounding box.
    pub points: Vec<DVec3>,
    /// How far the mesh reaches beyond the hull of `points`, m.
    pub deviation: f64,
    /// Whether the hull could not be told and the bounding box stands for it.
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
            // with all of them nothing is left out, whatever their hull is
            Hull { points: extreme, deviation: 0.0, boxed: false }
        } else {
            frame.bounding_box()
        }
    })
}

/// Outward triangles of the hull of points, as indices into them; none where they cannot be told.
pub(crate) fn triangles(points: &[DVec3]) -> Vec<[usize; 3]> {
    let facets = Frame::new(points).facets(points);
    let index = |corner: DVec3| points.iter().position(|point| *point == corner);
    let corners = |[a, b, c]: [DVec3; 3]| Some([index(a)?, index(b)?, index(c)?]);
    facets.map_or_else(Vec::new, |facets| facets.triangles.into_iter().filter_map(corners).collect())
}

/// Corners of the hull of `extreme`, chosen so that they leave out little; `None` where the hull cannot be told.
fn reduced(frame: &Frame, all: &[DVec3], extreme: &[DVec3]) -> Option<Hull> {
    let tolerance = TOLERANCE * frame.size.length();
    let corners = frame.facets(extreme)?.points;
    let whole = corners.len() <= MAX_POINTS;
    let mut points = corners.clone();
    if !whole {
        // What sticks out most comes first; then, one after another, what the hull so far leaves out most.
        points = frame.extreme(&corners, lattice_directions());
        while points.len() < MAX_POINTS {
            let facets = frame.facets(&points)?;
            let beyond = corners.iter().map(|corner| (facets.distance(*corner), *corner));
            match beyond.max_by(|a, b| a.0.total_cmp(&b.0)) {
                Some((distance, corner)) if distance > tolerance => points.push(corner),
                _ => break,
            }
        }
    }
    let facets = frame.facets(&points)?;
    let deviation = all.iter().map(|point| facets.distance(*point)).fold(0.0, f64::max);
    let failed = whole && deviation > FAILURE * frame.size.length();
    (!failed).then_some(Hull { points, deviation, boxed: false })
}

/// The bounding box of the points. Stretched to a cube it has the same hull, and no direction is too thin for `f32`.
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

    /// The points that reach farthest along each direction, without repetitions.
    fn extreme(&self, points: &[DVec3], directions: impl Iterator<Item = DVec3>) -> Vec<DVec3> {
        let stretched: Vec<DVec3> = points.iter().map(|point| self.stretched(*point).as_dvec3()).collect();
        let mut chosen = Vec::new();
        for direction in directions {
            let reach = |index: &usize| stretched[*index].dot(direction);
            chosen.extend((0..points.len()).max_by(|a, b| reach(a).total_cmp(&reach(b))));
        }
        chosen.sort_unstable();
        chosen.dedup();
        chosen.into_iter().map(|index| points[index]).collect()
    }

    /// The faces of the hull; `None` where they cannot be told.
    fn facets(&self, points: &[DVec3]) -> Option<Facets> {
        let stretched: Vec<Vec3> = points.iter().map(|point| self.stretched(*point)).collect();
        // It asserts its way through degenerate input.
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
            .collect::<Option<_>>()?;
        Some(Facets { points, triangles, origin: self.least, tolerance: TOLERANCE * self.size.length() })
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

/// Outward triangles of a hull.
struct Facets {
    points: Vec<DVec3>,
    triangles: Vec<[DVec3; 3]>,
    origin: DVec3,
    tolerance: f64,
}

impl Facets {
    /// How far `point` lies outside, m.
    fn distance(&self, point: DVec3) -> f64 {
        let height = |[a, b, c]: &[DVec3; 3]| (b - a).cross(c - a).normalize_or_zero().dot(point - a);
        // deep inside a hull, not on a flat one
        if self.triangles.iter().all(|triangle| height(triangle) < -self.tolerance) {
            return 0.0;
        }
        let near = |p: DVec3| (p - self.origin).as_vec3();
        let distance = |[a, b, c]: &[DVec3; 3]| {
            Triangle::new(near(*a), near(*b), near(*c)).distance_to_local_point(near(point), false)
        };
        f64::from(self.triangles.iter().map(distance).fold(f32::INFINITY, f32::min))
    }
}

/// The bits of a point, zeros of both signs alike.
fn key(point: Vec3) -> [u32; 3] {
    (point + 0.0).to_array().map(f32::to_bits)
}

/// Along the axes and the diagonals of a cube.
fn lattice_directions() -> impl Iterator<Item = DVec3> {
    let axes = [DVec3::X, DVec3::Y, DVec3::Z].into_iter().flat_map(|axis| [axis, -axis]);
    let diagonals = (0..8u32).map(|corner| {
        let sign = |bit: u32| if corner >> bit & 1 == 0 { 1.0 } else { -1.0 };
        DVec3::new(sign(0), sign(1), sign(2))
    });
    axes.chain(diagonals)
}

/// Evenly spread over the sphere, along the golden spiral.
fn fibonacci_directions() -> impl Iterator<Item = DVec3> {
    let golden_angle = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    (0..DIRECTIONS).map(move |i| {
        let z = 1.0 - (2.0 * i as f64 + 1.0) / DIRECTIONS as f64;
        let (sine, cosine) = (golden_angle * i as f64).sin_cos();
        let across = (1.0 - z * z).sqrt();
        DVec3::new(across * cosine, across * sine, z)
    })
}
