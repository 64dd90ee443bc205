//! Every config of the repository loads; roots, layers, overrides and tasks for one robot do what
//! they say.

use std::fs;
use std::path::{Path, PathBuf};

use polypod::config::{ConfigErrorKind, Library, LoadedTask, TaskConfig};
use polypod::morphology::MorphologyModel;

fn root(test: &str) -> PathBuf {
    let root = Path::new(env!("CARGO_TARGET_TMPDIR")).join("config_layers").join(test);
    if root.exists() {
        fs::remove_dir_all(&root).unwrap();
    }
    fs::create_dir_all(root.join("configs/tasks")).unwrap();
    fs::create_dir_all(root.join("configs/robots")).unwrap();
    root
}

fn task(name: &str, overrides: &[&str]) -> LoadedTask {
    let overrides: Vec<String> = overrides.iter().map(|text| (*text).to_owned()).collect();
    Library::new(Vec::new()).task(name, &overrides).unwrap_or_else(|error| panic!("{error}"))
}

#[test]
fn every_robot_and_task_of_the_repository_loads() {
    let library = Library::new(Vec::new());
    let robots = library.robots().unwrap();
    assert!(!robots.is_empty());
    for robot in &robots {
        let loaded = library.robot(&robot.name).unwrap_or_else(|error| panic!("{error}"));
        assert_eq!(loaded.config.name, robot.name);
        assert_eq!(loaded.config.title, robot.title);
        assert!(loaded.urdf_text.contains("<robot"), "{}", robot.name);
        let model = MorphologyModel::new(&loaded).unwrap();
        let groups = loaded.config.actuators_by_slot(&model.roles.slots).unwrap();
        assert!(groups.iter().all(|(group, _)| loaded.config.actuators.contains_key(*group)));
        let pose = loaded.config.default_pose_by_slot(&model.roles.slots).unwrap();
        for (slot, angle) in model.roles.slots.iter().zip(pose) {
            assert_eq!(angle, loaded.config.default_pose[&slot.to_string()]);
        }
    }
    let tasks = library.tasks().unwrap();
    assert!(tasks.len() >= 2 + 2 * robots.len());
    for entry in &tasks {
        for name in entry.aliases.iter().chain([&entry.name]) {
            let loaded = library.task(name, &[]).unwrap_or_else(|error| panic!("{error}"));
            assert_eq!(loaded.config.name, entry.name);
            for robot in &loaded.config.robots {
                let robot = library.robot_in(robot, &loaded.config).unwrap_or_else(|error| panic!("{error}")).config;
                loaded.config.reward_set(&robot.name, &robot.reward_set).unwrap();
            }
        }
    }
}

#[test]
fn the_resolved_config_says_all_and_hashes_alike() {
    let loaded = task("velocity_flat", &[]);
    let text = loaded.resolved.to_string();
    assert_eq!(toml::from_str::<TaskConfig>(&text).unwrap(), loaded.config);
    assert_eq!(loaded.hash, task("Velocity-Flat-HeteroQuadruped-v0", &[]).hash);
    assert_eq!(loaded.hash, task("velocity_flat", &["sim.dt=0.005"]).hash);
    assert_ne!(loaded.hash, task("velocity_flat", &["sim.dt=0.004"]).hash);
    assert_eq!(loaded.config.sim.max_episode_length(), 1000);
}

#[test]
fn overrides_change_what_they_name() {
    let config = task(
        "velocity_flat",
        &[
            "physics.engine=avian",
            "rewards.anymal.feet_air_time.weight=0.25",
            "rewards.anymal.lin_vel_z_l2=null",
            "rewards.anymal.alive={ weight = 1 }",
            "observations.policy.joint_pos_rel.noise=0.5",
            "observations.policy.0.noise=0",
            "robots=[\"spot\"]",
            "physics.depenetration_rate=0.25",
        ],
    )
    .config;
    assert_eq!(config.physics.engine, "avian");
    assert_eq!(config.physics.depenetration_rate, 0.25);
    assert_eq!(config.rewards["anymal"]["feet_air_time"].weight, 0.25);
    assert_eq!(config.rewards["anymal"]["alive"].weight, 1.0);
    assert!(!config.rewards["anymal"].contains_key("lin_vel_z_l2"));
    let noise = |term: &str| config.observations.policy.iter().find(|t| t.term == term).unwrap().noise;
    assert_eq!((noise("joint_pos_rel"), noise("base_lin_vel")), (0.5, 0.0));
    assert_eq!(config.robots, ["spot"]);
}

