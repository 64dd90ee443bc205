//! A mistake in a config is reported with its file, its key and what to do; nothing is ignored.

use std::fs;
use std::path::{Path, PathBuf};

use polypod::config::{ConfigError, ConfigErrorKind, Library, parse_params};
use polypod::{Sim, SimOptions};

/// A separate root for each test, below cargo's folder for such files.
struct Root(PathBuf);

impl Root {
    fn new(test: &str) -> Self {
        let root = Path::new(env!("CARGO_TARGET_TMPDIR")).join("config").join(test);
        if root.exists() {
            fs::remove_dir_all(&root).unwrap();
        }
        fs::create_dir_all(&root).unwrap();
        Self(root)
    }

    fn write(&self, file: &str, text: &str) -> String {
        let path = self.0.join(file);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, text).unwrap();
        path.display().to_string()
    }

    fn library(&self) -> Library {
        Library::new(vec![self.0.clone()])
    }

    /// The error of a task that extends the built-in one and adds `text`, and the task's file.
    fn task_error(&self, text: &str) -> (ConfigError, String) {
        let head = "extends = \"velocity_flat\"\nname = \"Mine\"\n";
        let file = self.write("configs/tasks/mine.toml", &format!("{head}{text}"));
        (self.library().task("mine", &[]).unwrap_err(), file)
    }

    /// The error of a robot that extends a built-in one and adds `text`, and the robot's file.
    fn robot_error(&self, base: &str, text: &str) -> (ConfigError, String) {
        let head = format!("extends = \"{base}\"\nname = \"mine\"\ntitle = \"Mine\"\n");
        let file = self.write("configs/robots/mine.toml", &format!("{head}{text}"));
        (self.library().robot("mine").unwrap_err(), file)
    }
}

fn override_error(text: &str) -> ConfigError {
    Library::new(Vec::new()).task("velocity_flat", &[text.to_owned()]).unwrap_err()
}

#[track_caller]
fn assert_error(error: &ConfigError, file: &str, element: &str, problem: &str, remedy: &str) {
    assert_eq!((error.file.as_str(), error.element.as_str()), (file, element), "{error}");
    assert!(error.problem.contains(problem), "{error}");
    assert!(error.remedy.contains(remedy), "{error}");
    assert_eq!(error.to_string(), format!("{file}: {element}: {}; {}", error.problem, error.remedy));
}

#[test]
fn unknown_keys_name_the_nearest_known_one_at_any_depth() {
    let root = Root::new("unknown_keys");
    let (error, file) = root.task_error("robotss = []");
    assert_error(&error, &file, "robotss", "unknown key `robotss`", "did you mean `robots`?");
    assert_eq!(error.kind, ConfigErrorKind::UnknownKey);

    let (error, file) = root.task_error("[scene.ground]\nstatic_frction = 1.0");
    let element = "scene.ground.static_frction";
    assert_error(&error, &file, element, "unknown key", "did you mean `static_friction`?");

    let (error, file) = root.task_error("[rewards.mine]\ngait = { wieght = 1.0 }");
    let element = "rewards.mine.gait";
    assert_error(&error, &file, element, "unknown key `wieght`", "did you mean `weight`?");

    let (error, file) = root.task_error("[rewards.mine]\ngait = { weight = 1.0, weigt = 1.0 }");
    assert_error(&error, &file, element, "unknown key `weigt`", "did you mean `weight`?");
    assert_eq!(error.kind, ConfigErrorKind::UnknownKey);

    let (error, file) = root.task_error("[sim]\nqqqq = 1");
    assert_error(&error, &file, "sim.qqqq", "unknown key `qqqq`", "known keys: dt, decimation");
}

#[test]
fn unknown_parameters_of_a_term_name_the_nearest_known_one() {
    #[derive(Debug, serde::Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Gait {
        #[serde(deserialize_with = "polypod::config::values::positive")]
        std: f64,
        max_err: f64,
    }
    let parse = |text: &str| parse_params::<Gait>("t.toml", "rewards.a.gait", &text.parse().unwrap());
    let gait = parse("std = 0.1\nmax_err = 1").unwrap();
    assert_eq!((gait.std, gait.max_err), (0.1, 1.0));

    let error = parse("std = 0.1\nmax_er = 1.0").unwrap_err();
    let element = "rewards.a.gait.max_er";
    assert_error(&error, "t.toml", element, "unknown key `max_er`", "did you mean `max_err`?");
    let error = parse("std = 0.1").unwrap_err();
    assert_error(&error, "t.toml", "rewards.a.gait", "key `max_err` is missing", "add `max_err`");
    let error = parse("std = -0.1\nmax_err = 1.0").unwrap_err();
    assert_error(&error, "t.toml", "rewards.a.gait.std", "not positive", "above 0");
    let error = parse("std = 0.1\nmax_err = nan").unwrap_err();
    assert_error(&error, "t.toml", "rewards.a.gait.max_err", "not finite", "finite number");
}

