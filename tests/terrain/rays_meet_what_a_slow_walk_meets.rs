//! The rays of a camera meet the ground where an exact search along each ray meets it: in double
//! precision, over every line of the grid and every diagonal. The bits are those of the ray alone.

use polypod::dynamics::lanes::Simd;
use polypod::dynamics::{HeightBounds, HeightGrid, Rays, cast_rays};

const CELL: f32 = 0.025;
/// Points along x and y: no whole number of squares or pages.
const SIZE: [usize; 2] = [211, 150];
const END: f32 = 3.0;
/// The result lies between those on ground that is lower and higher by this, m: rounding, of places
/// along the steepest walls too.
const NEAR: f64 = 1e-4;

struct Random(u64);

impl Random {
    fn unit(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 40) as f32 / (1u64 << 24) as f32
    }

    fn between(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.unit()
    }
}

/// Grounds of every sort.
fn grounds() -> Vec<(&'static str, HeightGrid)> {
    let mut random = Random(3);
    let noise: Vec<f32> = (0..SIZE[0] * SIZE[1]).map(|_| random.between(-0.05, 0.05)).collect();
    let ring = |i: usize, j: usize| (i as f32 - 105.0).abs().max((j as f32 - 75.0).abs()) * CELL;
    let all: [(&str, &dyn Fn(usize, usize) -> f32); 8] = [
        ("level", &|_, _| 0.25),
        ("noise", &|i, j| noise[i * SIZE[1] + j]),
        ("stairs", &|i, j| 0.2 * (ring(i, j) / 0.3).floor()),
        ("stairs down", &|i, j| -0.2 * (ring(i, j) / 0.3).floor()),
        ("a pit", &|i, j| if ring(i, j) < 0.4 { -1.0 } else { 0.0 }),
        ("gaps", &|i, _| if i % 20 < 2 { -0.6 } else { 0.0 }),
        ("thin walls", &|i, j| if i == 120 || j == 60 { 0.3 } else { 0.0 }),
        ("a slope", &|i, j| 0.4 * ring(i, j)),
    ];
    let grid = |of: &dyn Fn(usize, usize) -> f32| {
        let mut grid = HeightGrid::level([-2.6, -1.9], CELL, SIZE, 0.0);
        for i in 0..SIZE[0] {
            (0..SIZE[1]).for_each(|j| grid.set_height(i, j, of(i, j)));
        }
        grid
    };
    all.into_iter().map(|(name, of)| (name, grid(of))).collect()
}

/// The surface in double precision; x and y in cells. Beyond the grid its edge goes on.
fn height(grid: &HeightGrid, x: f64, y: f64) -> f64 {
    let split = |x: f64, axis: usize| {
        let x = x.clamp(0.0, (SIZE[axis] - 1) as f64);
        let i = x.floor().min((SIZE[axis] - 2) as f64);
        (i as usize, x - i)
    };
    let ((i, u), (j, v)) = (split(x, 0), split(y, 1));
    let at = |i: usize, j: usize| f64::from(grid.height(i, j));
    let (a, b, c, d) = (at(i, j), at(i, j + 1), at(i + 1, j), at(i + 1, j + 1));
    if u > v { a + (c - a) * u + (d - c) * v } else { a + (d - b) * u + (b - a) * v }
}

/// First distance at which a ray is not above the ground; the end where there is none.
fn slow(grid: &HeightGrid, place: [f64; 3], direction: [f64; 3]) -> f64 {
    let [x, y] = [0, 1].map(|k| (place[k] - f64::from(grid.origin[k])) / f64::from(CELL));
    let [dx, dy] = [0, 1].map(|k| direction[k] / f64::from(CELL));
    let end = f64::from(END);
    // between two of these the surface below the ray is one plane
    let mut bends = vec![0.0, end];
    for (at, speed) in [(x, dx), (y, dy), (x - y, dx - dy)] {
        let (low, high) = (at.min(at + speed * end), at.max(at + speed * end));
        bends.extend((low.ceil() as i64..=high.floor() as i64).map(|line| (line as f64 - at) / speed));
    }
    bends.retain(|bend| (0.0..=end).contains(bend));
    bends.sort_by(f64::total_cmp);
    let gap = |t: f64| place[2] + direction[2] * t - height(grid, x + dx * t, y + dy * t);
    if gap(0.0) <= 0.0 {
        return 0.0;
    }
    for pair in bends.windows(2) {
        let (before, after) = (gap(pair[0]), gap(pair[1]));
        if after <= 0.0 {
            return pair[0] + (pair[1] - pair[0]) * (before / (before - after)).clamp(0.0, 1.0);
        }
    }
    end
}

/// A camera: its place and axes.
struct Camera {
    position: [f32; 3],
    rotation: [[f32; 3]; 3],
}

