//! Generated terrain: its figures, the grid that the articulated engine stands on, and what robots
//! meet of it.

use avian3d::prelude::{SpatialQuery, SpatialQueryFilter};
use bevy_ecs::system::SystemState;
use polypod::components::{BasePose, BaseVelocity, EnvId, EnvOrigin, EnvRng, Episode, Feet, HeightScan};
use polypod::config::{Library, SubTerrainShape, TerrainConfig};
use polypod::dynamics::HeightGrid;
use polypod::terrain::{TerrainLayout, generate};
use polypod::world::{Ground, below};
use polypod::{Sim, SimOptions};

use crate::common;

fn config() -> TerrainConfig {
    Library::new(Vec::new()).task("velocity_rough", &[]).unwrap().config.scene.terrain.unwrap()
}

/// The task for watching, with the full terrain.
fn rough(num_envs: usize) -> Sim {
    let overrides =
        ["scene.terrain.num_rows=10", "scene.terrain.num_cols=20", "scene.terrain.max_init_terrain_level=9"];
    let options = SimOptions {
        overrides: overrides.map(String::from).to_vec(),
        ..SimOptions::new("velocity_rough_play", num_envs)
    };
    Sim::new(&options).unwrap()
}

fn grid(sim: &Sim) -> &HeightGrid {
    sim.world().resource::<Ground>().terrain.as_ref().unwrap()
}

fn by_env<T: Copy + bevy_ecs::component::Component>(sim: &mut Sim) -> Vec<T> {
    let world = sim.world_mut();
    let mut all: Vec<_> = world.query::<(&EnvId, &T)>().iter(world).map(|(env, x)| (*env, *x)).collect();
    all.sort_by_key(|(env, _)| *env);
    all.into_iter().map(|(_, x)| x).collect()
}

#[test]
fn the_grid_is_what_rays_see_on_every_type_of_tile() {
    let mut sim = rough(8);
    let layout = TerrainLayout::new(&config());
    let heights = grid(&sim).clone();
    let mut rng = EnvRng::new(3, 0);
    let mut rays: SystemState<SpatialQuery> = SystemState::new(sim.world_mut());
    let query = rays.get(sim.world()).unwrap();
    let height = |x: f32, y: f32| below(&query, [x, y], &SpatialQueryFilter::default()).unwrap().1;
    for (kind, name) in layout.type_names.iter().enumerate() {
        let (mut compared, mut lowest, mut highest, mut worst) = (0, 0.0f32, 0.0f32, 0.0f32);
        for column in (0..layout.num_cols).filter(|&c| layout.column_types[c as usize] == kind) {
            for k in 0..150 {
                let origin = layout.origin(k % layout.num_rows, column);
                let [x, y] = origin.map(|middle| middle + rng.uniform([-4.0, 4.0]));
                let seen = height(x, y);
                // within a cell and a half, what is steeper than 45 degrees is a wall, and any step
                // of a surface that is level
                let pitch = 0.25 * heights.cell;
                let step = if name.starts_with("hf_") || name == "random_rough" { pitch } else { 1e-4 };
                if common::near_a_step(&height, [x, y], pitch, step) {
                    continue;
                }
                compared += 1;
                (lowest, highest) = (lowest.min(seen), highest.max(seen));
                worst = worst.max((heights.sample(x, y).0 - seen).abs());
            }
        }
        println!("{name}: {compared} places from {lowest:.3} to {highest:.3} m, worst {:.4} mm", 1e3 * worst);
        assert!(compared > 100 && highest - lowest > 0.04, "{name}: too little was compared");
        assert!(worst < 1e-4, "{name}: grid and rays differ by {worst} m");
    }
}