#[test]
fn wrong_types_name_the_expected_one() {
    let root = Root::new("types");
    let (error, file) = root.task_error("[sim]\ndt = \"fast\"");
    assert_error(&error, &file, "sim.dt", "string \"fast\" where a number", "write a number");
    let (error, file) = root.task_error("[sim]\ndecimation = 1.5");
    assert_error(&error, &file, "sim.decimation", "a whole number", "write a whole number");
    let (error, file) = root.task_error("events = 3");
    assert_error(&error, &file, "events", "integer `3` where a table", "write a table");
    let (error, file) = root.task_error("[physics]\nengine = 3");
    assert_error(&error, &file, "physics.engine", "integer `3`", "write a string");
    let (error, file) = root.task_error("[sim]\ngravity = [0.0, 0.0]");
    assert_error(&error, &file, "sim.gravity", "2 elements", "an array of length 3");
    let (error, file) = root.task_error("[[observations.policy]]\nterm = 1");
    assert_error(&error, &file, "observations.policy[0].term", "integer `1`", "write a string");
}

#[test]
fn values_out_of_range_are_refused() {
    let root = Root::new("ranges");
    let cases = [
        ("[sim]\ndt = 0.0", "sim.dt", "not positive"),
        ("[sim]\ndecimation = 0", "sim.decimation", "too few"),
        ("[sim]\ndt = inf", "sim.dt", "not finite"),
        ("[rewards.spot]\ngait = { weight = nan }", "rewards.spot.gait.weight", "not finite"),
        ("[physics]\nsolver_iterations = 0", "physics.solver_iterations", "too few"),
        ("[physics]\navian_substeps = 0", "physics.avian_substeps", "too few"),
        ("[physics]\nsolver_iterations = 10001", "physics.solver_iterations", "too many"),
        ("[physics]\navian_substeps = 1001", "physics.avian_substeps", "too many"),
        ("[scene.ground]\nrestitution = 2.0", "scene.ground.restitution", "outside 0 to 1"),
        (
            "[commands.base_velocity]\nlin_vel_x = [1.0, -1.0]",
            "commands.base_velocity.lin_vel_x",
            "above the upper end",
        ),
        ("[commands.base_velocity]\nlin_vel_x = [1.0]", "commands.base_velocity.lin_vel_x", "two ends"),
        ("[events.push_robot]\nmode = \"startup\"", "events.push_robot.interval_range_s", "only interval events"),
        ("[events.reset_base]\nmode = \"interval\"", "events.reset_base.interval_range_s", "needs its time"),
        (
            "[[scene.obstacles]]\nshape = \"box\"\nsize = [1, 1, -1]\nposition = [0, 0, 0]",
            "scene.obstacles[0]",
            "not above zero",
        ),
        (
            "[[scene.obstacles]]\nshape = \"heightfield\"\nsize = [1, 1]\nheights = [[0, 1], [0]]\nposition = [0, 0, 0]",
            "scene.obstacles[0]",
            "not a table",
        ),
        ("[[scene.obstacles]]\nshape = \"bx\"", "scene.obstacles[0].shape", "unknown value `bx`"),
        ("robots = []", "robots", "empty"),
        ("robots = [\"a\", \"b\", \"a\"]", "robots[2]", "listed twice"),
    ];
    for (text, element, problem) in cases {
        let (error, file) = root.task_error(text);
        assert!(error.file == file || error.element.ends_with("interval_range_s"), "{error}");
        assert_eq!(error.element, element, "{error}");
        assert!(error.problem.contains(problem), "{error}");
    }
}

