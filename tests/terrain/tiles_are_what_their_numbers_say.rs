//! Every type of tile has the counts, widths and heights of its config at the easiest and at the
//! hardest level, a level platform where robots begin, and is one ground for both engines.

use avian3d::prelude::{SpatialQuery, SpatialQueryFilter};
use bevy_ecs::system::SystemState;
use polypod::components::{EnvId, EnvOrigin, EnvRng};
use polypod::config::{Library, SubTerrainShape, TerrainConfig};
use polypod::dynamics::HeightGrid;
use polypod::dynamics::lanes::Simd;
use polypod::terrain::{TerrainLayout, generate, generate_in};
use polypod::world::{Ground, below};
use polypod::{Sim, SimOptions};

use crate::common::{self, assert_all_same, step};

const CELL: f32 = 0.025;
/// Height of a vertex of a height field is a multiple of this, m.
const VERTICAL: f32 = 0.005;

const TYPES: [(&str, &str); 19] = [
    ("gap", "gap_width_range=[0.1, 0.6], platform_width=2.0, gap_depth=0.8"),
    ("pit", "pit_depth_range=[0.1, 0.4], platform_width=2.0"),
    ("pit", "pit_depth_range=[0.1, 0.3], platform_width=2.0, double_pit=true"),
    ("box", "box_height_range=[0.1, 0.4], platform_width=2.0"),
    ("box", "box_height_range=[0.1, 0.3], platform_width=2.0, double_box=true"),
    ("rails", "rail_thickness_range=[0.1, 0.2], rail_height_range=[0.05, 0.25], platform_width=2.0"),
    (
        "floating_ring",
        "ring_width_range=[0.2, 0.4], ring_height_range=[0.05, 0.2], ring_thickness=0.05, platform_width=2.0",
    ),
    ("star", "num_bars=4, bar_width_range=[0.2, 0.5], bar_height_range=[0.1, 0.6], platform_width=1.5"),
    (
        "beams",
        "num_beams=3, beam_width_range=[0.15, 0.3], beam_height_range=[0.2, 0.8], platform_width=2.1, \
         border_width=0.5",
    ),
    (
        "hf_stepping_stones",
        "stone_height_max=0.04, stone_width_range=[0.3, 0.8], stone_distance_range=[0.1, 0.3], holes_depth=-0.7, \
         platform_width=1.5, border_width=0.5",
    ),
    (
        "repeated_boxes",
        "object_params_start={num_objects=8, height=0.1, size=[0.3, 0.5]}, \
         object_params_end={num_objects=16, height=0.3, size=[0.2, 0.4], max_yx_angle=20.0}, platform_width=1.5, \
         platform_height=0.0",
    ),
    (
        "repeated_cylinders",
        "object_params_start={num_objects=8, height=0.1, radius=0.2}, \
         object_params_end={num_objects=16, height=0.3, radius=0.3}, platform_width=1.5, platform_height=0.0",
    ),
    (
        "repeated_pyramids",
        "object_params_start={num_objects=8, height=0.1, radius=0.3}, \
         object_params_end={num_objects=16, height=0.3, radius=0.4}, platform_width=1.5, platform_height=0.0",
    ),
    (
        "hf_discrete_obstacles",
        "obstacle_width_range=[0.4, 1.0], obstacle_height_range=[0.1, 0.24], num_obstacles=30, platform_width=1.5",
    ),
    ("hf_wave", "amplitude_range=[0.05, 0.3], num_waves=2, platform_width=1.0"),
    (
        "pyramid_stairs",
        "step_height_range=[0.05, 0.2], step_width=0.3, platform_width=1.5, border_width=0.5, landing_every=3, \
         landing_width=0.8",
    ),
    (
        "pyramid_ramps",
        "slope_range=[0.1, 0.4], ramp_width=0.6, step_height_range=[0.05, 0.15], platform_width=1.5, border_width=0.5",
    ),
    (
        "heightfield",
        "levels=[[[0.1, 0.1], [0.1, 0.1]], [[0.0, 0.2], [0.2, 0.4]]], height_scale_range=[1.0, 2.0], \
         platform_width=0.0, border_width=0.5",
    ),
    (
        "mixture",
        "of=[{type=\"hf_pyramid_slope\", slope_range=[0.1, 0.3], platform_width=2.0, border_width=0.5}, \
         {type=\"random_rough\", noise_range=[-0.03, 0.03], noise_step=0.01, border_width=0.5}], platform_width=1.0",
    ),
];

fn entry(index: usize, kind: &str, numbers: &str) -> String {
    format!("{{name=\"{kind}_{index}\", type=\"{kind}\", proportion=1.0, {numbers}}}")
}