#[test]
fn tiles_have_the_figures_of_the_task() {
    let config = config();
    let layout = TerrainLayout::new(&config);
    assert_eq!(layout.column_types, [0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4, 5, 5]);
    assert_eq!(layout.origin(0, 0), [-36.0, -76.0]);
    assert_eq!(layout.origin(9, 19), [36.0, 76.0]);
    let sim = rough(8);
    let heights = grid(&sim);
    let at = |origin: [f32; 2], x: f32, y: f32| heights.sample(origin[0] + x, origin[1] + y).0;
    for tile in generate(&config) {
        let (o, row) = (tile.origin, tile.row as f32);
        // difficulty lies within the row's tenth
        let within = |x: f32, low: f32, high: f32, what: &str| {
            assert!(x > low - 1e-4 && x < high + 1e-4, "{what} {x} of row {row} is not from {low} to {high}");
        };
        let range = |[low, high]: [f64; 2], share: f32| (low + (high - low) * f64::from(share)) as f32;
        let (easy, hard) = (row / 10.0, (row + 1.0) / 10.0);
        match &config.sub_terrains[layout.column_types[tile.column as usize]].shape {
            SubTerrainShape::PyramidStairs(c) | SubTerrainShape::PyramidStairsInv(c) => {
                let sign = at(o, 0.0, 0.0).signum();
                let step = sign * at(o, 0.0, 0.0) / 7.0;
                within(step, range(c.step_height_range, easy), range(c.step_height_range, hard), "step");
                // the middle of each ring, on all four sides, and the flat edge of the tile
                for k in 0..6 {
                    let along = 3.0 - 0.3 * (k as f32 + 0.5);
                    for [x, y] in [[along, 0.4], [-along, 0.4], [0.4, along], [0.4, -along]] {
                        let expected = sign * step * (k + 1) as f32;
                        assert!((at(o, x, y) - expected).abs() < 1e-4, "ring {k}: {} not {expected}", at(o, x, y));
                    }
                }
                assert_eq!(at(o, 3.5, -1.0), 0.0);
                assert!((at(o, 1.15, 1.15) - at(o, 0.0, 0.0)).abs() < 1e-4, "the platform is 2.4 m wide");
            }
            SubTerrainShape::Boxes(c) => {
                let amplitude = at(o, 0.0, 0.0);
                within(amplitude, range(c.grid_height_range, easy), range(c.grid_height_range, hard), "amplitude");
                assert!((at(o, 0.95, -0.95) - amplitude).abs() < 1e-5, "the platform is 2 m wide");
                let cell = |i: usize, j: usize| at(o, -3.6 + 0.45 * i as f32, -3.6 + 0.45 * j as f32);
                let all: Vec<f32> = (0..289).map(|k| cell(k / 17, k % 17)).collect();
                assert!(all.iter().all(|h| h.abs() <= amplitude + 1e-5));
                let spread = all.iter().fold(0.0f32, |most, h| most.max(-h));
                assert!(spread > 0.9 * amplitude, "289 uniform draws come near the lowest height");
                assert_eq!(at(o, 3.95, 1.0), 0.0);
            }
            SubTerrainShape::RandomRough(_) => {
                let vertex = |i: i32, j: i32| at(o, 0.1 * i as f32, 0.1 * j as f32);
                let mut counts = [0; 7];
                for (i, j) in (-37..=37).flat_map(|i| (-37..=37).map(move |j| (i, j))) {
                    let steps = vertex(i, j) / 0.01;
                    assert!((steps - steps.round()).abs() < 0.02, "{} is no multiple of 1 cm", vertex(i, j));
                    counts[steps.round() as usize] += 1;
                }
                assert_eq!(counts[0], 0);
                // 5625 draws of six values: 4.5 standard deviations are 126, and there are 240 such
                // counts
                assert!(counts[1..].iter().all(|&n| i32::abs(n - 937) < 126), "{counts:?}");
                assert!(vertex(38, 0) < 1e-5, "the edge is flat");
            }
            SubTerrainShape::HfPyramidSlope(c) | SubTerrainShape::HfPyramidSlopeInv(c) => {
                let sign = if at(o, 0.0, 0.0) < 0.0 { -1.0 } else { 1.0 };
                // along the middle of a side the profile is straight but for the vertical scale
                let slope = sign * (at(o, 2.5, 0.0) - at(o, 3.5, 0.0));
                within(slope, range(c.slope_range, easy) - 0.02, range(c.slope_range, hard) + 0.02, "slope");
                let top = at(o, 0.0, 0.0);
                assert!((at(o, 0.9, 0.0) - top).abs() < 1e-5 && (at(o, 0.0, -0.9) - top).abs() < 1e-5);
            }
            shape => unreachable!("the task has no tile {shape:?}"),
        }
    }
}