#[test]
fn actuators_that_make_no_sense_are_refused() {
    let root = Root::new("actuators");
    let cases = [
        (
            "[actuators.hips]\nmodel = \"dc_motor\"\ndelay = [0, 0]\nvelocity_limit = 1.0",
            "actuators.hips",
            "needs saturation_effort",
        ),
        ("[actuators.hips]\nmodel = \"ideal_pd\"\ndelay = [0, 2]", "actuators.hips.delay", "only model \"delayed_pd\""),
        ("[actuators.hips]\nsaturation_effort = 1.0", "actuators.hips.saturation_effort", "dc_motor"),
        ("[actuators.hips]\njoints = [\"*_HAA\"]", "actuators", "LF_HFE is in no group, LH_HFE"),
        ("[actuators.knees]\njoints = [\"*\"]", "actuators", "LF_HAA is in hips and knees"),
        ("[actuators.knees]\njoints = [\"*_KFF\"]", "actuators.knees.joints[0]", "matches no canonical joint"),
        (
            "[actuators.knees]\neffort_table = [[1.0, 2.0], [1.0, 2.0]]",
            "actuators.knees.effort_table[1]",
            "not above the row before",
        ),
        ("[actuators.knees]\ndelay = [4, 0]", "actuators.knees.delay", "above the upper end"),
        ("[actuators.knees]\nstifness = 1.0", "actuators.knees.stifness", "unknown key"),
        ("[default_pose]\nLF_HAX = 0.0", "default_pose.LF_HAX", "unknown key"),
        ("[feet]\nFL = \"foot\"", "feet.FL", "unknown key"),
        ("[joint_roles]\nLF_HIP = \"hip\"", "joint_roles.LF_HIP", "unknown key"),
        ("[bodies]\nthighs = [\"leg\"]", "bodies.thighs", "unknown key"),
        ("urdf = \"nowhere.urdf\"", "urdf", "no such file"),
    ];
    for (text, element, problem) in cases {
        let (error, file) = root.robot_error("spot", text);
        assert_error(&error, &file, element, problem, "");
    }
    // a robot that leaves its speeds to the URDF
    let spot = include_str!("../../configs/robots/spot.toml").replace("name = \"spot\"", "name = \"free\"");
    let lines: Vec<&str> = spot.lines().filter(|line| !line.starts_with("velocity_limit")).collect();
    root.write("configs/robots/free.toml", &lines.join("\n"));
    let (error, file) = root.robot_error("free", "[actuators.hips]\nmodel = \"dc_motor\"\ndelay = [0, 0]");
    assert_error(&error, &file, "actuators.hips", "saturation_effort and velocity_limit", "");
    let text = "name = \"bare\"\ntitle = \"B\"\nurdf = \"r.urdf\"\nreward_set = \"a\"\naction_scale = 1.0\n\
                [default_pose]\nLF_HAA = 0.0\n[actuators]\n";
    let file = root.write("configs/robots/bare.toml", text);
    let error = root.library().robot("bare").unwrap_err();
    assert_error(&error, &file, "default_pose", "no angle for LH_HAA, RF_HAA", "in rad");
}

#[test]
fn springs_and_surfaces_that_cannot_be_are_refused() {
    let root = Root::new("surfaces");
    for (text, element, problem, remedy) in [
        ("[actuators.knees]\nspring_stiffness = -1.0", "actuators.knees.spring_stiffness", "", "N m/rad"),
        (
            "[actuators.knees]\nspring_reference = 0.5",
            "actuators.knees.spring_reference",
            "without a spring",
            "stiffness",
        ),
        ("[surfaces.feet]\nfriction = 0.5", "surfaces.feet", "key `bodies` is missing", "add `bodies`"),
        ("[surfaces.feet]\nbodies = []", "surfaces.feet.bodies", "is empty", "name links"),
        ("[surfaces.feet]\nbodies = [\"*\"]\nfriction = -0.5", "surfaces.feet.friction", "", ""),
        ("[surfaces.feet]\nbodies = [\"*\"]\nfrction = 0.5", "surfaces.feet.frction", "unknown key", "`friction`"),
        ("[surfaces.feet]\nbodies = [\"*\"]\ncontact_margin = 0.2", "surfaces.feet.contact_margin", "0.1 m", "in m"),
        ("[surfaces.feet]\nbodies = [\"*\"]\nrolling_friction = 11.0", "surfaces.feet.rolling_friction", "", " m"),
    ] {
        let (error, file) = root.robot_error("spot", text);
        assert_error(&error, &file, element, problem, remedy);
    }
    // errors that depend on the URDF come when the robot is loaded
    let of_robot = |surfaces: &str| {
        let overrides = vec![format!("robot_overrides.spot.surfaces={surfaces}")];
        let options =
            SimOptions { robots: Some(vec!["spot".into()]), overrides, ..SimOptions::new("velocity_flat", 1) };
        Sim::new(&options).err().unwrap().to_string()
    };
    let error = of_robot("{feet={bodies=[\"*_fot\"]}}");
    assert!(error.contains("surfaces.feet.bodies[0]: `*_fot` matches no link with a collision shape"), "{error}");
    let error = of_robot("{a={bodies=[\"*\"]}, b={bodies=[\"*\"]}}");
    assert!(error.contains("surfaces.b.bodies[0]: ") && error.contains("is in surfaces.a, too"), "{error}");
}

