//! A depth camera's image is the ground along its pixels: held between frames, late, lost, saved,
//! mirrored, and of some robots alone. `tests/python/env/test_depth_camera.py` compares it with
//! MuJoCo's rays.

use polypod::components::{BasePose, EnvId, RayCasterCamera};
use polypod::dynamics::lanes::Simd;
use polypod::{Sim, SimOptions};

use crate::common::{self, assert_all_same, step};

const WIDTH: usize = 9;
const HEIGHT: usize = 6;
const MOUNT: &str = "mount={pos=[0.3, 0.0, 0.05], rot=[0.966, 0.0, 0.259, 0.0]}";

/// A camera of 9 x 6 pixels whose image is the whole observation, but for `others`.
fn options(task: &str, robots: &[&str], num_envs: usize, keys: &str, others: &[&str]) -> SimOptions {
    let mut overrides = vec![
        format!(
            "sensors.ray_caster_camera={{pattern_cfg={{width={WIDTH}, height={HEIGHT}, horizontal_fov=1.2}}, \
             max_distance=3.0, {keys}}}"
        ),
        "observations.policy=[{term=\"image\"}]".into(),
    ];
    overrides.extend(others.iter().map(|text| text.to_string()));
    SimOptions {
        overrides,
        robots: Some(robots.iter().map(|robot| robot.to_string()).collect()),
        seed: 3,
        threads: Some(1),
        ..SimOptions::new(task, num_envs)
    }
}

fn images(sim: &Sim) -> Vec<Vec<f32>> {
    sim.batch().observations.chunks(WIDTH * HEIGHT).map(<[f32]>::to_vec).collect()
}

fn rough(keys: &str, others: &[&str]) -> Sim {
    Sim::new(&options("velocity_rough_play", &["unitree_go2"], 6, keys, others)).unwrap()
}

#[test]
fn a_camera_that_looks_down_on_a_plane_sees_its_height() {
    // straight down: x of the camera along -z of the base
    let still = ["events.reset_base.yaw=[0.0, 0.0]", "events.push_robot.enabled=false"];
    let keys = "mount={pos=[0.0, 0.0, 0.0], rot=[0.7071067811865476, 0.0, 0.7071067811865476, 0.0]}";
    for (data_type, is_plane) in [("distance_to_image_plane", true), ("distance_to_camera", false)] {
        let keys = format!("{keys}, data_type=\"{data_type}\"");
        let mut sim = Sim::new(&options("velocity_flat", &["unitree_go2"], 1, &keys, &still)).unwrap();
        let height = {
            let world = sim.world_mut();
            world.query::<&BasePose>().iter(world).next().unwrap().position[2]
        };
        let tan = 0.6f32.tan();
        for (k, seen) in images(&sim)[0].iter().enumerate() {
            let (row, column) = (k / WIDTH, k % WIDTH);
            let across = tan * (1.0 - (2 * column + 1) as f32 / WIDTH as f32);
            let down = tan * HEIGHT as f32 / WIDTH as f32 * (1.0 - (2 * row + 1) as f32 / HEIGHT as f32);
            let length = (1.0 + across * across + down * down).sqrt();
            let expected = if is_plane { height } else { height * length };
            assert!((seen - expected).abs() < 1e-3, "{data_type}, pixel {k}: {seen}, not {expected}");
        }
    }
}

#[test]
fn images_end_at_the_range_of_the_camera() {
    let flat = |keys: &str| {
        let others = ["events.push_robot.enabled=false"];
        let keys = format!("mount={{pos=[0.0, 0.0, 0.3], rot=[1.0, 0.0, 0.0, 0.0]}}, {keys}");
        images(&Sim::new(&options("velocity_flat", &["unitree_go2"], 1, &keys, &others)).unwrap()).swap_remove(0)
    };
    // level: the upper half sees the sky, the lowest row the ground at less than 3 m
    let (most, zero) = (flat(""), flat("depth_clipping_behavior=\"zero\", min_distance=2.0"));
    assert!(most[..WIDTH * HEIGHT / 2].iter().all(|depth| *depth == 3.0), "{most:?}");
    assert!(zero[..WIDTH * HEIGHT / 2].iter().all(|depth| *depth == 0.0), "{zero:?}");
    let near = most.iter().filter(|depth| **depth < 2.0).count();
    assert!(near >= WIDTH, "{most:?}");
    for (most, zero) in most.iter().zip(&zero) {
        assert_eq!(*zero, if (2.0..3.0).contains(most) { *most } else { 0.0 });
    }
    assert!(flat("min_distance=2.0").iter().zip(&most).all(|(a, b)| *a == b.max(2.0)));
}