fn terrain(sub_terrains: &str, more: &[&str]) -> TerrainConfig {
    let mut overrides = vec![
        format!("scene.terrain.sub_terrains=[{sub_terrains}]"),
        "scene.terrain.num_rows=1".into(),
        "scene.terrain.num_cols=1".into(),
    ];
    overrides.extend(more.iter().map(|text| text.to_string()));
    Library::new(Vec::new()).task("velocity_rough", &overrides).unwrap().config.scene.terrain.unwrap()
}

/// One tile of 8 x 8 m about the origin.
struct Heights(HeightGrid);

impl Heights {
    fn of(config: &TerrainConfig) -> Self {
        let mut grid = HeightGrid::level([-4.0; 2], CELL, [321; 2], f32::MIN);
        generate(config)[0].mesh.rasterise([0.0; 2], &mut grid);
        assert!(grid.heights().iter().all(|height| *height > -50.0), "the tile has holes");
        Self(grid)
    }

    /// A type of [`TYPES`] at a difficulty.
    fn at(kind: &str, nth: usize, difficulty: f64) -> Self {
        let numbers = TYPES.iter().filter(|(other, _)| *other == kind).nth(nth).unwrap().1;
        Self::new(kind, numbers, difficulty)
    }

    fn new(kind: &str, numbers: &str, difficulty: f64) -> Self {
        let range = format!("scene.terrain.difficulty_range=[{difficulty}, {difficulty}]");
        Self::of(&terrain(&entry(0, kind, numbers), &[&range]))
    }

    fn point(&self, i: usize, j: usize) -> f32 {
        self.0.height(i, j)
    }

    fn height(&self, x: f32, y: f32) -> f32 {
        let index = |place: f32| ((place + 4.0) / CELL).round() as usize;
        self.point(index(x), index(y))
    }

    /// Runs of points of one height along y at `x`, between two places: height and length, m. The
    /// upper edges of walls are points of the upper height.
    fn runs(&self, x: f32, [from, to]: [f32; 2]) -> Vec<(f32, f32)> {
        let count = ((to - from) / CELL).round() as usize;
        let mut runs: Vec<(f32, usize)> = Vec::new();
        for k in 0..=count {
            let height = self.height(x, from + k as f32 * CELL);
            match runs.last_mut() {
                Some((other, points)) if (*other - height).abs() < 1e-5 => *points += 1,
                _ => runs.push((height, 1)),
            }
        }
        runs.into_iter().map(|(height, points)| (height, points as f32 * CELL)).collect()
    }

    fn assert_level(&self, half: f32, height: f32) {
        let reach = (half / CELL + 1e-3) as usize;
        for i in 160 - reach..=160 + reach {
            for j in 160 - reach..=160 + reach {
                assert!((self.point(i, j) - height).abs() < 1e-5, "{} at {i}, {j}, not {height}", self.point(i, j));
            }
        }
    }

    /// Pieces of the tile that are higher than `above`.
    fn pieces(&self, above: f32) -> Vec<f32> {
        let mut seen = vec![false; 321 * 321];
        let mut peaks = Vec::new();
        for start in 0..seen.len() {
            if seen[start] || self.point(start / 321, start % 321) <= above {
                continue;
            }
            let (mut stack, mut peak) = (vec![start], f32::MIN);
            seen[start] = true;
            while let Some(at) = stack.pop() {
                let (i, j) = (at / 321, at % 321);
                peak = peak.max(self.point(i, j));
                for (a, b) in [(i.wrapping_sub(1), j), (i + 1, j), (i, j.wrapping_sub(1)), (i, j + 1)] {
                    if a < 321 && b < 321 && !seen[a * 321 + b] && self.point(a, b) > above {
                        seen[a * 321 + b] = true;
                        stack.push(a * 321 + b);
                    }
                }
            }
            peaks.push(peak);
        }
        peaks
    }
}

#[track_caller]
fn assert_runs(found: &[(f32, f32)], expected: &[(f32, f32)]) {
    let is_same =
        |((h, l), (height, length)): (&(f32, f32), &(f32, f32))| (h - height).abs() < 1e-4 && (l - length).abs() < 1e-3;
    assert!(found.len() == expected.len() && found.iter().zip(expected).all(is_same), "{found:?}, not {expected:?}");
}