#[test]
fn effort_tables_that_single_precision_loses_are_refused() {
    let root = Root::new("effort_tables");
    let cases = [
        ("[[-2.7, 10.0], [-2.699999999, 20.0], [-0.3, 30.0]]", "actuators.knees.effort_table[1]", "less than 1e-5 rad"),
        ("[[-2.7, 10.0], [-2.6, 2e6]]", "actuators.knees.effort_table[1]", "beyond 1e6 N m"),
        ("[[-2.7, 10.0], [1e9, 20.0]]", "actuators.knees.effort_table[1]", "beyond 1000 rad"),
        ("[[-2.7, 0.0], [-0.3, 0.0]]", "actuators.knees.effort_table", "cannot be driven"),
        ("[[-500.0, 1.0], [0.0, 2.0], [0.00012, 3.0]]", "actuators.knees.effort_table", "no grid"),
    ];
    for (table, element, problem) in cases {
        let (error, file) = root.robot_error("spot", &format!("[actuators.knees]\neffort_table = {table}"));
        assert_error(&error, &file, element, problem, "");
    }
}

#[test]
fn syntax_errors_name_line_and_column() {
    let root = Root::new("syntax");
    let file = root.write("configs/tasks/broken.toml", "name = \"x\"\nrobots = [1,\n");
    let error = root.library().task("broken", &[]).unwrap_err();
    assert_eq!(error.kind, ConfigErrorKind::Syntax);
    assert_error(&error, &file, "line 2, column 13", "not valid TOML", "toml.io");
}

#[test]
fn a_mistake_is_blamed_on_the_file_that_holds_it() {
    let root = Root::new("blame");
    let base = root.write("configs/tasks/base.toml", "extends = \"velocity_flat\"\nname = \"Base\"\n[sim]\ndt = -1.0");
    root.write("configs/tasks/top.toml", "extends = \"base\"\nname = \"Top\"\n[sim]\ndecimation = 2");
    let error = root.library().task("top", &[]).unwrap_err();
    assert_error(&error, &base, "sim.dt", "not positive", "above 0");
}

#[test]
fn a_mistake_in_an_element_is_blamed_on_the_file_that_changed_it() {
    let root = Root::new("elements");
    let base = "extends = \"velocity_rough\"\nname = \"Base\"\n[scene.terrain.sub_terrains.";
    let file = root.write("configs/tasks/base.toml", &format!("{base}boxes]\nproportion = -1.0"));
    root.write(
        "configs/tasks/top.toml",
        "extends = \"base\"\nname = \"Top\"\n[observations.policy]\nheight_scan = { noise = 0.2 }",
    );
    let error = root.library().task("top", &[]).unwrap_err();
    assert_error(&error, &file, "scene.terrain.sub_terrains[2].proportion", "not positive", "above 0");
    let file = root.write("configs/tasks/base.toml", &format!("{base}boxs]\nproportion = 0.5"));
    let error = root.library().task("top", &[]).unwrap_err();
    assert_eq!(error.kind, ConfigErrorKind::UnknownKey);
    assert_error(&error, &file, "scene.terrain.sub_terrains.boxs", "no element `boxs`", "`boxes`");
}