#[test]
fn a_table_in_the_place_of_an_array_changes_what_it_names() {
    let (rough, stairs) = (task("velocity_rough_universal", &[]).config, task("velocity_rough_stairs", &[]).config);
    let tiles = |config: &TaskConfig| config.scene.terrain.as_ref().unwrap().sub_terrains.clone();
    let shares: Vec<(String, f64)> = tiles(&stairs).into_iter().map(|tile| (tile.name, tile.proportion)).collect();
    let of = |name: &str| shares.iter().find(|(other, _)| other == name).unwrap().1;
    assert_eq!((of("pyramid_stairs"), of("pyramid_stairs_inv"), of("hf_pyramid_slope")), (0.25, 0.4, 0.05));
    for (above, below) in tiles(&stairs).into_iter().zip(tiles(&rough)) {
        assert_eq!((above.name, above.shape), (below.name, below.shape));
    }
    let set = task("velocity_rough", &["scene.terrain.sub_terrains.boxes.proportion=0.7"]);
    assert_eq!(tiles(&set.config).iter().find(|tile| tile.name == "boxes").unwrap().proportion, 0.7);
}

#[test]
fn play_tasks_are_quiet() {
    let play = task("velocity_flat_play", &[]).config;
    let train = task("velocity_flat", &[]).config;
    assert!(!play.observations.enable_noise && train.observations.enable_noise);
    for name in ["push_robot", "physics_material", "add_base_mass", "base_com"] {
        assert!(!play.events[name].enabled && train.events[name].enabled, "{name}");
    }
    assert!(play.events["reset_base"].enabled);
    assert_eq!(play.rewards, train.rewards);
    assert_eq!(play.aliases, ["velocity_flat_play"]);
}

#[test]
fn a_task_without_a_play_variant_gets_one() {
    let root = root("quiet");
    let write = |file: &str, text: &str| fs::write(root.join("configs/tasks").join(file), text).unwrap();
    write("mine.toml", "extends = \"velocity_flat\"\nname = \"Mine-HeteroQuadruped-v0\"\n[sim]\ndecimation = 2\n");
    write("hills.toml", "extends = \"velocity_rough\"\nname = \"Hills-v2\"\n[events.action_delay]\nmode = \"reset\"\n");
    write("bare.toml", "extends = \"velocity_flat_variation\"\nname = \"bare\"\n");
    let library = Library::new(vec![root.clone()]);
    let path = root.join("configs/tasks/mine.toml").display().to_string();
    let names = [
        ("mine", "Mine-HeteroQuadruped-Play-v0"),
        ("Mine-HeteroQuadruped-v0", "Mine-HeteroQuadruped-Play-v0"),
        ("Mine-Spot-v0", "Mine-Spot-Play-v0"),
        ("hills", "Hills-Play-v2"),
        ("bare", "bare_play"),
        (&path, &path.replace(".toml", "_play.toml")),
        // the tasks that have a file, by all their names
        ("velocity_flat", "Velocity-Flat-HeteroQuadruped-Play-v0"),
        ("velocity_flat_play", "Velocity-Flat-HeteroQuadruped-Play-v0"),
        ("Isaac-Velocity-Flat-Spot-v0", "Velocity-Flat-Spot-Play-v0"),
    ];
    for (task, play) in names {
        assert_eq!(library.play_task(task).unwrap(), play);
        assert_eq!(library.play_task(play).unwrap(), play);
        let quiet = library.task(play, &[]).unwrap().config;
        assert_eq!(quiet.disturbances(), Vec::<String>::new(), "{play}");
        assert!(quiet.events["reset_base"].enabled && quiet.events["reset_joints"].enabled);
        let noisy = library.task(&library.training_task(play).unwrap(), &[]).unwrap().config;
        assert!(!noisy.disturbances().is_empty(), "{task}");
        assert_eq!((&quiet.rewards, &quiet.commands, &quiet.sim), (&noisy.rewards, &noisy.commands, &noisy.sim));
    }
    // the rule is that of the built-in files: made of the same task, it gives the same but for its
    // names
    let made = |task: &str, file: &str| {
        write("same.toml", &format!("extends = \"{task}\"\nname = \"Same-v0\"\n"));
        let mut made = library.task("Same-Play-v0", &[]).unwrap().config;
        let built_in = library.task(file, &[]).unwrap().config;
        (made.name, made.aliases) = (built_in.name.clone(), built_in.aliases.clone());
        assert_eq!(made, built_in, "{task}");
    };
    for task in
        ["velocity_flat", "velocity_flat_variation", "velocity_rough", "velocity_rough_blind", "velocity_flat_legged"]
    {
        made(task, &format!("{task}_play"));
    }
    let hills = library.task("Hills-Play-v2", &[]).unwrap().config;
    assert!(!hills.events["action_delay"].enabled && !hills.curriculum["terrain_levels"].enabled);
    assert_eq!(hills.scene.terrain.unwrap().max_init_terrain_level, Some(4));
}