#[test]
fn gaps_pits_boxes_rails_and_rings_have_their_widths_and_heights() {
    // an upper edge has a point more than its width, the ground below one less
    let (up, low) = (CELL, -CELL);
    for (difficulty, width) in [(0.0, 0.1), (1.0, 0.6)] {
        let gap = Heights::at("gap", 0, difficulty);
        gap.assert_level(1.0, 0.0);
        assert_runs(&gap.runs(0.3, [0.0, 2.0]), &[(0.0, 1.0 + up), (-0.8, width + low), (0.0, 1.0 - width + up)]);
        assert_runs(&gap.runs(-0.3, [-2.0, 0.0]), &[(0.0, 1.0 - width + up), (-0.8, width + low), (0.0, 1.0 + up)]);
        // closed around the corner
        assert_eq!(gap.height(1.0 + CELL, 1.0 + CELL), -0.8);
    }
    for (difficulty, depth) in [(0.0, 0.1), (1.0, 0.4)] {
        Heights::at("pit", 0, difficulty).assert_level(1.0 - CELL, -depth);
        Heights::at("box", 0, difficulty).assert_level(1.0, depth);
        let pit = Heights::at("pit", 0, difficulty);
        assert_runs(&pit.runs(0.0, [0.0, 3.0]), &[(-depth, 1.0), (0.0, 2.0 + up)]);
    }
    for (difficulty, step) in [(0.0, 0.1), (1.0, 0.3)] {
        let pit = Heights::at("pit", 1, difficulty);
        assert_runs(&pit.runs(0.0, [0.0, 3.0]), &[(-2.0 * step, 1.0), (-step, 0.5), (0.0, 1.5 + up)]);
        let high = Heights::at("box", 1, difficulty);
        assert_runs(&high.runs(0.0, [0.0, 3.0]), &[(2.0 * step, 1.0 + up), (step, 0.5), (0.0, 1.5)]);
    }
    for (difficulty, top) in [(0.0, 0.05), (1.0, 0.25)] {
        let rails = Heights::at("rails", 0, difficulty);
        rails.assert_level(0.9, 0.0);
        let expected = [(0.0, 1.0), (top, 0.1 + up), (0.0, 1.7 + low), (top, 0.2 + up), (0.0, 1.0)];
        assert_runs(&rails.runs(0.0, [0.0, 4.0]), &expected);
    }
    for (difficulty, width, top) in [(0.0, 0.2, 0.1), (1.0, 0.4, 0.25)] {
        let ring = Heights::at("floating_ring", 0, difficulty);
        let expected = [(0.0, 1.0), (top, width + up), (0.0, 3.0 - width)];
        assert_runs(&ring.runs(0.5, [0.0, 4.0]), &expected);
    }
}

#[test]
fn stars_and_beams_have_their_bars() {
    for (difficulty, width, depth) in [(0.0, 0.5, 0.1), (1.0, 0.2, 0.6)] {
        let star = Heights::at("star", 0, difficulty);
        star.assert_level(0.75, 0.0);
        // around the middle, beyond the platform
        let around: Vec<bool> = (0..4000)
            .map(|k| {
                let angle = std::f32::consts::TAU * k as f32 / 4000.0;
                star.0.sample(2.5 * angle.cos(), 2.5 * angle.sin()).0 > -0.01
            })
            .collect();
        let arms = (0..4000).filter(|k| around[*k] && !around[(k + 1) % 4000]).count();
        assert_eq!(arms, 8, "a bar is two arms");
        let share = around.iter().filter(|is_bar| **is_bar).count() as f32 / 4000.0;
        // a wall is a slope within a cell
        assert!((share * std::f32::consts::TAU * 2.5 / 8.0 - width).abs() < 2.0 * CELL, "{share} of {width} m");
        assert!((star.height(2.5, 1.2) + depth).abs() < 1e-5, "the hole");
        assert_eq!(star.height(3.9, 1.2), 0.0, "the edge");
    }
    for (difficulty, width, depth) in [(0.0, 0.3, 0.2), (1.0, 0.15, 0.8)] {
        let beams = Heights::at("beams", 0, difficulty);
        beams.assert_level(1.05, 0.0);
        let runs = beams.runs(2.0, [-1.4, 1.4]);
        let tops: Vec<&(f32, f32)> = runs.iter().filter(|(height, _)| *height == 0.0).collect();
        assert_eq!(tops.len(), 3, "{runs:?}");
        for (_, length) in tops {
            assert!((length - width - CELL).abs() < 1e-3, "a beam of {length} m, not {width}");
        }
        assert!(runs.iter().all(|(height, _)| *height == 0.0 || (*height + depth).abs() < 1e-5), "{runs:?}");
        // on all four sides they reach the edge
        for [x, y] in [[3.45, 0.0], [-3.45, 0.0], [0.0, 3.45], [0.0, -3.45], [1.1, 0.0]] {
            assert_eq!(beams.height(x, y), 0.0, "at {x}, {y}");
        }
    }
}