#[test]
fn frames_are_held_between_updates_and_envs_take_theirs_at_different_times() {
    // 25 frames a second at 50 control steps a second
    let mut sim = rough(&format!("{MOUNT}, update_period=0.06"), &[]);
    let mut every = rough(MOUNT, &[]);
    let mut last = images(&sim);
    assert!(last == images(&every), "an episode begins with a frame");
    let mut phases = Vec::new();
    for t in 0..30 {
        step(&mut sim, t);
        step(&mut every, t);
        assert!(!sim.batch().terminated.contains(&true));
        let (now, fresh) = (images(&sim), images(&every));
        for env in 0..6 {
            if now[env] == fresh[env] && now[env] != last[env] {
                phases.push((env, t % 3));
            } else {
                assert!(now[env] == last[env], "env {env}, step {t}: neither held nor new");
            }
        }
        last = now;
    }
    phases.sort_unstable();
    assert_eq!(phases.len(), 6 * 10, "a frame of each env in three steps");
    phases.dedup();
    assert_eq!(phases.len(), 6, "always the same third step: {phases:?}");
    assert!((0..3).filter(|phase| phases.iter().any(|(_, p)| p == phase)).count() > 1, "{phases:?}");
}

#[test]
fn late_frames_are_those_of_before_and_lost_ones_are_not_shown() {
    let mut late = rough(&format!("{MOUNT}, delay=[0.06, 0.06]"), &[]);
    let mut now = rough(MOUNT, &[]);
    let mut lost = rough(&format!("{MOUNT}, drop_probability=1.0"), &[]);
    let mut half = rough(&format!("{MOUNT}, drop_probability=0.5"), &[]);
    let first = images(&now);
    let mut past = vec![first.clone()];
    let (mut kept, mut before) = (0, images(&half));
    for t in 0..20 {
        for sim in [&mut late, &mut now, &mut lost, &mut half] {
            step(sim, t);
        }
        past.push(images(&now));
        // the image is late by three control steps; the first frame is at once there
        assert!(images(&late) == past[(t + 1).saturating_sub(3)], "step {t}");
        assert!(images(&lost) == first, "step {t}");
        let seen = images(&half);
        kept += (0..6).filter(|env| seen[*env] != before[*env]).count();
        before = seen;
    }
    // 120 frames: 3.6 standard deviations are 20
    assert!((40..=80).contains(&kept), "{kept} of 120 frames were kept");
    // each episode draws its delay
    let mut drawn = rough(&format!("{MOUNT}, delay=[0.0, 0.2]"), &[]);
    let world = drawn.world_mut();
    let mut delays: Vec<u32> = world.query::<&RayCasterCamera>().iter(world).map(|camera| camera.delay).collect();
    delays.sort_unstable();
    delays.dedup();
    assert!(delays.len() > 2 && delays.iter().all(|delay| *delay <= 10), "{delays:?}");
}

#[test]
fn noise_grows_with_the_distance_and_stays_with_its_frame() {
    let exact = rough(MOUNT, &[]);
    let mut noisy = rough(&format!("{MOUNT}, noise=0.01, relative_noise=0.02, update_period=1.0"), &[]);
    let (mut most, mut sum, mut count) = (0.0f32, 0.0, 0);
    for (a, b) in images(&exact).iter().flatten().zip(images(&noisy).iter().flatten()) {
        if *a < 3.0 {
            let share = (b - a) / (0.01 + 0.02 * a);
            (most, sum, count) = (most.max(share.abs()), sum + share, count + 1);
        } else {
            assert_eq!(b, a, "the sky has no noise");
        }
    }
    assert!(most <= 1.0 + 1e-3 && most > 0.9 && count > 200, "{most}, {count} pixels");
    assert!(sum.abs() / (count as f32) < 0.15, "{sum} of {count}");
    let before = images(&noisy);
    step(&mut noisy, 0);
    let held = images(&noisy).iter().zip(&before).filter(|(a, b)| a == b).count();
    assert!(held >= 4, "{held} of 6 frames were held with their noise");
}

