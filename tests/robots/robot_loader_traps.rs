//! One small URDF for each trap that real robot descriptions set a loader: it is read rightly, or
//! refused with an error that names file, element and remedy, and never silently misread.

use std::collections::BTreeMap;
use std::path::Path;

use polypod::dynamics::{MAX_DEPTH, Parameters};
use polypod::robot::{
    Articulation, Coupled, Geometry, JointKind, LoadOptions, Model, RobotError, Topic, detect, load, load_str,
};

use crate::common::fall;

const MASS: &str = r#"<inertial><mass value="1"/>
    <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial>"#;
const LIMIT: &str = r#"<limit lower="-1" upper="2" effort="3" velocity="4"/>"#;

fn read(text: &str) -> Result<Model, RobotError> {
    load_str(text, Path::new("trap.urdf"), &LoadOptions::default())
}

fn robot(body: &str) -> String {
    format!("<robot name=\"trap\">{body}</robot>")
}

fn link(name: &str) -> String {
    format!("<link name=\"{name}\">{MASS}</link>")
}

fn joint(name: &str, kind: &str, parent: &str, child: &str, inside: &str) -> String {
    format!(r#"<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{inside}</joint>"#)
}

/// Two links and one joint between them.
fn pair(kind: &str, inside: &str) -> String {
    robot(&(link("a") + &link("b") + &joint("j", kind, "a", "b", inside)))
}

/// A base and, fixed to it, a link with this inside.
fn with_part(inside: &str) -> String {
    let part = format!("<link name=\"part\">{inside}</link>");
    robot(&(link("a") + &part + &joint("f", "fixed", "a", "part", "")))
}

fn loaded(text: &str) -> Model {
    read(text).unwrap_or_else(|error| panic!("{error}"))
}

/// Loads `text`, which must draw exactly one warning that holds these words.
fn warned(text: &str, words: &[&str]) -> Model {
    let model = loaded(text);
    assert_eq!(model.warnings.len(), 1, "{:?}", model.warnings);
    assert_words(&model.warnings[0].to_string(), words);
    model
}

/// `text` must be refused with these words, file first and remedy last.
fn refused(text: &str, words: &[&str]) -> RobotError {
    match read(text) {
        Ok(model) => panic!("was read as {model:?}, expected {words:?}"),
        Err(error) => {
            assert_words(&error.to_string(), words);
            assert!(!error.diagnosis().remedy.is_empty());
            error
        }
    }
}

fn assert_words(message: &str, words: &[&str]) {
    assert!(message.starts_with("trap.urdf: "), "{message}");
    for word in words {
        assert!(message.contains(word), "{message:?} lacks {word:?}");
    }
}

#[test]
fn the_text_must_be_a_urdf() {
    let error = refused("<robot>\n <link name='a'></robot>", &["line 2", "column", "not well-formed XML"]);
    assert!(matches!(error, RobotError::Syntax(_)));
    refused("", &["not well-formed XML"]);
    refused("<mujoco model='m'/>", &["<mujoco>", "the root element of a URDF is <robot>", "export"]);
    refused(
        r#"<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
           <xacro:property name="x" value="1"/></robot>"#,
        &["<property> on line 2", "xacro", "expand"],
    );
    refused("<robot>\n<xacro:include filename='a'/></robot>", &["line 2", "expand xacro first: `xacro "]);
    refused("<robot name='r'/>", &["has no links", "add a <link>"]);
}

#[test]
fn leftover_xacro_is_named_in_any_attribute() {
    let origin = |inside: &str| pair("fixed", &format!("<origin {inside}/>"));
    let mesh = "<visual><geometry><mesh filename='$(find my_pkg)/foot.stl'/></geometry></visual>";
    for (text, words) in [
        (origin("rpy='0 ${pi/2} 0'"), ["<origin> on line ", "rpy=\"0 ${pi/2} 0\""]),
        (robot(&link("a").replace("value=\"1\"", "value=\"${m}\"")), ["<mass> on line ", "value=\"${m}\""]),
        (with_part(mesh), ["<mesh> on line ", "$(find my_pkg)"]),
        (robot(&link("${prefix}box")), ["<link> on line ", "${prefix}box"]),
        (robot(&link("a")).replace("trap", "$(arg name)"), ["<robot> on line ", "name=\"$(arg name)\""]),
        // in elements that say nothing of the body, and in names of joints' ends and materials
        (robot(&(link("a") + "<gazebo reference='${side}_foot'/>")), ["<gazebo> on line ", "${side}_foot"]),
        (robot(&(link("a") + &link("b") + &joint("j", "fixed", "${base}", "b", ""))), ["<parent> on line ", "${base}"]),
        (robot(&(link("a") + "<material name='xacro:grey'/>")), ["<material> on line ", "xacro:grey"]),
    ] {
        let error = refused(&text, &words);
        assert_words(
            &error.to_string(),
            &["not expanded", "expand xacro first: `xacro robot.urdf.xacro > robot.urdf`"],
        );
    }
    // the prefix that xacro leaves on the root is none
    loaded(&robot(&link("a")).replace("<robot", "<robot xmlns:xacro='http://www.ros.org/wiki/xacro'"));
}

#[test]
fn other_formats_are_named() {
    let folder = std::env::temp_dir().join(format!("polypod-formats-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let cases: [(&[u8], &str, &str); 9] = [
        (b"PXR-USDC\0\0\xff", "binary USD", "export the robot as URDF"),
        (b"#usda 1.0\n(\n)\n", "USD file", "export the robot as URDF"),
        (b"PK\x03\x04\x14\0robot.usdc\xff", "USD archive", "export the robot as URDF"),
        (b"PK\x03\x04\x14\0robot.urdf\xff", "zip archive", "unpack it"),
        (b"%PDF-1.7\n\xff", "PDF document", "name the robot's URDF file"),
        (b"\x1f\x8b\x08\0", "gzip archive", "unpack it"),
        (b"glTF\x02\0\0\0", "glTF mesh", "name the URDF"),
        (b"version https://git-lfs.github.com/spec/v1\n", "Git LFS", "git lfs pull"),
        (b"<sdf version='1.7'/>", "<sdf>", "this is an SDF"),
    ];
    for (bytes, words, remedy) in cases {
        let file = folder.join("robot.usd");
        std::fs::write(&file, bytes).unwrap();
        let error = load(&file, &LoadOptions::default()).unwrap_err().to_string();
        assert!(error.contains(words) && error.contains(remedy) && error.contains("robot.usd"), "{error}");
    }
    std::fs::remove_dir_all(&folder).unwrap();
    // a file with neither magic nor XML is reported by the parser
    refused("robot: {name: dog}", &["not well-formed XML"]);
    refused("<COLLADA/>", &["COLLADA mesh"]);
}

#[test]
fn what_costs_more_than_its_length_is_refused() {
    let attributes: String = (0..300_000).map(|i| format!(" a{i}=''")).collect();
    refused(
        &robot(&format!("<link name='a'{attributes}/>")),
        &["line 1, column 20", "300001 attributes of one element"],
    );
    refused(&robot(&(0..5000).map(|i| link(&format!("l{i}"))).collect::<String>()), &["more than 4096 links"]);
    let shape = "<collision><geometry><sphere radius='1'/></geometry></collision>";
    refused(&with_part(&shape.repeat(4097)), &["link \"part\", <collision>", "more than 4096 collision shapes"]);
    // names are compared with all others where one is unknown
    let long = "x".repeat(1 << 20);
    refused(&robot(&link(&long)), &["<link> on line 1", "1048576 bytes"]);
    let error =
        refused(&robot(&(link("a") + &joint("j", "fixed", "a", &long, ""))), &["does not exist", "known are: a"]);
    assert!(matches!(error, RobotError::Structure(_)));
    // links that come before what they hang on, in the order of the file where that can be
    let count = 4000;
    let links: String = (0..count).map(|i| link(&format!("l{i}"))).collect();
    let joints: String = (1..count)
        .rev()
        .map(|i| joint(&format!("j{i}"), "revolute", &format!("l{}", (i - 1) / 2), &format!("l{i}"), LIMIT))
        .collect();
    let model = loaded(&robot(&(links + &joints)));
    assert_eq!(model.joints.len(), count - 1);
    let names: Vec<&str> = model.joints[..4].iter().map(|joint| joint.name.as_str()).collect();
    assert_eq!(names, ["j2", "j6", "j14", "j30"]);
}

#[test]
fn a_missing_file_is_named() {
    let error = load(Path::new("no/such.urdf"), &LoadOptions::default()).unwrap_err();
    assert!(matches!(error, RobotError::Read(_)));
    assert!(error.to_string().starts_with("no/such.urdf: "));
}

#[test]
fn names_are_unique_among_links_and_among_joints() {
    refused(&robot(&(link("a") + &link("a"))), &["link \"a\"", "defined twice", "rename"]);
    let twice = joint("j", "fixed", "a", "b", "") + &joint("j", "fixed", "a", "c", "");
    refused(&robot(&(link("a") + &link("b") + &link("c") + &twice)), &["joint \"j\"", "defined twice"]);
    refused(&robot("<link/>"), &["<link> on line 1", "no name"]);
    // a link and a joint may share one
    let shared = link("a") + &link("b") + &joint("b", "fixed", "a", "b", "");
    assert_eq!(loaded(&robot(&shared)).links[0].merged, ["b"]);
}

#[test]
fn joints_form_one_tree() {
    refused(
        &robot(&(link("base") + &link("leg") + &joint("j", "fixed", "bse", "leg", ""))),
        &["joint \"j\"", "parent link \"bse\"", "did you mean \"base\""],
    );
    refused(
        &robot(&(link("a") + &joint("j", "fixed", "a", "nowhere", ""))),
        &["joint \"j\"", "child link \"nowhere\"", "known are: a"],
    );
    let three = link("a") + &link("b") + &link("c");
    refused(
        &robot(&(three.clone() + &joint("i", "fixed", "a", "c", "") + &joint("j", "fixed", "b", "c", ""))),
        &["link \"c\"", "two joints, \"i\" and \"j\""],
    );
    refused(&robot(&three), &["3 root links: a, b, c"]);
    refused(
        &robot(&(link("a") + &link("b") + &joint("i", "fixed", "a", "b", "") + &joint("j", "fixed", "b", "a", ""))),
        &["form a loop"],
    );
    refused(
        &robot(&(three + &joint("i", "fixed", "b", "c", "") + &joint("j", "fixed", "c", "b", ""))),
        &["link \"b\"", "loop", "does not hang on the root"],
    );
}

#[test]
fn numbers_are_numbers() {
    for (xyz, what) in [
        ("1 2", "two"),
        ("1 2 3 4", "four"),
        ("1 x 2 3", "a word among three"),
        ("1,2,3", "commas"),
        ("0 0 nan", "not a number"),
        ("0 0 1e999", "overflow"),
        ("", "nothing"),
    ] {
        let text = pair("fixed", &format!("<origin xyz=\"{xyz}\"/>"));
        let error = refused(&text, &["joint \"j\", <origin xyz>", "3 finite number(s)"]);
        assert!(matches!(error, RobotError::Value(_)), "{what}");
    }
    refused(
        &with_part(&MASS.replace("value=\"1\"", "value=\"-1\"")),
        &["link \"part\", <mass value>", "negative mass -1"],
    );
    refused(&with_part("<inertial><mass value=\"1\"/></inertial>"), &["link \"part\"", "<inertial> lacks <inertia>"]);
    refused(&pair("revolute", "<limit lower=\"a\"/>"), &["joint \"j\", <limit lower>", "\"a\""]);
    refused(&pair("fixed", "<origin/><origin xyz='0 0 1'/>"), &["<origin>", "more than once"]);
    refused(
        "<robot><link name='a'/><link name='b'/><joint name='j' type='fixed'><parent link='a'/></joint></robot>",
        &["joint \"j\"", "lacks <child>"],
    );
}

#[test]
fn origins_may_be_spaced_out_partial_or_missing() {
    let spaced = loaded(&pair("revolute", &format!("<origin  xyz=' 1   2\n 3 '/>{LIMIT}")));
    assert_eq!(spaced.joints[0].origin.translation.to_array(), [1.0, 2.0, 3.0]);
    let turned = loaded(&pair("revolute", &format!("<origin rpy='0 0 1.5707963267948966'/>{LIMIT}")));
    assert!((turned.joints[0].origin.rotation.x_axis.y - 1.0).abs() < 1e-15);
    let none = loaded(&pair("revolute", LIMIT));
    assert_eq!(none.joints[0].origin, polypod::robot::Pose::IDENTITY);
}

#[test]
fn quaternions_need_the_version_that_has_them() {
    let inside = format!("<origin quat_xyzw='0 0 1 0'/>{LIMIT}");
    refused(&pair("revolute", &inside), &["<origin quat_xyzw>", "version=\"1.1\""]);
    let versioned = pair("revolute", &inside).replace("<robot", "<robot version='1.1'");
    let x_axis = loaded(&versioned).joints[0].origin.rotation.x_axis;
    assert!((x_axis.x + 1.0).abs() < 1e-12, "{x_axis}");
    let unknown = pair("revolute", LIMIT).replace("<robot", "<robot version='7'");
    warned(&unknown, &["<robot version>", "\"7\""]);
}

#[test]
fn missing_limits_are_infinite() {
    let none = warned(&pair("revolute", ""), &["joint \"j\"", "-inf .. inf", "<limit>"]);
    let j = &none.joints[0];
    assert_eq!((j.lower, j.upper), (f64::NEG_INFINITY, f64::INFINITY));
    assert_eq!((j.effort, j.velocity), (f64::INFINITY, f64::INFINITY));
    let half = warned(&pair("revolute", "<limit lower='-1' effort='1'/>"), &["-1 .. inf"]);
    assert_eq!(half.joints[0].velocity, f64::INFINITY);
    let turning = loaded(&pair("continuous", LIMIT));
    assert!(turning.warnings.is_empty());
    assert_eq!(turning.joints[0].kind, JointKind::Continuous);
    assert_eq!(turning.joints[0].upper, f64::INFINITY);
    assert_eq!(turning.joints[0].effort, 3.0);
}

#[test]
fn limits_make_sense() {
    let limit = |values: &str| pair("revolute", &format!("<limit {values}/>"));
    refused(
        &limit("lower='1' upper='-1' effort='1' velocity='1'"),
        &["joint \"j\"", "lower limit 1 is above its upper limit -1"],
    );
    refused(&limit("lower='-1' upper='1' effort='-5' velocity='1'"), &["negative effort -5"]);
    refused(&limit("lower='inf' upper='inf' effort='1' velocity='1'"), &["joint \"j\"", "leave no position"]);
    // the file's numbers, in few digits
    refused(&limit("lower='2e300' upper='3e300' effort='1' velocity='1'"), &["2e300 .. 3e300", "within 1000"]);
    refused(&limit("lower='1e300' upper='-1e300' effort='1' velocity='1'"), &["1e300", "-1e300", "swap them"]);
    refused(
        &pair("revolute", &format!("{LIMIT}<dynamics damping='1e300'/>")),
        &["joint \"j\"", "damping", "overflows"],
    );
    warned(&limit("lower='-1' upper='1' effort='0' velocity='1'"), &["joint \"j\"", "zero effort", "cannot be driven"]);
    warned(&limit("lower='-1' upper='1' effort='1' velocity='0'"), &["zero velocity"]);
    let extra = loaded(&limit("lower='-1' upper='1' effort='1' velocity='1' command_effort='x' current='40'"));
    assert!(extra.warnings.is_empty());
    refused(&pair("revolute", &format!("{LIMIT}<dynamics damping='-1'/>")), &["negative damping -1"]);
}

#[test]
fn axes_are_unit_vectors_where_it_matters() {
    assert_eq!(loaded(&pair("revolute", LIMIT)).joints[0].axis.to_array(), [1.0, 0.0, 0.0]);
    assert!(loaded(&pair("fixed", "<axis xyz='0 0 0'/>")).warnings.is_empty());
    refused(
        &pair("revolute", &format!("{LIMIT}<axis xyz='0 0 0'/>")),
        &["joint \"j\", <axis xyz>", "no direction", "unit vector"],
    );
    let long = warned(&pair("revolute", &format!("{LIMIT}<axis xyz='0 -2 0'/>")), &["length 2", "normalised"]);
    assert_eq!(long.joints[0].axis.to_array(), [0.0, -1.0, 0.0]);
    for size in ["1e-161", "1e-300", "1e200"] {
        let odd = loaded(&pair("revolute", &format!("{LIMIT}<axis xyz='0 0 -{size}'/>")));
        assert_eq!(odd.joints[0].axis.to_array(), [0.0, 0.0, -1.0], "{size}");
    }
}

#[test]
fn joints_that_are_not_modelled_are_refused() {
    for kind in ["floating", "planar", "spherical"] {
        let error = refused(&pair(kind, ""), &["joint \"j\"", kind, "not modelled"]);
        assert!(matches!(error, RobotError::Unsupported(_)));
    }
    refused(&pair("Revolute", LIMIT), &["unknown joint type \"Revolute\"", "did you mean \"revolute\""]);
    let mimic = link("a")
        + &link("b")
        + &link("c")
        + &joint("j", "revolute", "a", "b", LIMIT)
        + &joint("k", "revolute", "a", "c", &format!("{LIMIT}<mimic joint='j'/>"));
    refused(&robot(&mimic), &["joint \"k\"", "mimics \"j\"", "lock the joint"]);
    let locked = LoadOptions { locked_joints: BTreeMap::from([("k".to_string(), 0.0)]), ..LoadOptions::default() };
    let model = load_str(&robot(&mimic), Path::new("trap.urdf"), &locked).unwrap();
    assert_eq!(model.joints.len(), 1);
}

#[test]
fn joints_that_mimic_others_are_held_where_the_caller_asks_for_it() {
    let held = |follower: &str, kind: &str, locked: &[(&str, f64)]| {
        let limit = "<limit lower='0.2' upper='0.9' effort='1' velocity='1'/>";
        let text = robot(
            &(link("a")
                + &link("b")
                + &link("c")
                + &link("d")
                + &joint("j", "prismatic", "a", "b", limit)
                + &joint(
                    "k",
                    kind,
                    "a",
                    "c",
                    &format!("<limit lower='-1' upper='1' effort='1' velocity='1'/>{follower}"),
                )
                + &joint(
                    "l",
                    "prismatic",
                    "a",
                    "d",
                    "<limit lower='-1' upper='1'/><mimic joint='k' multiplier='-1'/>",
                )),
        );
        let locked_joints = locked.iter().map(|(joint, position)| (joint.to_string(), *position)).collect();
        let options = LoadOptions { locked_joints, coupled: Coupled::Held, ..LoadOptions::default() };
        load_str(&text, Path::new("trap.urdf"), &options).unwrap()
    };
    // the leader rests at 0.2, its limit next to zero
    let model = held("<mimic joint='j' multiplier='2' offset='0.1'/>", "prismatic", &[]);
    assert_eq!(model.joints.len(), 1);
    let of = |model: &Model, joint: &str| -> String {
        let element = format!("joint \"{joint}\"");
        model.warnings.iter().find(|w| w.element == element && w.topic == Topic::Coupled).unwrap().to_string()
    };
    assert_words(&of(&model, "k"), &["mimics \"j\"", "held at 0.5", "remove <mimic>"]);
    assert_words(&of(&model, "l"), &["mimics \"k\"", "held at -0.5"]);
    // fixed at 0.5 along x and, for the other, 0.5 against it: equal masses at 0, 0.5 and -0.5
    assert!(model.links[0].com.length() < 1e-15);
    // as the leader is held, within the joint's own limits, and where there is no such leader
    assert_words(&of(&held("<mimic joint='j'/>", "prismatic", &[("j", 0.7)]), "k"), &["held at 0.7"]);
    assert_words(&of(&held("<mimic joint='j' multiplier='9'/>", "revolute", &[]), "k"), &["held at 1;"]);
    assert_words(&of(&held("<mimic joint='nothing'/>", "revolute", &[]), "k"), &["held at 0;"]);
    assert_words(&of(&held("<mimic joint='l'/>", "revolute", &[]), "k"), &["mimics \"l\"", "held at 0;"]);
}

#[test]
fn an_empty_floating_root_is_dropped() {
    let text = robot(
        &("<link name='world'/>".to_string()
            + &link("base")
            + &link("leg")
            + &joint("free", "floating", "world", "base", "")
            + &joint("hip", "revolute", "base", "leg", LIMIT)),
    );
    let model = warned(&text, &["joint \"free\"", "\"world\"", "\"base\" is the base"]);
    assert_eq!(model.links[0].name, "base");
    assert_eq!(model.joints.len(), 1);
}

#[test]
fn links_come_in_any_order() {
    let text = robot(
        &(joint("knee", "revolute", "thigh", "shank", LIMIT)
            + &link("shank")
            + &joint("other", "revolute", "base", "head", LIMIT)
            + &link("head")
            + &joint("hip", "revolute", "base", "thigh", LIMIT)
            + &link("thigh")
            + &link("base")),
    );
    let model = loaded(&text);
    let links: Vec<&str> = model.links.iter().map(|link| link.name.as_str()).collect();
    assert_eq!(links, ["base", "head", "thigh", "shank"]);
    let joints: Vec<&str> = model.joints.iter().map(|joint| joint.name.as_str()).collect();
    assert_eq!(joints, ["other", "hip", "knee"]);
    let parents: Vec<Option<usize>> = (0..4).map(|link| model.parent(link)).collect();
    assert_eq!(parents, [None, Some(0), Some(0), Some(2)]);
}

#[test]
fn sensors_without_mass_merge() {
    let nothing = "<inertial><mass value='0'/>\
        <inertia ixx='0' ixy='0' ixz='0' iyy='0' iyz='0' izz='0'/></inertial>";
    for inside in ["", nothing] {
        let model = loaded(&with_part(inside));
        assert!(model.warnings.is_empty(), "{:?}", model.warnings);
        assert_eq!(model.links[0].merged, ["part"]);
        assert_eq!(model.total_mass(), 1.0);
    }
    // the mass of the base may sit in a fixed child
    let hollow = "<link name='base'/>".to_string() + &link("inside") + &joint("f", "fixed", "base", "inside", "");
    assert_eq!(loaded(&robot(&hollow)).links[0].mass, 1.0);
    warned(&with_part(&MASS.replace("value=\"1\"", "value=\"0\"")), &["link \"part\"", "an inertia, but no mass"]);
}

#[test]
fn what_moves_has_a_mass_and_a_sound_inertia() {
    let moving = |inside: &str| {
        let part = format!("<link name='b'>{inside}</link>");
        robot(&(link("a") + &part + &joint("j", "revolute", "a", "b", LIMIT)))
    };
    let error = refused(&moving(""), &["link \"b\"", "has a mass", "<inertial>"]);
    assert!(matches!(error, RobotError::Inertia(_)));
    refused(&robot("<link name='a'/>"), &["link \"a\"", "has a mass"]);
    refused(&moving(&MASS.replace("0.1", "0")), &["link \"b\"", "not positive definite"]);
    refused(&moving(&MASS.replace("ixy=\"0\"", "ixy=\"0.2\"")), &["link \"b\"", "not positive definite"]);
    let flat = MASS.replace("izz=\"0.1\"", "izz=\"0.3\"");
    warned(&moving(&flat), &["link \"b\"", "triangle inequality"]);
    // on a part that is merged, it is only worth a warning
    let singular = MASS.replace("\"0\"", "\"0.001\"").replace("\"0.1\"", "\"0.001\"");
    warned(&with_part(&singular), &["link \"part\"", "not positive definite", "merged as it is"]);
}

#[test]
fn fixed_parts_merge_by_the_parallel_axis_theorem() {
    // a rod of 2 kg along the part's x, turned along the base's y, 1 m ahead of the 1 kg base
    let rod = "<inertial><origin rpy='0 0 1.5707963267948966'/><mass value='2'/>\
        <inertia ixx='0.01' ixy='0' ixz='0' iyy='0.5' iyz='0' izz='0.5'/></inertial>";
    let text = robot(
        &(link("a")
            + &format!("<link name='rod'>{rod}</link>")
            + &joint("f", "fixed", "a", "rod", "<origin xyz='3 0 0'/>")),
    );
    let base = &loaded(&text).links[0];
    assert_eq!(base.mass, 3.0);
    assert_eq!(base.com.to_array(), [2.0, 0.0, 0.0]);
    // 1 kg at 2 m and 2 kg at 1 m: 6 kg m^2 across
    let expected = [[0.6, 0.0, 0.0], [0.0, 6.11, 0.0], [0.0, 0.0, 6.6]];
    for (column, wanted) in base.inertia.to_cols_array_2d().iter().zip(expected) {
        for (value, wanted) in column.iter().zip(wanted) {
            assert!((value - wanted).abs() < 1e-12, "{}", base.inertia);
        }
    }
}

#[test]
fn locked_joints_hold_their_position() {
    let text = robot(
        &(link("a")
            + &link("b")
            + &link("c")
            + &joint("pan", "revolute", "a", "b", &format!("{LIMIT}<axis xyz='0 0 1'/>"))
            + &joint("tilt", "revolute", "b", "c", &format!("{LIMIT}<origin xyz='1 0 0'/>"))),
    );
    let lock = |name: &str, position: f64| {
        let options =
            LoadOptions { locked_joints: BTreeMap::from([(name.to_string(), position)]), ..LoadOptions::default() };
        load_str(&text, Path::new("trap.urdf"), &options)
    };
    let model = lock("pan", std::f64::consts::FRAC_PI_2).unwrap();
    assert_eq!(model.links[0].merged, ["b"]);
    let origin = model.joints[0].origin;
    assert!((origin.translation - glam::DVec3::Y).length() < 1e-15);
    assert_eq!(lock("pan", 9.0).unwrap().warnings.len(), 1);
    let unknown = lock("pann", 0.0).unwrap_err().to_string();
    assert_words(&unknown, &["locked joint \"pann\"", "did you mean \"pan\""]);
    assert!(lock("pan", f64::NAN).is_err());
}

#[test]
fn contact_bodies_outlive_merging() {
    let sphere = "<collision><origin xyz='0 0 0.1'/><geometry><sphere radius='0.02'/></geometry></collision>";
    let text = robot(
        &(link("a")
            + &format!("<link name='shank'>{MASS}{sphere}</link><link name='foot'>{sphere}</link>")
            + &joint("knee", "revolute", "a", "shank", LIMIT)
            + &joint("sole", "fixed", "shank", "foot", "<origin xyz='0 0 -1'/>")
                .replace("<joint", "<joint dont_collapse='true'")),
    );
    let model = loaded(&text);
    assert!(model.warnings.is_empty());
    let bodies: Vec<(&str, usize)> = model.bodies.iter().map(|b| (b.name.as_str(), b.link)).collect();
    assert_eq!(bodies, [("shank", 1), ("foot", 1)]);
    assert_eq!(model.bodies[1].shapes[0].origin.translation.z, -0.9);
}

#[test]
fn shapes_have_sizes() {
    let collision = |shape: &str| with_part(&format!("<collision><geometry>{shape}</geometry></collision>"));
    let capsule = loaded(&collision("<capsule radius='0.1' length='0.5'/>"));
    assert_eq!(capsule.bodies[0].shapes[0].geometry, Geometry::Capsule { radius: 0.1, length: 0.5 });
    refused(&collision("<sphere radius='-1'/>"), &["link \"part\", <collision>, <sphere radius>", "-1"]);
    let flat = loaded(&collision("<sphere radius='0'/>"));
    assert!(flat.bodies.is_empty());
    let said = ["link \"part\", <collision>, <sphere radius>", "of length 0", "left out", "positive lengths"];
    assert_words(&flat.warnings[0].to_string(), &said);
    refused(&collision("<box size='1 1 -1'/>"), &["<box size>", "-1 is no length"]);
    refused(&collision("<cylinder radius='1'/>"), &["<cylinder> lacks \"length\""]);
    refused(&collision("<ball radius='1'/>"), &["unknown shape <ball>"]);
    refused(&collision(""), &["<geometry>", "no shape"]);
}

#[test]
fn meshes_are_found_without_ros() {
    let mesh = |name: &str| format!("<geometry><mesh filename='{name}'/></geometry>");
    let collision = |name: &str| with_part(&format!("<collision>{}</collision>", mesh(name)));
    let lost = warned(
        &collision("package://body/foot.stl"),
        &["link \"part\", <collision>", "\"package://body/foot.stl\" is not found", "package_dirs"],
    );
    assert!(lost.bodies.is_empty());
    warned(&collision("meshes/foot.stl"), &["meshes/foot.stl", "is not found", "put the file there"]);
    let visual = loaded(&with_part(&format!("<visual>{}</visual>", mesh("package://body/foot.dae"))));
    assert!(visual.warnings.is_empty());

    // in a folder that the options name, or in one with the package's name next to the URDF or
    // above it
    let meshes = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/urdf/meshes");
    let options =
        LoadOptions { package_dirs: BTreeMap::from([("body".to_string(), meshes.clone())]), ..LoadOptions::default() };
    let named = load_str(&collision("package://body/cube.stl"), Path::new("trap.urdf"), &options).unwrap();
    assert_eq!(named.bodies.len(), 1);
    let deep = meshes.join("../trap/robot.urdf");
    let above = load_str(&collision("package://meshes/cube.stl"), &deep, &LoadOptions::default()).unwrap();
    assert_eq!(above.bodies.len(), 1);
    // a folder is no mesh
    assert!(load_str(&collision("package://urdf/meshes"), &deep, &LoadOptions::default()).unwrap().bodies.is_empty());
}

#[test]
fn what_is_not_the_body_is_passed_over() {
    let text = format!(
        "<?xml version='1.1'?><!-- <link name='x'/> --><robot name='Käfer' xmlns='http://robot' xmlns:g='http://g'>
         <material name='灰'><color rgba='x'/></material><gazebo><joint name='j'/></gazebo>
         <transmission name='t'><joint name='j'/></transmission><g:link name='ghost'/>
         <link name='Rümpf &amp; \"Kopf\"'>{MASS}<visual><material name='1'/><material name='2'/></visual></link>
         </robot>"
    );
    let model = loaded(&text);
    assert!(model.warnings.is_empty(), "{:?}", model.warnings);
    assert_eq!(model.name, "Käfer");
    assert_eq!(model.links[0].name, "Rümpf & \"Kopf\"");
    warned(
        &robot(&(link("a") + "<loop_joint name='l'/><loop_joint name='m'/>")),
        &["<loop_joint> inside <robot> is not read (2 in the file)"],
    );
}

const CUBE_SENSOR: &str = "<inertial><mass value='0.1'/>\
    <inertia ixx='8.7e-6' ixy='0' ixz='0' iyy='6.7e-4' iyz='0' izz='1.37e-3'/></inertial>";

#[test]
fn sensors_that_no_body_could_be_merge_into_a_sound_base() {
    let parts: String = (0..4)
        .map(|i| {
            format!("<link name='camera{i}'>{CUBE_SENSOR}</link>")
                + &joint(&format!("camera{i}_joint"), "fixed", "base", &format!("camera{i}"), "<origin xyz='0.3 0 0'/>")
        })
        .collect();
    let model = loaded(&robot(
        &("<link name='base'/>".to_string() + &link("inside") + &joint("f", "fixed", "base", "inside", "") + &parts),
    ));
    assert_eq!(model.links[0].merged.len(), 5);
    assert!((model.total_mass() - 1.4).abs() < 1e-12);
    // each part is named, the base is not: together they are sound
    let warned: Vec<&str> = model.warnings.iter().map(|warning| warning.element.as_str()).collect();
    assert_eq!(warned, ["link \"camera0\"", "link \"camera1\"", "link \"camera2\"", "link \"camera3\""]);
    assert!(model.warnings.iter().all(|warning| warning.problem.contains("triangle inequality")));
}

#[test]
fn specks_of_mass_weigh_next_to_nothing() {
    let speck = "<inertial><mass value='4.19e-15'/>\
        <inertia ixx='0' ixy='0' ixz='0' iyy='0' iyz='0' izz='0'/></inertial>";
    let model = loaded(&with_part(speck));
    assert!(model.warnings.is_empty(), "{:?}", model.warnings);
    assert!((model.total_mass() - 1.0).abs() < 1e-14);
    let moving =
        robot(&(link("a") + &format!("<link name='b'>{speck}</link>") + &joint("j", "revolute", "a", "b", LIMIT)));
    refused(&moving, &["link \"b\"", "mass of 4.19e-15 kg"]);
}

#[test]
fn an_inertial_frame_may_be_turned() {
    // a rod along the inertial frame's x, which lies along the link's y
    let rod = "<inertial><origin xyz='0 0 1' rpy='0 0 1.5707963267948966'/><mass value='2'/>\
        <inertia ixx='0.01' ixy='0' ixz='0' iyy='0.5' iyz='0' izz='0.5'/></inertial>";
    let base = &loaded(&robot(&format!("<link name='rod'>{rod}</link>"))).links[0];
    assert_eq!(base.com.to_array(), [0.0, 0.0, 1.0]);
    for (value, wanted) in base.inertia.to_cols_array().iter().zip([0.5, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.5]) {
        assert!((value - wanted).abs() < 1e-12, "{}", base.inertia);
    }
}

#[test]
fn frames_of_expanded_robots_are_named() {
    let text = robot(&(link("a") + "<frame name='f'/>" + &joint("j", "fixed", "a", "b", "<frame/>") + &link("b")));
    let model = loaded(&text);
    let warnings: Vec<String> = model.warnings.iter().map(ToString::to_string).collect();
    assert_eq!(warnings.len(), 2, "{warnings:?}");
    for (warning, words) in
        warnings.iter().zip([["<frame> inside <joint>", "joint \"j\""], ["<frame> inside <robot>", "1"]])
    {
        assert_words(warning, &words);
    }
}

#[test]
fn wheels_turn_and_lifts_slide() {
    let text = robot(
        &(link("base")
            + &link("wheel")
            + &link("mast")
            + &joint("axle", "continuous", "base", "wheel", "<axis xyz='0 1 0'/>")
            + &joint("lift", "prismatic", "base", "mast", &format!("{LIMIT}<axis xyz='0 0 1'/>"))),
    );
    let model = loaded(&text);
    let joint_kinds: Vec<JointKind> = model.joints.iter().map(|joint| joint.kind).collect();
    assert_eq!(joint_kinds, [JointKind::Continuous, JointKind::Prismatic]);
    let poses = model.forward_kinematics(&[std::f64::consts::PI, 0.5]);
    assert!((poses[1].rotation.x_axis.x + 1.0).abs() < 1e-12);
    assert_eq!(poses[2].translation.to_array(), [0.0, 0.0, 0.5]);
}

#[test]
fn a_robot_may_have_no_joints() {
    let model = loaded(&robot(&link("stone")));
    assert_eq!((model.links.len(), model.joints.len()), (1, 0));
    let error = detect(&model, &BTreeMap::new(), &BTreeMap::new()).unwrap_err().to_string();
    assert_words(&error, &["0 legs", "no chains of moving joints"]);
}

/// A base with four legs of these joints, and more.
fn legged(kind: &str, axes: &[&str], more: &str) -> String {
    let mut text = link("base");
    for (leg, x, y) in [("lf", 1, 1), ("rf", 1, -1), ("lh", -1, 1), ("rh", -1, -1)] {
        let mut parent = "base".to_string();
        for (i, axis) in axes.iter().enumerate() {
            let child = format!("{leg}{i}");
            let origin = if i == 0 { format!("{x} {y} 0") } else { format!("0 {} -0.5", 0.1 * f64::from(y)) };
            let inside = format!("<origin xyz='{origin}'/><axis xyz='{axis}'/>{LIMIT}");
            let foot = "<collision><origin xyz='0 0 -0.5'/><geometry><sphere radius='0.05'/></geometry></collision>";
            text += &format!("<link name='{child}'>{MASS}{}</link>", if i + 1 == axes.len() { foot } else { "" });
            text += &joint(&format!("{child}_joint"), kind, &parent, &child, &inside);
            parent = child;
        }
    }
    robot(&(text + more))
}

#[test]
fn legs_may_turn_without_limits() {
    let model = loaded(&legged("continuous", &["1 0 0", "0 1 0", "0 1 0"], ""));
    assert!(detect(&model, &BTreeMap::new(), &BTreeMap::new()).is_ok());
}

#[test]
fn one_joint_does_not_make_a_leg() {
    let model = loaded(&legged("revolute", &["0 1 0"], ""));
    assert_eq!(model.joints.len(), 4);
    let error = detect(&model, &BTreeMap::new(), &BTreeMap::new()).unwrap_err();
    assert!(matches!(error, RobotError::Roles(_)));
    assert_words(&error.to_string(), &["0 legs were found instead of 2, 4 or 6", "lf0_joint"]);
}

#[test]
fn an_arm_is_no_leg() {
    let mut arm = String::new();
    let mut parent = "base".to_string();
    for (i, axis) in ["0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0"].iter().enumerate() {
        let child = format!("arm{i}");
        arm += &link(&child);
        arm += &joint(
            &format!("arm{i}_joint"),
            "revolute",
            &parent,
            &child,
            &format!("<origin xyz='0.1 0 0.3'/><axis xyz='{axis}'/>{LIMIT}"),
        );
        parent = child;
    }
    let model = loaded(&legged("revolute", &["1 0 0", "0 1 0", "0 1 0"], &arm));
    assert_eq!(model.joints.len(), 17);
    let roles = detect(&model, &BTreeMap::new(), &BTreeMap::new()).unwrap();
    assert!(roles.joint_of_slot[..12].iter().all(|joint| !model.joints[*joint].name.starts_with("arm")));
    let feet: Vec<&str> = roles.foot_body.iter().map(|body| model.bodies[*body].name.as_str()).collect();
    assert_eq!(feet, ["lf2", "lh2", "rf2", "rh2"]);
}

#[test]
fn chains_are_no_longer_than_the_engine_can_solve() {
    let chain = |joints: usize| {
        let mut text = link("l0");
        for i in 1..=joints {
            text += &link(&format!("l{i}"));
            text += &joint(&format!("j{i}"), "revolute", &format!("l{}", i - 1), &format!("l{i}"), LIMIT);
        }
        robot(&text)
    };
    assert_eq!(loaded(&chain(MAX_DEPTH)).joints.len(), MAX_DEPTH);
    let error = refused(&chain(MAX_DEPTH + 1), &["joint \"j65\"", "number 65 in a chain", "locked_joints"]);
    assert!(matches!(error, RobotError::Unsupported(_)));
}

#[test]
fn numbers_that_overflow_are_refused() {
    let heavy = MASS.replace("value=\"1\"", "value=\"1e300\"");
    refused(&robot(&format!("<link name='a'>{heavy}</link>")), &["link \"a\"", "overflows"]);
    // nothing, in single precision
    let light = |mass: &str, moment: &str| {
        let inertia = format!("<inertia ixx='{moment}' ixy='0' ixz='0' iyy='{moment}' iyz='0' izz='{moment}'/>");
        robot(&format!("<link name='a'><inertial><mass value='{mass}'/>{inertia}</inertial></link>"))
    };
    refused(&light("1e-54", "0.01"), &["link \"a\"", "mass of 1e-54 kg", "kilograms"]);
    refused(&light("1e-7", "1e-9"), &["link \"a\"", "mass of 1e-7 kg"]);
    refused(&light("1", "1e-30"), &["link \"a\"", "moment below", "kg m^2"]);
    loaded(&light("1e-4", "1e-12"));
    let huge = "<collision><geometry><sphere radius='1e300'/></geometry></collision>";
    refused(&with_part(huge), &["<sphere radius>", "no length"]);
}

#[test]
fn lengths_of_a_robot_are_bounded() {
    let shape = |origin: &str, shape: &str| format!("<collision>{origin}<geometry>{shape}</geometry></collision>");
    let far = "<origin xyz='0.025 5903.24 -0.3'/>";
    let inertial = |xyz: &str| MASS.replacen("<inertial>", &format!("<inertial><origin xyz='{xyz}'/>"), 1);
    for (text, element, value) in [
        (pair("revolute", &format!("{far}{LIMIT}")), "joint \"j\", <origin xyz>", "5903.24 m"),
        (pair("fixed", far), "joint \"j\", <origin xyz>", "5903.24 m"),
        (with_part(&inertial("1e200 0 0")), "link \"part\", <inertial>, <origin xyz>", "1e200 m"),
        (with_part(&shape(far, "<sphere radius='1'/>")), "link \"part\", <collision>, <origin xyz>", "5903.24 m"),
        (with_part(&shape("", "<box size='1 1001 1'/>")), "link \"part\", <collision>, <box size>", "1001"),
        (with_part(&shape("", "<capsule radius='1' length='1e4'/>")), "<capsule length>", "10000"),
    ] {
        refused(&text, &[element, value, "no length of a robot", "metres"]);
    }
    // sum over the parts of a body
    let fixed = |count: usize, last: &str| {
        let links: String = (0..=count).map(|i| link(&format!("l{i}"))).collect();
        let joints = (0..count).map(|i| {
            let kind = if i + 1 == count { last } else { "fixed" };
            let inside = format!("<origin xyz='900 0 0'/>{LIMIT}");
            joint(&format!("j{i}"), kind, &format!("l{i}"), &format!("l{}", i + 1), &inside)
        });
        robot(&(links + &joints.collect::<String>()))
    };
    refused(&fixed(2, "revolute"), &["joint \"j1\"", "beyond 1000 m", "write metres"]);
    refused(&fixed(3, "fixed"), &["link \"l0\"", "centre of mass", "beyond 1000 m", "write metres"]);
    let sphere = shape("<origin xyz='900 0 0'/>", "<sphere radius='1'/>");
    let part = format!("<link name=\"part\">{sphere}</link>");
    let text = robot(&(link("a") + &part + &joint("f", "fixed", "a", "part", "<origin xyz='900 0 0'/>")));
    let model = loaded(&text);
    assert!(model.bodies.is_empty());
    assert_words(&model.warnings[0].to_string(), &["link \"part\", <collision>", "beyond 1000 m", "left out"]);
    // and what its joints do
    let chain = |count: usize, xyz: &dyn Fn(usize) -> [f64; 3]| {
        let links: String = (0..=count).map(|i| link(&format!("l{i}"))).collect();
        let joints = (0..count).map(|i| {
            let [x, y, z] = xyz(i);
            let inside = format!("<origin xyz='{x} {y} {z}'/><axis xyz='0 {} {}'/>{LIMIT}", i % 2, (i + 1) % 2);
            joint(&format!("j{i}"), "revolute", &format!("l{i}"), &format!("l{}", i + 1), &inside)
        });
        robot(&(links + &joints.collect::<String>()))
    };
    refused(&chain(10, &|_| [0.0, 0.0, 900.0]), &["link \"l10\"", "9000.0 m from the base", "write metres"]);
}

/// Steps a robot in free fall with turning joints; whether its state stays finite.
fn steps_finitely(model: &Model) -> bool {
    let articulation = Articulation::new(model, true, &[], None);
    let topology = &articulation.topology;
    let parameters = Parameters::<f32>::from_scalars(topology, &articulation.parameters);
    let state = fall(topology, &parameters, 0.1, 50);
    state.joint_position.iter().chain(&state.joint_velocity).chain(&state.rotation).all(|x| x.is_finite())
}

/// One offset, mass or inertia of a robot that is in another unit than the rest: it steps finitely,
/// or is refused.
#[test]
fn robots_that_are_read_step_finitely() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("assets/robots");
    let (mut taken, mut lost) = (0, 0);
    for name in ["spot", "unitree_go2", "phantomx"] {
        let text = std::fs::read_to_string(root.join(name).join("robot.urdf")).unwrap();
        for (attribute, values) in [
            ("<origin xyz=\"", ["1", "30", "100", "300", "1000"]),
            ("<mass value=\"", ["100", "1e4", "1e5", "1e7", "9e8"]),
        ] {
            for (index, (at, _)) in text.match_indices(attribute).enumerate().step_by(5) {
                let from = at + attribute.len();
                let to = from + text[from..].find('"').unwrap();
                let mut numbers: Vec<&str> = text[from..to].split_whitespace().collect();
                for value in values {
                    let place = index % numbers.len();
                    let old = std::mem::replace(&mut numbers[place], value);
                    let changed = format!("{}{}{}", &text[..from], numbers.join(" "), &text[to..]);
                    numbers[place] = old;
                    match read(&changed) {
                        Ok(model) => {
                            taken += 1;
                            assert!(steps_finitely(&model), "{name}: {attribute}{value} in place of {}", &text[at..to]);
                        }
                        Err(error) => {
                            lost += 1;
                            assert_words(&error.to_string(), &["single precision loses", "metres", "kilograms"]);
                        }
                    }
                }
            }
        }
    }
    assert!(taken > 50 && lost > 20, "{taken} taken, {lost} refused");
}