#[test]
fn stepping_stones_have_their_widths_and_distances() {
    for (difficulty, width, distance) in [(0.0, 0.8, 0.1), (1.0, 0.3, 0.3)] {
        let stones = Heights::at("hf_stepping_stones", 0, difficulty);
        stones.assert_level(0.75, 0.0);
        // the first row of stones
        let runs = stones.runs(-3.4, [-3.5 + CELL, 3.5 - CELL]);
        let holes: Vec<f32> = runs.iter().filter(|(height, _)| *height < -0.5).map(|(_, length)| *length).collect();
        let whole = &runs[1..runs.len() - 1];
        assert!(holes.len() >= 7, "{runs:?}");
        for (height, length) in whole {
            let expected = if *height < -0.5 { distance - CELL } else { width + CELL };
            assert!((length - expected).abs() < 1e-3, "{length} m at {height}, not {expected}");
            assert!((height + 0.7).abs() < 1e-5 || height.abs() <= 0.04, "{height}");
        }
        let heights: Vec<f32> = stones.pieces(-0.5);
        assert!(heights.iter().any(|height| *height > 0.01) && heights.iter().all(|height| *height <= 0.04));
        // the rows lie as far apart as the stones of a row
        assert_eq!(stones.height(-3.5 + width + CELL, 0.0), -0.7);
        let is_stone = |x: f32| stones.runs(x, [-3.4, 3.4]).iter().any(|(height, _)| *height > -0.5);
        assert!(is_stone(-3.5 + width + distance) && !is_stone(-3.5 + width + distance - CELL));
    }
}

#[test]
fn scattered_objects_are_as_many_and_as_high_as_they_should_be() {
    for kind in ["repeated_boxes", "repeated_cylinders", "repeated_pyramids"] {
        for (difficulty, count, top) in [(0.0, 8, 0.1), (1.0, 16, 0.3)] {
            let ground = Heights::at(kind, 0, difficulty);
            ground.assert_level(0.75, 0.0);
            let peaks = ground.pieces(0.02);
            // some touch each other
            assert!(peaks.len() <= count && peaks.len() * 2 >= count, "{kind}: {} pieces of {count}", peaks.len());
            // the grid misses the peak of a pyramid by less than a cell, a box may lean
            let least = if kind == "repeated_cylinders" { top } else { 0.85 * top };
            for peak in &peaks {
                assert!((least - 1e-5..1.4 * top).contains(peak), "{kind}: {peak} m, not {top}");
            }
        }
    }
    // noise, and a platform as high as the objects
    let numbers = "object_params_start={num_objects=30, height=0.2, radius=0.1}, \
        object_params_end={num_objects=30, height=0.2, radius=0.1}, platform_width=1.5, \
        rel_height_noise=[0.5, 1.5], abs_height_noise=[-0.05, 0.0]";
    let ground = Heights::new("repeated_cylinders", numbers, 0.5);
    ground.assert_level(0.75, 0.2);
    let peaks = ground.pieces(0.01);
    let most = peaks.iter().copied().fold(f32::MIN, f32::max);
    assert!((0.22..=0.3).contains(&most) && peaks.iter().any(|peak| *peak < 0.12), "{peaks:?}");
}

#[test]
fn obstacles_and_waves_have_their_heights() {
    for (difficulty, top) in [(0.0, 0.1), (1.0, 0.24)] {
        let ground = Heights::at("hf_discrete_obstacles", 0, difficulty);
        ground.assert_level(0.7, 0.0);
        let (mut counts, mut between) = ([0; 5], 0);
        // vertices of the height field
        for k in 0..81 * 81 {
            let height = ground.point(k / 81 * 4, k % 81 * 4);
            let halves = height / (0.5 * top);
            if (halves - halves.round()).abs() < 0.06 {
                counts[(halves.round() + 2.0) as usize] += 1;
            } else {
                between += 1;
            }
        }
        // where the foot of a wall has moved at a corner, the surface lies in between
        assert!(between * 50 < 81 * 81, "{between} heights are none of 0, +-{top} and +-{}", 0.5 * top);
        assert!(counts.iter().all(|count| *count > 20), "{counts:?}");
        let fixed = "obstacle_height_mode=\"fixed\", obstacle_width_range=[0.5, 0.5], \
            obstacle_height_range=[0.1, 0.24], num_obstacles=3, platform_width=1.5";
        let peaks = Heights::new("hf_discrete_obstacles", fixed, difficulty).pieces(0.01);
        assert!(!peaks.is_empty() && peaks.len() <= 3 && peaks.iter().all(|peak| (peak - top).abs() < VERTICAL));
    }
    for (difficulty, amplitude) in [(0.0, 0.05), (1.0, 0.3)] {
        let wave = Heights::at("hf_wave", 0, difficulty);
        let all = wave.0.heights();
        let (low, high) = all.iter().fold((f32::MAX, f32::MIN), |(low, high), z| (low.min(*z), high.max(*z)));
        assert!((high - amplitude).abs() < 2.0 * VERTICAL && (low + amplitude).abs() < 2.0 * VERTICAL, "{low}, {high}");
        // along x at the edge in y, where the sine is zero: two whole waves
        let along: Vec<f32> = (0..=320).map(|i| wave.point(i, 0)).collect();
        let falls = (1..=320).filter(|i| along[i - 1] > 0.0 && along[*i] <= 0.0).count();
        assert_eq!(falls, 2);
        assert!((along[0] - 0.5 * amplitude).abs() < VERTICAL && (along[160] - 0.5 * amplitude).abs() < 0.1);
        wave.assert_level(0.4, wave.height(0.0, 0.0));
    }
}