#[test]
fn threads_instruction_sets_company_and_restores_keep_every_bit() {
    let keys = format!("{MOUNT}, update_period=0.04, delay=[0.0, 0.06], drop_probability=0.2, noise=0.02");
    let short = ["sim.episode_length_s=0.5"];
    let make = |robots: &[&str], envs, threads, simd| {
        let base = options("velocity_rough_play", robots, envs, &keys, &short);
        Sim::new(&SimOptions { threads: Some(threads), simd: Some(simd), ..base }).unwrap()
    };
    let mut reference = make(&["unitree_go2"], 10, 1, Simd::Portable);
    let mut others: Vec<Sim> = Simd::available().into_iter().map(|simd| make(&["unitree_go2"], 10, 2, simd)).collect();
    let mut pair = make(&["anymal_d", "unitree_go2"], 20, 1, Simd::Portable);
    let mut changed = 0;
    let mut last = images(&reference);
    for t in 0..common::size(40, 200) {
        step(&mut reference, t);
        for sim in &mut others {
            step(sim, t);
            assert_all_same(&mut reference, sim, &format!("step {t}, {}", sim.simd().name()));
        }
        let now = images(&reference);
        changed += usize::from(now != last);
        last = now;
    }
    assert!(changed > 20, "{changed}");
    // images that no snapshot holds follow from it
    let snapshot = reference.snapshot().unwrap();
    let mut restored = make(&["unitree_go2"], 10, 1, Simd::Portable);
    restored.restore(&snapshot).unwrap();
    for t in 0..30 {
        step(&mut reference, t);
        step(&mut restored, t);
        assert_all_same(&mut reference, &mut restored, &format!("restored, step {t}"));
    }
    // the same robot next to another one
    let zeros = |sim: &Sim| vec![0.0; sim.batch().actions.len()];
    let mut alone = make(&["unitree_go2"], 10, 1, Simd::Portable);
    for _ in 0..20 {
        alone.step(&zeros(&alone)).unwrap();
        pair.step(&zeros(&pair)).unwrap();
        assert!(images(&alone) == images(&pair)[10..], "company changed an image");
    }
}

#[test]
fn some_robots_have_a_camera_and_the_others_see_zeros() {
    let camera =
        "robot_overrides.unitree_g1.camera={body=\"torso_link\", pos=[0.1, 0.0, 0.4], rot=[0.966, 0.0, 0.259, 0.0]}";
    let noisy = "observations.policy=[{term=\"image\", noise=0.1}]";
    let mut sim = Sim::new(&options(
        "velocity_flat_legged",
        &["unitree_go2", "unitree_g1"],
        4,
        "update_period=0.0",
        &[camera, noisy, "observations.enable_noise=true"],
    ))
    .unwrap();
    let cameras: Vec<u32> = {
        let world = sim.world_mut();
        world.query::<(&EnvId, &RayCasterCamera)>().iter(world).map(|(env, _)| env.0).collect()
    };
    assert_eq!(cameras.len(), 2);
    step(&mut sim, 0);
    let seen = images(&sim);
    assert!(seen[..2].iter().flatten().all(|depth| *depth == 0.0), "zeros, without noise");
    assert!(seen[2..].iter().flatten().any(|depth| *depth > 0.5));
    for (robot, has) in [(0, false), (1, true)] {
        let mask = sim.task().observation_mask(&sim.morphologies()[robot]);
        assert_eq!(mask, vec![has; WIDTH * HEIGHT]);
    }
    // the columns of an image change sides
    let mirror = sim.task().mirrored_observation(&sim.morphologies()[1]);
    assert!(mirror.iter().enumerate().all(|(k, image)| *image == (k / WIDTH * WIDTH + WIDTH - 1 - k % WIDTH, 1.0)));
}

#[test]
fn cameras_that_see_nothing_are_refused() {
    let refused = |keys: &str, others: &[&str]| {
        let error = Sim::new(&options("velocity_flat", &["unitree_go2"], 1, keys, others)).err();
        error.map(|error| error.to_string()).unwrap_or_default()
    };
    for (keys, word) in [
        ("", "no robot of the task has a camera"),
        ("mount={body=\"nose\", pos=[0.0, 0.0, 0.0]}", "has no moving link `nose`"),
        ("mount={pos=[0.0, 0.0, 0.0], rot=[0.0, 0.0, 0.0, 0.0]}", "it turns nowhere"),
        ("mount={pos=[0.0, 0.0, 0.0]}, min_distance=3.0", "it measures no distance"),
        ("mount={pos=[0.0, 0.0, 0.0]}, delay=[0.0, 20.0]", "20 is beyond 10 s"),
    ] {
        let error = refused(keys, &[]);
        assert!(error.contains(word), "{keys}: {error}");
    }
    let error = refused(
        MOUNT,
        &["sensors.ray_caster_camera.pattern_cfg.width=1000", "sensors.ray_caster_camera.pattern_cfg.height=1000"],
    );
    assert!(error.contains("more than 100 000 pixels"), "{error}");
    let error = refused(MOUNT, &["sensors.ray_caster_camera=null"]);
    assert!(error.contains("add [sensors.ray_caster_camera]"), "{error}");
}