#[test]
fn circles_of_extends_are_refused() {
    let root = Root::new("circles");
    root.write("configs/tasks/a.toml", "extends = \"b\"\nname = \"A\"");
    let file = root.write("configs/tasks/b.toml", "extends = \"a\"\nname = \"B\"");
    let error = root.library().task("a", &[]).unwrap_err();
    assert_error(&error, &file, "extends", "extends itself", "break the circle");
    let file = root.write("configs/tasks/d.toml", "extends = \"../tasks/d.toml\"\nname = \"D\"");
    let error = root.library().task("d", &[]).unwrap_err();
    assert_error(&error, &file, "extends", "extends itself", "break the circle");
    let file = root.write("configs/tasks/c.toml", "extends = \"velocity_flt\"\nname = \"C\"");
    let error = root.library().task("c", &[]).unwrap_err();
    assert_error(&error, &file, "extends", "no task `velocity_flt`", "`velocity_flat`");
}

#[test]
fn overrides_that_lead_nowhere_are_refused() {
    let cases = [
        ("sim.dtt=0.1", "sim.dtt", "unknown key `dtt`", "did you mean `dt`?"),
        ("smi.dt=0.1", "smi", "unknown key `smi`", "did you mean `sim`?"),
        (
            "rewards.anymal.feet_air_tme.weight=1",
            "rewards.anymal.feet_air_tme",
            "unknown key",
            "did you mean `feet_air_time`?",
        ),
        (
            "rewards.anymal.feet_air_time.wieght=1",
            "rewards.anymal.feet_air_time",
            "unknown key `wieght`",
            "did you mean `weight`?",
        ),
        (
            "observations.policy.joint_pos_rl.noise=0",
            "observations.policy.joint_pos_rl",
            "no element `joint_pos_rl`",
            "did you mean `joint_pos_rel`?",
        ),
        // tables that this task is without, and what is no part of a task
        ("scene.terrain.num_rows=3", "scene.terrain", "this task has none", "scene.terrain={"),
        ("scene.terrain.sub_terrains=[]", "scene.terrain", "this task has none", "velocity_rough"),
        ("sensors.height_scanner.resolution=0.1", "sensors.height_scanner", "this task has none", "begin with a task"),
        ("scene.terain.num_rows=3", "scene.terain", "unknown key `terain`", "known keys"),
        (
            "robots.unitree_go2.action_scale=0.4",
            "robots.unitree_go2",
            "no element `unitree_go2`",
            "robot_overrides.unitree_go2.<key>",
        ),
        ("robots.spot=null", "robots.spot", "no element `spot`", "robot_overrides.spot"),
        ("sim.dt.x=1", "sim.dt.x", "`sim.dt` is a float", "end the key there"),
        ("sim.dt=0", "sim.dt", "not positive", "above 0"),
        ("sim.dt=fast", "sim.dt", "where a number is expected", "write a number"),
        ("sim.dt=null", "sim", "key `dt` is missing", "add `dt`"),
        ("robots=[1,", "robots", "neither a TOML value nor a bare word", "quote it for the shell"),
        ("events.push_robt=null", "events.push_robt", "unknown key", "did you mean `push_robot`?"),
        ("sim.dt", "sim.dt", "no `=`", "key=value"),
    ];
    for (text, element, problem, remedy) in cases {
        assert_error(&override_error(text), "--set", element, problem, remedy);
    }
}

#[test]
fn unknown_names_come_with_near_ones_or_with_all() {
    let library = Library::new(Vec::new());
    let error = library.task("velocity_flt", &[]).unwrap_err();
    assert_eq!(error.kind, ConfigErrorKind::UnknownName);
    let remedy = "did you mean `velocity_flat`";
    assert_error(&error, "configs/tasks", "task `velocity_flt`", "no task", remedy);
    assert!(!error.remedy.contains("velocity_obstacles"), "{error}");
    let error = library.task("zzzz", &[]).unwrap_err();
    assert!(error.remedy.contains("Velocity-Flat-HeteroQuadruped-v0"), "{error}");
    // Isaac Lab's prefix is left out where nothing else has the name
    assert_eq!(library.task("Isaac-Velocity-Flat-Spot-v0", &[]).unwrap().config.name, "Velocity-Flat-Spot-v0");
    let error = library.task("Isaac-Velocity-Flat-Spott-v0", &[]).unwrap_err();
    assert_error(&error, "configs/tasks", "task `Isaac-Velocity-Flat-Spott-v0`", "no task", "did you mean");
    let error = library.robot("unitree_g02").unwrap_err();
    assert_error(&error, "configs/robots", "robot `unitree_g02`", "no robot", "`unitree_go2`");
    let error = library.train("flatt", &[]).unwrap_err();
    assert_eq!(error.kind, ConfigErrorKind::UnknownName);
    let error = library.task("/nowhere/x.toml", &[]).unwrap_err();
    assert_eq!(error.kind, ConfigErrorKind::Unreadable);
    assert_error(&error, "/nowhere/x.toml", "file", "cannot be read", "check the path");
    let error = Library::new(vec!["/nowhere".into()]).robots().unwrap_err();
    assert_error(&error, "/nowhere", "file", "no such folder", "check the path");
}