#[test]
fn stairs_have_landings_and_open_risers() {
    for (difficulty, step) in [(0.0, 0.05), (1.0, 0.2)] {
        let stairs = Heights::at("pyramid_stairs", 0, difficulty);
        // from the edge inwards: two steps, a landing, two steps, the platform
        let mut expected = vec![(0.0, 0.5)];
        expected.extend([(step, 0.3), (2.0 * step, 0.3), (3.0 * step, 0.8)]);
        expected.extend([(4.0 * step, 0.3), (5.0 * step, 0.3), (6.0 * step, 1.5 + CELL)]);
        assert_runs(&stairs.runs(0.0, [-4.0, 0.0]), &expected);
        stairs.assert_level(1.5, 6.0 * step);
        let numbers =
            "step_height_range=[0.05, 0.2], step_width=0.5, platform_width=3.9, border_width=0.5, riser_gap=0.1";
        let up = Heights::new("pyramid_stairs", numbers, difficulty).runs(0.0, [-4.0, 0.0]);
        let (tread, opening) = (0.4 + CELL, 0.1 - CELL);
        let flight = |k: f32| [(k * step, tread), (0.0, opening)];
        let mut expected = vec![(0.0, 0.5)];
        expected.extend([flight(1.0), flight(2.0), flight(3.0)].into_iter().flatten());
        expected.push((4.0 * step, 2.0 + CELL));
        assert_runs(&up, &expected);
        let down = Heights::new("pyramid_stairs_inv", numbers, difficulty).runs(0.0, [-4.0, 0.0]);
        let flight = |k: f32| [(-4.0 * step, opening), (-k * step, tread)];
        let mut expected = vec![(0.0, 0.5 + CELL)];
        expected.extend([flight(1.0), flight(2.0), flight(3.0)].into_iter().flatten());
        expected.push((-4.0 * step, 2.0));
        assert_runs(&down, &expected);
    }
}

#[test]
fn ramps_rise_between_steps() {
    for (kind, sign) in [("pyramid_ramps", 1.0), ("pyramid_ramps_inv", -1.0)] {
        let numbers = TYPES.iter().find(|(kind, _)| *kind == "pyramid_ramps").unwrap().1;
        for (difficulty, slope, step) in [(0.0, 0.1, 0.05), (1.0, 0.4, 0.15)] {
            let ramps = Heights::new(kind, numbers, difficulty);
            let mut foot = 0.0;
            for ring in 0..4 {
                for (along, rise) in [(0.1, 0.1 * slope), (0.5, 0.5 * slope)] {
                    let expected = sign * (foot + step + rise);
                    // on the four sides, and on a corner
                    let from = 3.5 - 0.6 * ring as f32 - along;
                    for [x, y] in [[from, 0.2], [-from, 0.2], [0.2, from], [0.2, -from], [from, from]] {
                        let found = ramps.height(x, y);
                        assert!((found - expected).abs() < 1e-4, "{kind}, ring {ring}: {found}, not {expected}");
                    }
                }
                foot += step + 0.6 * slope;
            }
            ramps.assert_level(1.0, sign * (foot + step));
        }
    }
}

#[test]
fn tables_of_the_users_own_have_levels_and_mixtures_add_heights() {
    for (difficulty, corners) in [(0.0, [0.1; 4]), (0.4, [0.14; 4]), (1.0, [0.0, 0.4, 0.4, 0.8])] {
        let ground = Heights::at("heightfield", 0, difficulty);
        for ([x, y], height) in [[-3.5, -3.5], [-3.5, 3.5], [3.5, -3.5], [3.5, 3.5]].into_iter().zip(corners) {
            assert!((ground.height(x, y) - height).abs() < 1e-4, "{difficulty}: {} not {height}", ground.height(x, y));
        }
        let middle = 0.5 * (corners[0] + corners[3]);
        assert!((ground.height(0.0, 0.0) - middle).abs() < 1e-4);
        assert_eq!(ground.height(3.9, 1.0), 0.0);
    }
    let numbers = "levels=[[[0.0, 0.3, 0.0], [0.3, 0.9, 0.3], [0.0, 0.3, 0.0]]], platform_width=9.0";
    let text = entry(0, "heightfield", numbers);
    let overrides = [format!("scene.terrain.sub_terrains=[{text}]")];
    let error = Library::new(Vec::new()).task("velocity_rough", &overrides).unwrap_err().to_string();
    assert!(error.contains("sub_terrains[0]") && error.contains("wider than the tile"), "{error}");
    let level = Heights::new("heightfield", &numbers.replace("9.0", "1.0"), 0.0);
    assert!((level.height(0.0, 0.0) - 0.9).abs() < 1e-5);

    // a slope and stairs: on the vertices the heights are added
    let slope = "slope_range=[0.1, 0.3], platform_width=2.0, border_width=0.5";
    let boxed = "box_height_range=[0.1, 0.2], platform_width=2.0";
    let both = format!("of=[{{type=\"hf_pyramid_slope\", {slope}}}, {{type=\"box\", {boxed}}}]");
    for difficulty in [0.0, 1.0] {
        let (a, b) = (Heights::new("hf_pyramid_slope", slope, difficulty), Heights::new("box", boxed, difficulty));
        let sum = Heights::new("mixture", &both, difficulty);
        let mut raised = 0;
        for (i, j) in (1..80).flat_map(|i| (1..80).map(move |j| (4 * i, 4 * j))) {
            // the foot of a wall moves, and takes the heights around it along
            let around = [(i - 4, j), (i + 4, j), (i, j - 4), (i, j + 4)];
            if around.iter().any(|(a, c)| b.point(*a, *c) != b.point(i, j)) {
                continue;
            }
            let expected = a.point(i, j) + b.point(i, j);
            assert!((sum.point(i, j) - expected).abs() < 0.6 * VERTICAL, "{} not {expected}", sum.point(i, j));
            raised += usize::from(b.point(i, j) > 0.05 && a.point(i, j) > 0.05);
        }
        assert!(raised > 250, "{raised}");
    }
    let level = Heights::at("mixture", 0, 1.0);
    level.assert_level(0.45, level.height(0.0, 0.0));
}