#[test]
fn a_play_variant_of_nothing_is_no_task() {
    let library = Library::new(Vec::new());
    for name in ["Nothing-Play-v0", "nothing_play", "Nothing-v0"] {
        let error = library.task(name, &[]).unwrap_err();
        assert_eq!(error.kind, ConfigErrorKind::UnknownName, "{error}");
        assert!(error.to_string().contains(name), "{error}");
        assert!(library.play_task(name).is_err());
    }
    for path in ["/nothing/here_play.toml", "/nothing/here.toml"] {
        let error = library.task(path, &[]).unwrap_err();
        assert!(error.to_string().contains(path), "{error}");
    }
}

#[test]
fn what_an_override_switches_on_is_known() {
    let noise = task("velocity_flat_play", &["observations.enable_noise=true"]).config;
    assert_eq!(noise.disturbances(), ["observations.enable_noise"]);
    let push = "events.push_robot={ enabled = true, velocity_range = [-1.0, 1.0] }";
    assert_eq!(task("velocity_flat_play", &[push]).config.disturbances(), ["events.push_robot.enabled"]);
    let delay = "events.action_delay.enabled=true";
    assert_eq!(task("velocity_flat_play", &[delay]).config.disturbances(), ["events.action_delay.enabled"]);
}

#[test]
fn a_task_for_many_robots_makes_one_for_each() {
    let many = task("velocity_flat", &[]).config;
    let one = task("Velocity-Flat-Unitree-Go2-v0", &["sim.decimation=2"]).config;
    assert_eq!(one.robots, ["unitree_go2"]);
    assert_eq!(one.experiment_name, format!("{}_unitree_go2", many.experiment_name));
    assert_eq!(one.sim.decimation, 2);
    assert_eq!(one.rewards, many.rewards);
    assert_eq!(task("Velocity-Flat-Anymal-C-v0", &[]).config.robots, ["anymal_c"]);
    assert!(!task("Velocity-Flat-Spot-Play-v0", &[]).config.observations.enable_noise);
}

#[test]
fn a_root_adds_robots_and_hides_what_it_redefines() {
    let root = root("hides");
    let above = "extends = \"velocity_flat\"\nname = \"Velocity-Flat-HeteroQuadruped-v0\"\n[sim]\ndecimation = 2\n";
    fs::write(root.join("configs/tasks/velocity_flat.toml"), above).unwrap();
    let robot = "extends = \"spot\"\nname = \"big_dog\"\ntitle = \"Big Dog\"\naction_scale = 1\n\
                 package_dirs = { meshes = \"../m\" }\n";
    fs::write(root.join("configs/robots/big_dog.toml"), robot).unwrap();
    let library = Library::new(vec![root.clone()]);

    let config = library.task("velocity_flat_play", &[]).unwrap().config;
    assert_eq!((config.sim.decimation, config.sim.dt), (2, 0.005));
    assert_eq!(library.task("Velocity-Flat-Big-Dog-v0", &[]).unwrap().config.robots, ["big_dog"]);

    let robots: Vec<String> = library.robots().unwrap().into_iter().map(|r| r.name).collect();
    assert!(robots.contains(&"big_dog".to_owned()) && robots.contains(&"spot".to_owned()));
    let dog = library.robot("big_dog").unwrap();
    assert_eq!((dog.config.title.as_str(), dog.config.action_scale), ("Big Dog", 1.0));
    assert_eq!(dog.urdf_text, library.robot("spot").unwrap().urdf_text);
    assert_eq!(dog.config.package_dirs["meshes"], root.join("configs/robots/../m"));
}