#[test]
fn steep_faces_become_vertical() {
    // two heights 0.1 m apart on vertices 0.1 m apart: every step is steeper than 0.75
    let mut rough = config();
    rough.num_rows = 1;
    rough.sub_terrains.retain(|sub| sub.name == "random_rough");
    let SubTerrainShape::RandomRough(shape) = &mut rough.sub_terrains[0].shape else { unreachable!() };
    (shape.noise_range, shape.noise_step) = ([0.0, 0.1], 0.1);
    let mesh = generate(&rough).swap_remove(0).mesh;
    let mut gentle = rough.clone();
    gentle.slope_threshold = 1e6;
    let even = generate(&gentle).swap_remove(0).mesh;
    let (mut vertical, mut between) = (0, 0);
    // a low vertex between its neighbours along x, 81 vertices a row
    for k in (5..75).flat_map(|i| (5..75).map(move |j| i * 81 + j)).filter(|&k| even.vertices[k][2] < 0.05) {
        let is_higher = [k - 81, k + 81].map(|other| even.vertices[other][2] > 0.05);
        let moved = mesh.vertices[k][0] - even.vertices[k][0];
        match is_higher {
            // its foot comes under the edge of the higher neighbour, which stays
            [true, false] => assert!((moved + 0.1).abs() < 1e-4, "{moved}"),
            [false, true] => assert!((moved - 0.1).abs() < 1e-4, "{moved}"),
            _ => assert!(moved.abs() < 1e-4, "{moved}"),
        }
        vertical += usize::from(is_higher[0] != is_higher[1]);
        between += usize::from(is_higher == [true; 2]);
    }
    assert!(vertical > 1_000 && between > 400, "{vertical} {between}");
    let high = (0..mesh.vertices.len()).filter(|&k| even.vertices[k][2] > 0.05);
    assert!(high.into_iter().all(|k| mesh.vertices[k] == even.vertices[k]), "upper edges stay");
    assert!(mesh.vertices.iter().zip(&even.vertices).all(|(a, b)| a[2] == b[2]), "only places change, not heights");
}

#[test]
fn the_seed_decides_the_terrain_and_tiles_do_not_depend_on_each_other() {
    let same = generate(&config());
    let mut small = config();
    small.num_rows = 3;
    let mut other = config();
    other.seed = 1;
    let (small, other) = (generate(&small), generate(&other));
    let meshes =
        |tiles: &[polypod::terrain::Tile], n: usize| tiles.iter().take(n).map(|t| t.mesh.clone()).collect::<Vec<_>>();
    assert!(meshes(&same, 200) == meshes(&generate(&config()), 200));
    assert!(meshes(&same, 200) != meshes(&other, 200));
    // heights of blocks and rough ground, which do not depend on the number of levels
    let rough: Vec<usize> = (12..16).collect();
    assert!(rough.iter().all(|&i| same[i].mesh == small[i].mesh));
}

#[test]
fn every_robot_meets_every_type_in_equal_shares() {
    let mut sim = Sim::new(&SimOptions::new("velocity_rough", 8 * 60)).unwrap();
    let origins = by_env::<EnvOrigin>(&mut sim);
    let layout = TerrainLayout::new(&config());
    let mut levels = [0; 10];
    for robot in 0..8 {
        let mut counts = [0; 6];
        for env in sim.env_ids(robot) {
            let place = origins[env];
            counts[layout.column_types[place.terrain_column as usize]] += 1;
            levels[place.terrain_level as usize] += 1;
            assert_eq!(place.position, layout.origin(place.terrain_level, place.terrain_column));
        }
        assert_eq!(counts, [12, 12, 12, 12, 6, 6], "robot {robot}");
    }
    // 480 draws of six levels: 4 standard deviations are 33
    assert!(levels[..6].iter().all(|n: &i32| (n - 80).abs() < 33) && levels[6..] == [0; 4], "{levels:?}");
}

#[test]
fn the_reference_gives_robots_few_types() {
    // a file on top of two: the terrain of one, the changes of the other
    let task = Library::new(Vec::new()).task("reference_rough", &[]).unwrap().config;
    assert!(!task.events["physics_material"].enabled && task.rewards["anymal"]["flat_orientation_l2"].weight == 0.0);
    let mut sim = Sim::new(&SimOptions::new("reference_rough", 7 * 60)).unwrap();
    let origins = by_env::<EnvOrigin>(&mut sim);
    let layout = TerrainLayout::new(&config());
    let types = |robot: usize| -> Vec<usize> {
        let mut types: Vec<_> =
            sim.env_ids(robot).map(|env| layout.column_types[origins[env].terrain_column as usize]).collect();
        types.dedup();
        types
    };
    assert_eq!(
        (0..7).map(types).collect::<Vec<_>>(),
        [vec![0], vec![0, 1], vec![1, 2], vec![2], vec![2, 3], vec![3, 4], vec![4, 5]]
    );
}