#[test]
fn numbers_that_make_no_tile_are_refused() {
    let cases = [
        ("gap", "gap_width_range=[0.1, 3.0], platform_width=2.0", "wider than the tile"),
        (
            "pyramid_stairs",
            "step_height_range=[0.1, 0.2], step_width=0.3, platform_width=1.0, border_width=0.5, landing_every=2",
            "landing",
        ),
        (
            "pyramid_stairs",
            "step_height_range=[0.1, 0.2], step_width=0.3, platform_width=1.0, border_width=0.5, riser_gap=0.3",
            "riser_gap",
        ),
        ("heightfield", "levels=[[[0.0, 1.0], [0.0]]]", "rows of equal length"),
        ("heightfield", "levels=[]", "levels"),
        ("mixture", "of=[{type=\"flat\"}]", "fewer than two"),
        (
            "repeated_boxes",
            "object_params_start={num_objects=1, height=0.1, size=[3.0, 3.0]}, object_params_end={num_objects=1, height=0.1, size=[0.1, 0.1]}, platform_width=2.0",
            "wider than the tile",
        ),
        (
            "repeated_cylinders",
            "object_params_start={num_objects=1, height=0.1, radius=0.1, max_yx_angle=70.0}, object_params_end={num_objects=1, height=0.1, radius=0.1}, platform_width=2.0",
            "60 degrees",
        ),
        (
            "hf_stepping_stones",
            "stone_height_max=0.1, stone_width_range=[0.3, 0.5], stone_distance_range=[0.1, 0.2], holes_depth=0.1, platform_width=1.0",
            "holes_depth",
        ),
        (
            "star",
            "num_bars=0, bar_width_range=[0.1, 0.2], bar_height_range=[0.1, 0.2], platform_width=1.0",
            "0 is too few",
        ),
    ];
    for (kind, numbers, word) in cases {
        let overrides = [format!("scene.terrain.sub_terrains=[{}]", entry(0, kind, numbers))];
        let error = Library::new(Vec::new()).task("velocity_rough", &overrides).unwrap_err().to_string();
        assert!(error.contains(word) && error.contains("sub_terrains"), "{kind}: {error}");
    }
    let text = entry(0, TYPES[0].0, TYPES[0].1);
    let overrides = [format!("scene.terrain.sub_terrains=[{text}]"), "scene.grid_cell=0.02".into()];
    let error = Library::new(Vec::new()).task("velocity_rough", &overrides).unwrap_err().to_string();
    assert!(error.contains("scene.terrain.edge_step") && error.contains("multiple of scene.grid_cell"), "{error}");
}

/// All types side by side at two levels, the easiest and the hardest.
fn all_types() -> Vec<String> {
    let entries: Vec<String> = TYPES.iter().enumerate().map(|(k, (kind, numbers))| entry(k, kind, numbers)).collect();
    vec![
        format!("scene.terrain.sub_terrains=[{}]", entries.join(", ")),
        "scene.terrain.num_rows=2".into(),
        format!("scene.terrain.num_cols={}", TYPES.len()),
        "scene.terrain.border_width=2.0".into(),
        "scene.terrain.max_init_terrain_level=1".into(),
    ]
}

fn play(num_envs: usize, more: &[&str]) -> SimOptions {
    let mut overrides = all_types();
    overrides.extend(more.iter().map(|text| text.to_string()));
    SimOptions {
        overrides,
        robots: Some(vec!["unitree_go2".into()]),
        ..SimOptions::new("velocity_rough_play", num_envs)
    }
}

