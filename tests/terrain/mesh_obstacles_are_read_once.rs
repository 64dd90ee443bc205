//! A mesh obstacle is its file's surface, for rays and for robots; the loaded task needs the file
//! no more.

use std::path::{Path, PathBuf};

use avian3d::prelude::{SpatialQuery, SpatialQueryFilter};
use bevy_ecs::system::SystemState;
use polypod::components::{BasePose, BaseVelocity, EnvId};
use polypod::config::{ConfigError, ConfigErrorKind, Library, ObstacleConfig};
use polypod::world::{Ground, below};
use polypod::{Sim, SimOptions};

/// 1 m long, 1 m wide, 0.2 m high at its end.
const WEDGE: &str = include_str!("../data/wedge.obj");

/// A folder with a task `mine`, which has this obstacle, and with the wedge.
fn folder(test: &str, obstacle: &str) -> PathBuf {
    let root = Path::new(env!("CARGO_TARGET_TMPDIR")).join("mesh_obstacles").join(test);
    let tasks = root.join("configs/tasks");
    std::fs::create_dir_all(&tasks).unwrap();
    std::fs::write(tasks.join("wedge.obj"), WEDGE).unwrap();
    let head = "extends = \"velocity_flat\"\nname = \"Mine\"\n[[scene.obstacles]]\nshape = \"mesh\"\n";
    std::fs::write(tasks.join("mine.toml"), format!("{head}{obstacle}")).unwrap();
    root
}

fn error(test: &str, obstacle: &str) -> ConfigError {
    Library::new(vec![folder(test, obstacle)]).task("mine", &[]).unwrap_err()
}

/// At rest in the default pose, nothing random.
fn calm(root: &Path, engine: &str) -> SimOptions {
    let overrides = [
        "events.reset_base.x=[0.0, 0.0]",
        "events.reset_base.y=[0.0, 0.0]",
        "events.reset_base.yaw=[0.0, 0.0]",
        "events.reset_joints.enabled=false",
        "events.add_base_mass.enabled=false",
        "events.base_com.enabled=false",
        "events.push_robot.enabled=false",
    ];
    let engine = format!("physics.engine={engine}");
    SimOptions {
        overrides: overrides.into_iter().map(String::from).chain([engine]).collect(),
        roots: vec![root.to_path_buf()],
        ..SimOptions::new("mine", 8)
    }
}

#[test]
fn rays_and_grid_see_the_surface() {
    // three times as long, twice as wide, half as high, turned about by a quarter: it rises along y
    let placed = "file = \"wedge.obj\"\nscale = [3.0, 2.0, 0.5]\nposition = [0.4, 2.0, 0.1]\nrpy = [0.0, 0.0, 1.5707963267948966]";
    let mut sim = Sim::new(&calm(&folder("rays", placed), "articulated")).unwrap();
    let grid = sim.world().resource::<Ground>().terrain.clone().unwrap();
    let mut rays: SystemState<SpatialQuery> = SystemState::new(sim.world_mut());
    let query = rays.get(sim.world()).unwrap();
    for along in [-1.2_f32, -0.7, 0.0, 0.55, 1.3] {
        let (x, y) = (0.4 + 0.3 * along, 2.0 + along);
        let height = 0.1 + 0.1 * (along + 1.5) / 3.0;
        let seen = below(&query, [x, y], &SpatialQueryFilter::default()).unwrap().1;
        assert!((seen - height).abs() < 1e-4, "at {along} m: {seen} m, not {height} m");
        assert!((grid.sample(x, y).0 - height).abs() < 1e-4, "at {along} m: {} m", grid.sample(x, y).0);
    }
}

/// Height of each robot's base after 2 s in its default pose.
fn stand(options: &SimOptions) -> Vec<f32> {
    let mut sim = Sim::new(options).unwrap();
    let world = sim.world_mut();
    for mut velocity in world.query::<&mut BaseVelocity>().iter_mut(world) {
        *velocity = BaseVelocity::default();
    }
    let actions = vec![0.0; sim.batch().actions.len()];
    (0..100).for_each(|_| sim.step(&actions).unwrap());
    let world = sim.world_mut();
    let mut robots: Vec<(EnvId, f32)> =
        world.query::<(&EnvId, &BasePose)>().iter(world).map(|(env, pose)| (*env, pose.position[2])).collect();
    robots.sort_by_key(|(env, _)| *env);
    robots.into_iter().map(|(_, height)| height).collect()
}