#[test]
fn threads_and_resets_keep_every_bit_on_rough_ground() {
    let options = |threads| {
        let mut options = SimOptions { threads: Some(threads), seed: 5, ..SimOptions::new("velocity_rough", 150) };
        let short = ["sim.episode_length_s=0.6", "scene.terrain.num_rows=3", "scene.terrain.max_init_terrain_level=2"];
        options.overrides = short.map(String::from).to_vec();
        options
    };
    let (mut one, mut two) = (Sim::new(&options(1)).unwrap(), Sim::new(&options(2)).unwrap());
    let run = |sim: &mut Sim, steps: std::ops::Range<usize>| -> Vec<u32> {
        let mut rng = EnvRng::new(11, steps.start as u64);
        let mut bits = Vec::new();
        for _ in steps {
            let actions: Vec<f32> = (0..150 * 12).map(|_| rng.uniform([-0.5, 0.5])).collect();
            sim.step(&actions).unwrap();
            bits.extend(sim.batch().observations.iter().chain(&sim.batch().rewards).map(|x| x.to_bits()));
        }
        bits
    };
    assert!(run(&mut one, 0..40) == run(&mut two, 0..40), "threads");
    let snapshot = one.snapshot().unwrap();
    let expected = run(&mut one, 40..80);
    two.restore(&snapshot).unwrap();
    assert!(run(&mut two, 40..80) == expected, "a restored simulation");
    // levels changed on the way, and a seed restarts everything
    one.reset(Some(5), None).unwrap();
    assert!(run(&mut one, 0..40) == run(&mut Sim::new(&options(1)).unwrap(), 0..40), "a seeded reset");
}

#[test]
fn robots_stand_on_the_platform_of_every_tile_type() {
    let mut sim = rough(8 * 20);
    for mut velocity in sim.world_mut().query::<&mut BaseVelocity>().iter_mut(sim.world_mut()) {
        *velocity = BaseVelocity::default();
    }
    let actions = vec![0.0; sim.batch().actions.len()];
    for step in 0..150 {
        sim.step(&actions).unwrap();
        let fallen: Vec<usize> = (0..sim.num_envs()).filter(|&env| sim.batch().terminated[env]).collect();
        let origins = by_env::<EnvOrigin>(&mut sim);
        let places: Vec<EnvOrigin> = fallen.iter().map(|&env| origins[env]).collect();
        assert!(fallen.is_empty(), "envs {fallen:?} fell in step {step} at {places:?}");
    }
    // feet that carry are a radius above what is below them
    let world = sim.world_mut();
    let heights: Vec<f32> = world.query::<&Feet>().iter(world).flat_map(|feet| feet.height.clone()).collect();
    let standing = heights.iter().filter(|h| (0.0..0.06).contains(*h)).count();
    assert!(standing * 10 > heights.len() * 9, "{standing} of {} feet are on the ground", heights.len());
}