#[test]
fn the_grid_is_what_rays_see_on_the_new_tiles() {
    let mut sim = Sim::new(&play(1, &[])).unwrap();
    let ground = sim.world().resource::<Ground>();
    let (heights, layout) = (ground.terrain.as_ref().unwrap().clone(), ground.layout.clone().unwrap());
    let mut rng = EnvRng::new(3, 0);
    let mut rays: SystemState<SpatialQuery> = SystemState::new(sim.world_mut());
    let query = rays.get(sim.world()).unwrap();
    let height = |x: f32, y: f32| below(&query, [x, y], &SpatialQueryFilter::default()).unwrap().1;
    for (column, (kind, _)) in TYPES.iter().enumerate() {
        let (mut compared, mut worst) = (0, 0.0f32);
        for k in 0..300 {
            let origin = layout.origin(k % 2, column as u32);
            let [x, y] = origin.map(|middle| middle + rng.uniform([-4.0, 4.0]));
            let pitch = 0.25 * heights.cell;
            // objects at any angle have edges between the points of the grid
            let is_field =
                kind.starts_with("hf_d") || ["hf_wave", "mixture", "heightfield", "pyramid_ramps"].contains(kind);
            if common::near_a_step(&height, [x, y], pitch, if is_field { pitch } else { 1e-4 }) {
                continue;
            }
            compared += 1;
            worst = worst.max((heights.sample(x, y).0 - height(x, y)).abs());
        }
        println!("{kind}: {compared} places, worst {:.4} mm", 1e3 * worst);
        assert!(compared > 60, "{kind}: {compared} places were compared");
        let bound = if kind.starts_with("repeated") || *kind == "pyramid_ramps" { 2e-3 } else { 2e-4 };
        assert!(worst < bound, "{kind}: grid and rays differ by {worst} m");
    }
}

#[test]
fn robots_stand_where_episodes_begin_on_both_engines() {
    for engine in ["articulated", "avian"] {
        let envs = TYPES.len();
        let mut sim = Sim::new(&play(
            envs,
            &[
                &format!("physics.engine={engine}"),
                "events.reset_base.x=[0.0, 0.0]",
                "events.reset_base.y=[0.0, 0.0]",
                "scene.terrain.num_rows=1",
                "scene.terrain.max_init_terrain_level=0",
                "scene.terrain.difficulty_range=[0.9, 0.9]",
            ],
        ))
        .unwrap();
        let actions = vec![0.0; sim.batch().actions.len()];
        for t in 0..30 {
            sim.step(&actions).unwrap();
            let fallen: Vec<usize> = (0..envs).filter(|env| sim.batch().terminated[*env]).collect();
            let layout = sim.world().resource::<Ground>().layout.clone().unwrap();
            let world = sim.world_mut();
            let places: Vec<&str> = world
                .query::<(&EnvId, &EnvOrigin)>()
                .iter(world)
                .filter(|(env, _)| fallen.contains(&(env.0 as usize)))
                .map(|(_, origin)| TYPES[layout.column_types[origin.terrain_column as usize]].0)
                .collect();
            assert!(fallen.is_empty(), "{engine}: robots fell in step {t} on {places:?}");
        }
    }
}

#[test]
fn threads_and_instruction_sets_keep_every_bit_on_the_new_tiles() {
    let short = ["sim.episode_length_s=0.5"];
    let make = |threads, simd| {
        let options = SimOptions { threads: Some(threads), simd: Some(simd), seed: 5, ..play(2 * TYPES.len(), &short) };
        Sim::new(&options).unwrap()
    };
    let mut reference = make(1, Simd::Portable);
    let mut others: Vec<Sim> = Simd::available().into_iter().map(|simd| make(2, simd)).collect();
    for t in 0..common::size(40, 400) {
        step(&mut reference, t);
        for sim in &mut others {
            step(sim, t);
            let name = sim.simd().name();
            assert_all_same(&mut reference, sim, &format!("step {t}, {name}"));
        }
    }
}