#[test]
fn files_that_are_no_configs_are_not_read_to_their_end() {
    let root = Root::new("large_files");
    let file = root.write("configs/robots/large.toml", "");
    fs::File::options().write(true).open(&file).unwrap().set_len((64 << 20) + 1).unwrap();
    let error = Library::new(Vec::new()).robot(&file).unwrap_err();
    assert_error(&error, &file, "file", "larger than 64 MiB", "check the path");
    assert_eq!(error.kind, ConfigErrorKind::Unreadable);

    fs::remove_file(&file).unwrap();

    // one that the robot's config names
    let urdf = root.write("large.urdf", "");
    fs::File::options().write(true).open(&urdf).unwrap().set_len((64 << 20) + 1).unwrap();
    let (error, _) = root.robot_error("spot", "urdf = \"large.urdf\"");
    assert!(error.to_string().contains("large.urdf") && error.problem.contains("larger than 64 MiB"), "{error}");
}

#[test]
fn numbers_that_no_simulation_can_use_are_refused() {
    for (text, element, problem, remedy) in [
        ("sim.decimation=1000000000", "sim.decimation", "1000000000", "1 to 1000"),
        ("sim.decimation=1001", "sim.decimation", "1001", "1 to 1000"),
        ("sim.decimation=0", "sim.decimation", "0", "1 to 1000"),
        ("sim.dt=1e-320", "sim.dt", "too short", "1e-6"),
        ("sim.dt=inf", "sim.dt", "not finite", "finite"),
        ("sim.dt=1e308", "sim.dt", "1e308 s is too long", "1 or below"),
        ("sim.gravity=[0,0,1e300]", "sim.gravity[2]", "1e300 is beyond 100 m/s^2", "from -100 to 100 m/s^2"),
        ("sim.episode_length_s=1e-320", "sim.episode_length_s", "1e-320 is below 1e-6 s", "from 1e-6 to 1e9 s"),
        ("sim.episode_length_s=0.02", "sim.episode_length_s", "single control step", "two control steps"),
        ("scene.grid_cell=1e308", "scene.grid_cell", "1e308 is beyond 10000 m", "from 0.001 to 10000 m"),
        ("rewards.spot.gait.std=-1e39", "rewards.spot.gait.std", "1e39 is beyond all", "from -1e9 to 1e9"),
        ("robot_material.static_friction=-0.5", "robot_material.static_friction", "negative", "0 or above"),
        ("robot_material.rolling_friction=-0.01", "robot_material.rolling_friction", "negative", "0 or above"),
        ("scene.ground.torsional_friction=11", "scene.ground.torsional_friction", "beyond 10 m", "from 0 to 10 m"),
        ("rewards.spot.gait.weight=-1e39", "rewards.spot.gait.weight", "-1e39 is below -1e6", "from -1e6 to 1e6"),
        ("terminations.base_contact.threshold=1e308", "terminations.base_contact.threshold", "1e308", "1e9"),
        ("robots=['']", "robots[0]", "empty", "a robot's name"),
        (
            "commands.base_velocity.lin_vel_x=[-1e30,1.0]",
            "commands.base_velocity.lin_vel_x",
            "beyond 1000",
            "-1000 to 1000",
        ),
        (
            "commands.base_velocity.lin_vel_y=[-1.0,1001.0]",
            "commands.base_velocity.lin_vel_y",
            "beyond 1000",
            "-1000 to 1000",
        ),
        (
            "commands.base_velocity.ang_vel_z=[0.0,1e4]",
            "commands.base_velocity.ang_vel_z",
            "beyond 1000",
            "-1000 to 1000",
        ),
    ] {
        assert_error(&override_error(text), "--set", element, problem, remedy);
    }
}