/// Cameras that look in all directions, also from beyond the grid, from below the ground, along its
/// lines, and almost level.
fn cameras(grid: &HeightGrid, count: usize) -> Vec<Camera> {
    let mut random = Random(5);
    (0..count)
        .map(|k| {
            let (x, y) = (random.between(-3.2, 3.2), random.between(-2.4, 2.4));
            let [i, j] = [0, 1].map(|axis| f64::from(([x, y][axis] - grid.origin[axis]) / CELL));
            let above = if k % 11 == 0 { -0.05 } else { random.between(0.02, 0.7) };
            let (yaw, pitch) = match k % 5 {
                0 => (std::f32::consts::FRAC_PI_4 * (k / 5 % 8) as f32, 0.4),
                1 => (random.between(-3.2, 3.2), random.between(-0.01, 0.01)),
                _ => (random.between(-3.2, 3.2), random.between(-0.6, 1.4)),
            };
            let ((sin, cos), (dive, level)) = (yaw.sin_cos(), pitch.sin_cos());
            Camera {
                position: [x, y, height(grid, i, j) as f32 + above],
                rotation: [[cos * level, -sin, cos * dive], [sin * level, cos, sin * dive], [-dive, 0.0, level]],
            }
        })
        .collect()
}

/// Directions of pixels in a camera's axes: no whole number of registers.
fn pixels() -> [Vec<f32>; 3] {
    let (width, height) = (13, 11);
    let side = |k: usize, count: usize| 0.8 * (1.0 - (2 * k + 1) as f32 / count as f32);
    let all = 0..width * height;
    [
        vec![1.0; width * height],
        all.clone().map(|k| side(k % width, width)).collect(),
        all.map(|k| side(k / width, height)).collect(),
    ]
}

fn cast(simd: Simd, grid: &HeightGrid, bounds: &HeightBounds, camera: &Camera, [x, y, z]: [&[f32]; 3]) -> Vec<f32> {
    let mut distances = vec![f32::NAN; x.len()];
    let (position, rotation) = (camera.position, &camera.rotation);
    let rays = Rays {
        grid,
        bounds,
        position,
        rotation,
        directions: [x, y, z],
        end: END,
        reach: END * 1.6,
        distances: &mut distances,
    };
    cast_rays(simd.token().unwrap(), rays);
    distances
}

#[test]
fn rays_meet_the_ground_where_an_exact_search_does() {
    let [x, y, z] = pixels();
    let (mut all, mut narrow, mut met) = (0, 0, 0);
    for (name, grid) in grounds() {
        let bounds = HeightBounds::new(&grid);
        for (k, camera) in cameras(&grid, 60).iter().enumerate() {
            let distances = cast(Simd::available()[0], &grid, &bounds, camera, [&x, &y, &z]);
            for (pixel, distance) in distances.iter().enumerate() {
                let local = [x[pixel], y[pixel], z[pixel]].map(f64::from);
                let direction = camera.rotation.map(|row| (0..3).map(|k| f64::from(row[k]) * local[k]).sum::<f64>());
                let place = camera.position.map(f64::from);
                let raised = |by: f64| slow(&grid, [place[0], place[1], place[2] + by], direction);
                let (early, late) = (raised(-NEAR), raised(NEAR));
                let distance = f64::from(*distance);
                assert!(
                    early - 2e-6 <= distance && distance <= late + 2e-6,
                    "{name}, camera {k}, pixel {pixel}: {distance}, not {early} to {late}"
                );
                all += 1;
                narrow += usize::from(late - early < 2e-3);
                met += usize::from(late < f64::from(END));
            }
        }
    }
    assert!(narrow * 100 > all * 90 && met * 3 > all, "{narrow} and {met} of {all}");
}

#[test]
fn the_bits_of_a_ray_depend_on_the_ray_alone() {
    let [x, y, z] = pixels();
    for (name, grid) in grounds() {
        let bounds = HeightBounds::new(&grid);
        for camera in cameras(&grid, 20) {
            let bits = |distances: Vec<f32>| distances.into_iter().map(f32::to_bits).collect::<Vec<_>>();
            let expected = bits(cast(Simd::Portable, &grid, &bounds, &camera, [&x, &y, &z]));
            assert!(expected.iter().all(|bits| (0.0..=END).contains(&f32::from_bits(*bits))), "{name}");
            for simd in Simd::available() {
                assert_eq!(bits(cast(simd, &grid, &bounds, &camera, [&x, &y, &z])), expected, "{name}, {simd:?}");
            }
            // in other company: one by one, and as part of many
            let simd = Simd::available()[0];
            for first in [0, 50, x.len() - 1] {
                let alone = first..first + 1;
                let pixel = [&x[alone.clone()], &y[alone.clone()], &z[alone]];
                assert_eq!(bits(cast(simd, &grid, &bounds, &camera, pixel)), expected[first..=first], "{name}");
            }
            let [many_x, many_y, many_z] = [&x, &y, &z].map(|side| side.repeat(5));
            let many = bits(cast(simd, &grid, &bounds, &camera, [&many_x, &many_y, &many_z]));
            assert!(many.chunks(x.len()).all(|part| part == expected), "{name}");
        }
    }
}