#[test]
fn robots_stand_on_it_on_both_engines() {
    // a table: the flat underside of the wedge, upside down
    let table = "file = \"wedge.obj\"\nscale = [3.0, 2.0, 1.0]\nposition = [0.0, 0.0, 0.2]\nrpy = [3.141592653589793, 0.0, 0.0]";
    for engine in ["articulated", "avian"] {
        let on_table = calm(&folder(engine, table), engine);
        let on_ground = SimOptions { task: "velocity_flat".into(), ..on_table.clone() };
        for (env, (high, low)) in stand(&on_table).into_iter().zip(stand(&on_ground)).enumerate() {
            assert!((high - low - 0.2).abs() < 2e-3, "env {env} on {engine}: {high} m on it, {low} m on the ground");
        }
    }
}

#[test]
fn the_loaded_task_needs_no_file() {
    let root = folder("embedded", "file = \"wedge.obj\"\nposition = [0.0, 0.0, 0.0]");
    let library = Library::new(vec![root.clone()]);
    let task = library.task("mine", &[]).unwrap();
    let ObstacleConfig::Mesh { vertices, triangles, .. } = &task.config.scene.obstacles[0] else {
        panic!("{:?}", task.config.scene.obstacles);
    };
    // the quads are two triangles each, and corners are shared
    assert_eq!((vertices.len(), triangles.len()), (6, 8));
    let again: polypod::config::TaskConfig = toml::from_str(&task.resolved.to_string()).unwrap();
    assert_eq!(again, task.config);
    // another surface is another task
    std::fs::write(root.join("configs/tasks/wedge.obj"), WEDGE.replace("0.2", "0.3")).unwrap();
    assert_ne!(library.task("mine", &[]).unwrap().hash, task.hash);
    // an override names another file, relative to the working directory
    let other = concat!("scene.obstacles.0.file=", env!("CARGO_MANIFEST_DIR"), "/tests/data/urdf/meshes/cube.stl");
    let task = library.task("mine", &[other.to_string()]).unwrap();
    let ObstacleConfig::Mesh { vertices, triangles, .. } = &task.config.scene.obstacles[0] else {
        panic!("{:?}", task.config.scene.obstacles);
    };
    assert_eq!((vertices.len(), triangles.len()), (8, 12));
}

#[test]
fn what_is_wrong_names_file_and_remedy() {
    let found = error("missing", "file = \"none.stl\"\nposition = [0.0, 0.0, 0.0]");
    assert_eq!((found.kind, found.element.as_str()), (ConfigErrorKind::Unreadable, "scene.obstacles[0].file"));
    assert!(found.file.ends_with("mine.toml") && found.problem.contains("none.stl"), "{found}");
    assert!(found.remedy.contains("STL or OBJ"), "{found}");

    let found = error("ending", "file = \"mine.toml\"\nposition = [0.0, 0.0, 0.0]");
    assert!(found.problem.contains(".toml") && found.problem.contains(".stl and .obj"), "{found}");

    let found = error("nothing", "position = [0.0, 0.0, 0.0]");
    assert_eq!(found.element, "scene.obstacles[0]");
    assert!(found.problem.contains("no triangles") && found.remedy.contains("file"), "{found}");

    let found = error("scale", "file = \"wedge.obj\"\nscale = [1.0, 0.0, 1.0]\nposition = [0.0, 0.0, 0.0]");
    assert!(found.remedy.contains("above 0"), "{found}");

    let numbers = "vertices = [[0.0, 0.0, 0.0]]\ntriangles = [[0, 1, 2]]\nposition = [0.0, 0.0, 0.0]";
    let found = error("corners", numbers);
    assert!(found.problem.contains("corner") && found.remedy.contains("from 0"), "{found}");
}