#[test]
fn a_broken_file_breaks_only_itself() {
    let root = root("broken");
    let write = |file: &str, text: &[u8]| fs::write(root.join("configs").join(file), text).unwrap();
    write("tasks/half.toml", b"name = \"Half-v0\"\nrobots = [");
    write("tasks/bytes.toml", b"name = \"\xff\"");
    write("tasks/above.toml", b"extends = \"half\"\nname = \"Above-v0\"");
    write("tasks/stray.toml", b"extends = \"nowhere\"\nname = \"Stray-v0\"");
    write("tasks/mine.toml", b"extends = \"velocity_flat\"\nname = \"Mine-v0\"\nrobots = [\"spot\"]");
    write("robots/spot.toml", b"title = 3");
    let library = Library::new(vec![root.clone()]);

    let tasks = library.tasks().unwrap();
    let num_robots = |name: &str| tasks.iter().find(|task| task.name == name).map(|task| task.robots.len());
    assert_eq!((num_robots("Mine-v0"), num_robots("Velocity-Flat-HeteroQuadruped-v0")), (Some(1), Some(8)));
    assert_eq!((num_robots("Velocity-Flat-Unitree-Go2-v0"), num_robots("Velocity-Flat-Spot-v0")), (Some(1), None));
    assert!(tasks.iter().all(|task| !["Half-v0", "Above-v0", "Stray-v0"].contains(&task.name.as_str())));
    let robots = library.robots().unwrap();
    assert!(robots.iter().any(|robot| robot.name == "anymal_c") && robots.iter().all(|robot| robot.name != "spot"));
    let broken: Vec<String> = library.broken().unwrap().into_iter().map(|error| error.file).collect();
    let files = ["robots/spot.toml", "tasks/half.toml", "tasks/bytes.toml", "tasks/stray.toml"];
    let mut files = files.map(|file| root.join("configs").join(file).display().to_string());
    files.sort();
    let mut found = broken;
    found.sort();
    assert_eq!(found, files);

    assert_eq!(library.task("mine", &[]).unwrap().config.robots, ["spot"]);
    assert!(library.task("Velocity-Flat-HeteroQuadruped-v0", &[]).is_ok());
    assert!(library.task("Velocity-Flat-Unitree-Go2-v0", &[]).is_ok());
    let task = library.task("velocity_flat", &[]).unwrap().config;
    assert!(library.robot_in("anymal_c", &task).is_ok());
    for (name, file) in [("half", "tasks/half.toml"), ("bytes", "tasks/bytes.toml"), ("above", "tasks/half.toml")] {
        let error = library.task(name, &[]).unwrap_err();
        assert_eq!(error.file, root.join("configs").join(file).display().to_string(), "{error}");
    }
    assert!(library.robot("spot").unwrap_err().file.ends_with("configs/robots/spot.toml"));
    // a name that may be in one of them says so
    let error = library.task("Half-v0", &[]).unwrap_err().to_string();
    assert!(error.contains("there is no task `Half-v0`, unless it is in") && error.contains("half.toml"), "{error}");
}

#[test]
fn a_robot_given_by_path_finds_the_urdf_beside_it() {
    let root = root("path");
    let robot = "extends = \"spot\"\nname = \"cub\"\ntitle = \"Cub\"\nurdf = \"cub.urdf\"\n";
    fs::write(root.join("cub.toml"), robot).unwrap();
    fs::write(root.join("cub.urdf"), "<robot name=\"cub\"/>").unwrap();
    let path = root.join("cub.toml");
    let cub = Library::new(Vec::new()).robot(path.to_str().unwrap()).unwrap();
    assert_eq!(cub.urdf_text, "<robot name=\"cub\"/>");
    assert_eq!(cub.urdf_path, root.join("cub.urdf"));
}

#[test]
fn a_task_may_change_its_robots() {
    let library = Library::new(Vec::new());
    let reference = task("reference_flat", &["robot_overrides.unitree_b2.action_scale=0.4"]).config;
    let b2 = library.robot_in("unitree_b2", &reference).unwrap();
    assert_eq!((b2.config.action_scale, b2.config.actuators["legs"].stiffness), (0.4, Some(160.0)));
    // keys without an override stay, and so does the robot outside the task
    assert_eq!(b2.config.actuators["legs"].effort_limit, Some(200.0));
    assert_eq!(library.robot("unitree_b2").unwrap().config.actuators["legs"].stiffness, Some(250.0));
    assert!(b2.resolved.to_string().contains("160"));

    let mut wrong = reference.clone();
    let table = wrong.robot_overrides.remove("unitree_b2").unwrap();
    wrong.robot_overrides.insert("unitre_b2".into(), table);
    let error = library.robot_in("spot", &wrong).unwrap_err().to_string();
    assert!(error.contains("robot_overrides.unitre_b2") && error.contains("unitree_b2"), "{error}");

    let mut wrong = reference;
    let table = "[actuators.legs]\nstifness = 1.0".parse().unwrap();
    wrong.robot_overrides.insert("unitree_a1".into(), table);
    let error = library.robot_in("unitree_a1", &wrong).unwrap_err().to_string();
    assert!(error.contains("robot_overrides.unitree_a1") && error.contains("did you mean `stiffness`"), "{error}");
}