#[test]
fn the_height_scanner_sees_what_rays_see() {
    let mut sim = rough(40);
    let layout = sim.task().observations.iter().map(|term| (term.name.clone(), term.size)).collect::<Vec<_>>();
    assert_eq!(layout.last().unwrap(), &("height_scan".to_owned(), 187));
    assert_eq!(sim.task().num_obs(), 235);
    let (poses, origins) = (by_env::<BasePose>(&mut sim), by_env::<EnvOrigin>(&mut sim));
    let observed = sim.batch().observations.clone();
    let heights = grid(&sim).clone();
    let mut rays: SystemState<SpatialQuery> = SystemState::new(sim.world_mut());
    let query = rays.get(sim.world()).unwrap();
    let (mut worst, mut clipped) = (0.0f32, 0);
    for env in 0..40 {
        let (p, [w, _, _, z]) = (poses[env].position, poses[env].rotation);
        let yaw = 2.0 * z.atan2(w);
        for k in 0..187 {
            // x from back to front is the inner loop, y from right to left the outer one
            let (x, y) = (-0.8 + 0.1 * (k % 17) as f32, -0.5 + 0.1 * (k / 17) as f32);
            let place = [
                origins[env].position[0] + p[0] + x * yaw.cos() - y * yaw.sin(),
                origins[env].position[1] + p[1] + x * yaw.sin() + y * yaw.cos(),
            ];
            // at a wall the scan may see its other side
            let near = [[0.03, 0.0], [-0.03, 0.0], [0.0, 0.03], [0.0, -0.03]];
            let at = |d: [f32; 2]| heights.sample(place[0] + d[0], place[1] + d[1]).0;
            if near.iter().any(|d| (at(*d) - at([0.0; 2])).abs() > 0.03) {
                continue;
            }
            let (_, hit) = below(&query, place, &SpatialQueryFilter::default()).unwrap();
            let expected = p[2] - hit - 0.5;
            clipped += usize::from(expected.abs() > 1.0);
            worst = worst.max((observed[env * 235 + 48 + k] - expected.clamp(-1.0, 1.0)).abs());
        }
    }
    println!("worst {:.4} mm, {clipped} clipped", 1e3 * worst);
    assert!(worst < 1e-3, "scan and rays differ by {worst} m");
}

#[test]
fn levels_follow_what_a_robot_walked() {
    let mut sim = Sim::new(&SimOptions::new("velocity_rough", 80)).unwrap();
    let last = i64::from(sim.task().max_episode_length) - 1;
    let layout = TerrainLayout::new(&config());
    let set_levels = |sim: &mut Sim, level: u32| {
        for mut origin in sim.world_mut().query::<&mut EnvOrigin>().iter_mut(sim.world_mut()) {
            origin.terrain_level = level;
            origin.position = layout.origin(level, origin.terrain_column);
        }
    };
    // all envs end their episode `walked` from their origin, told to go at 1 m/s or to stand
    let end = |sim: &mut Sim, level: u32, walked: f32, speed: f32| -> Vec<u32> {
        set_levels(sim, level);
        sim.set_commands(Some(&[speed, 0.0, 0.0].repeat(80))).unwrap();
        for mut pose in sim.world_mut().query::<&mut BasePose>().iter_mut(sim.world_mut()) {
            (pose.position[0], pose.position[1]) = (0.6 * walked, -0.8 * walked);
        }
        sim.set_episode_lengths(&[last; 80]).unwrap();
        for mut episode in sim.world_mut().query::<&mut Episode>().iter_mut(sim.world_mut()) {
            episode.lived = last as u32;
        }
        sim.step(&vec![0.0; 80 * 12]).unwrap();
        assert!((0..80).all(|env| sim.batch().truncated[env] || sim.batch().terminated[env]));
        by_env::<EnvOrigin>(sim).iter().map(|origin| origin.terrain_level).collect()
    };
    assert_eq!(end(&mut sim, 3, 4.3, 1.0), [4; 80], "it left the tile");
    assert_eq!(end(&mut sim, 3, 3.0, 1.0), [2; 80], "it fell behind half of 20 m");
    assert_eq!(end(&mut sim, 3, 3.0, 0.2), [3; 80], "it went more than half of 4 m, and stayed on its tile");
    assert_eq!(end(&mut sim, 0, 0.5, 1.0), [0; 80], "there is nothing easier");
    let mut seen = [0; 10];
    for _ in 0..5 {
        end(&mut sim, 9, 4.3, 1.0).into_iter().for_each(|level| seen[level as usize] += 1);
    }
    // 400 draws of ten levels: 4 standard deviations are 24
    assert!(seen.iter().all(|n: &i32| (n - 40).abs() < 24), "beyond the hardest level any may follow: {seen:?}");
    for (origin, position) in by_env::<EnvOrigin>(&mut sim).iter().zip(by_env::<BasePose>(&mut sim)) {
        assert_eq!(origin.position, layout.origin(origin.terrain_level, origin.terrain_column));
        assert!(position.position[0].hypot(position.position[1]) < 0.75, "episodes begin near the origin");
    }
}

#[test]
fn a_task_without_a_scanner_has_no_scan() {
    let mut sim = Sim::new(&SimOptions::new("velocity_flat", 8)).unwrap();
    let world = sim.world_mut();
    assert_eq!(world.query::<&HeightScan>().iter(world).count(), 0);
}