#[test]
fn tiles_may_be_scaled_by_the_leg_length() {
    let stairs = "{name=\"s\", type=\"pyramid_stairs\", proportion=1.0, step_height_range=[0.1, 0.2], step_width=0.3, \
        platform_width=3.0, border_width=1.0}, {name=\"g\", type=\"gap\", proportion=1.0, \
        gap_width_range=[0.2, 0.6], platform_width=2.0}";
    let config = |more: &[&str]| {
        let mut all = vec!["scene.terrain.num_rows=2", "scene.terrain.num_cols=2"];
        all.extend(more);
        terrain(stairs, &all)
    };
    let scaled = config(&["scene.terrain.scale_by=leg_length", "scene.terrain.reference_leg_length=0.4"]);
    // two robots of one scale, one of another
    let layout = TerrainLayout::for_robots(&scaled, &[0.41, 0.2, 0.39]);
    assert_eq!((layout.num_cols, layout.cols_per_scale), (4, 2));
    assert_eq!(layout.scale_of_robot, [1, 0, 1]);
    assert!(layout.scales.iter().zip([0.5, 1.0]).all(|(a, b)| (a - b).abs() < 1e-9), "{:?}", layout.scales);
    assert_eq!([0, 1, 2].map(|robot| layout.first_column(robot)), [2, 0, 2]);
    let tiles = generate_in(&scaled, &layout);
    let unscaled = generate(&config(&[]));
    for (k, tile) in unscaled.iter().enumerate() {
        let [half, whole] = [0, 2].map(|group| &tiles[k / 2 * 4 + k % 2 + group].mesh);
        assert!(*whole == tile.mesh, "a scale of 1 changes nothing");
        let heights =
            |mesh: &polypod::terrain::Mesh| mesh.vertices.iter().map(|v| v[2]).fold(0.0f32, |m, z| m.max(z.abs()));
        assert!((heights(half) - 0.5 * heights(whole)).abs() < 1e-6, "{} {}", heights(half), heights(whole));
    }
    // robots with long legs may keep the numbers of the config
    let limited = config(&[
        "scene.terrain.scale_by=leg_length",
        "scene.terrain.reference_leg_length=0.4",
        "scene.terrain.max_scale=0.8",
    ]);
    let layout = TerrainLayout::for_robots(&limited, &[0.9, 0.2, 0.36]);
    assert_eq!(layout.scale_of_robot, [1, 0, 1]);
    assert!(layout.scales.iter().zip([0.5, 0.8]).all(|(a, b)| (a - b).abs() < 1e-9), "{:?}", layout.scales);
    // without robots or without the key all columns are shared
    assert_eq!(TerrainLayout::new(&scaled).num_cols, 2);
    assert_eq!(TerrainLayout::for_robots(&config(&[]), &[0.2, 0.4]).num_cols, 2);

    let options = SimOptions {
        overrides: vec![
            format!("scene.terrain.sub_terrains=[{stairs}]"),
            "scene.terrain.num_rows=2".into(),
            "scene.terrain.num_cols=2".into(),
            "scene.terrain.scale_by=leg_length".into(),
        ],
        robots: Some(vec!["unitree_a1".into(), "anymal_d".into()]),
        ..SimOptions::new("velocity_rough_play", 8)
    };
    let mut sim = Sim::new(&options).unwrap();
    let layout = sim.world().resource::<Ground>().layout.clone().unwrap();
    assert_eq!(layout.scales.len(), 2, "{:?}", layout.scales);
    let legs: Vec<f64> = sim.morphologies().iter().map(|morphology| morphology.leg_length()).collect();
    let world = sim.world_mut();
    for (env, origin) in world.query::<(&EnvId, &EnvOrigin)>().iter(world) {
        let robot = usize::from(env.0 >= 4);
        let scale = layout.scale(origin.terrain_column);
        assert!((scale - legs[robot] / 0.5).abs() <= 0.051, "{scale} of legs of {} m", legs[robot]);
    }
    let snapshot = sim.snapshot().unwrap();
    Sim::new(&options).unwrap().restore(&snapshot).unwrap();
}

#[test]
fn every_shape_is_in_the_list_of_this_test() {
    // a new shape needs its promises
    let known = |shape: &SubTerrainShape| match shape {
        SubTerrainShape::Flat {}
        | SubTerrainShape::PyramidStairsInv(_)
        | SubTerrainShape::PyramidRampsInv(_)
        | SubTerrainShape::Boxes(_)
        | SubTerrainShape::RandomRough(_)
        | SubTerrainShape::HfPyramidSlope(_)
        | SubTerrainShape::HfPyramidSlopeInv(_) => false,
        SubTerrainShape::PyramidStairs(_)
        | SubTerrainShape::PyramidRamps(_)
        | SubTerrainShape::Box(_)
        | SubTerrainShape::Pit(_)
        | SubTerrainShape::Gap(_)
        | SubTerrainShape::Rails(_)
        | SubTerrainShape::FloatingRing(_)
        | SubTerrainShape::Star(_)
        | SubTerrainShape::Beams(_)
        | SubTerrainShape::RepeatedBoxes(_)
        | SubTerrainShape::RepeatedPyramids(_)
        | SubTerrainShape::RepeatedCylinders(_)
        | SubTerrainShape::HfDiscreteObstacles(_)
        | SubTerrainShape::HfWave(_)
        | SubTerrainShape::HfSteppingStones(_)
        | SubTerrainShape::Heightfield(_)
        | SubTerrainShape::Mixture(_) => true,
    };
    let config = terrain(all_types()[0]["scene.terrain.sub_terrains=[".len()..].trim_end_matches(']'), &[]);
    assert_eq!(config.sub_terrains.iter().filter(|sub| known(&sub.shape)).count(), TYPES.len());
}
