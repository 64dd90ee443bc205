//! The frame of an empty root, such as a footprint on the ground, is not the body's: the base is
//! the first link that is a body.

use std::path::Path;

use polypod::config::Library;
use polypod::robot::{LoadOptions, Model, detect, load_str};

const ROBOT: &str = "unitree_go2";

fn urdf(robot: &str) -> String {
    Library::new(Vec::new()).robot(robot).unwrap().urdf_text
}

fn read(text: &str) -> Model {
    load_str(text, Path::new("r.urdf"), &LoadOptions::default()).unwrap_or_else(|error| panic!("{error}"))
}

/// The robot with these links and joints before its own, and `{root}` in them its root.
fn on(robot: &str, above: &str) -> Model {
    let text = urdf(robot);
    let at = text.find("<link").unwrap();
    let root = text[at..].split('"').nth(1).unwrap();
    read(&format!("{}{}{}", &text[..at], above.replace("{root}", root), &text[at..]))
}

fn fixed(name: &str, parent: &str, child: &str, origin: &str) -> String {
    format!(
        "<joint name='{name}' type='fixed'><origin {origin}/><parent link='{parent}'/><child link='{child}'/></joint>"
    )
}

/// All but the names of what was merged and what was noticed.
fn assert_same(model: &Model, plain: &Model) {
    let links =
        |model: &Model| -> Vec<_> { model.links.iter().map(|l| (l.name.clone(), l.mass, l.com, l.inertia)).collect() };
    assert_eq!(links(model), links(plain));
    assert_eq!(model.joints, plain.joints);
    assert_eq!(model.bodies, plain.bodies);
}

/// The one warning of a model.
fn warning(model: &Model) -> String {
    assert_eq!(model.warnings.len(), 1, "{:?}", model.warnings);
    model.warnings[0].to_string()
}

#[test]
fn a_footprint_leaves_every_bit_as_it_is() {
    for robot in [ROBOT, "unitree_h1", "phantomx"] {
        let plain = read(&urdf(robot));
        for (origin, words) in [
            ("xyz='0 0 0.3'", "0.300 m away;"),
            ("xyz='0.5 0 0'", "0.500 m away;"),
            ("rpy='0 0 1.5707963267948966'", "0.000 m away and turned by 90.0 degrees"),
            ("xyz='0 -0.2 0.1' rpy='3.1 0 0'", "turned by 177.6 degrees"),
        ] {
            let model =
                on(robot, &("<link name='foot_print'/>".to_string() + &fixed("f", "foot_print", "{root}", origin)));
            assert_same(&model, &plain);
            assert_eq!(model.links[0].merged.last().unwrap(), "foot_print");
            let warning = warning(&model);
            for words in ["link \"foot_print\"", &format!("\"{}\"", plain.links[0].name), words] {
                assert!(warning.contains(words), "{warning} lacks {words}");
            }
        }
    }
}

#[test]
fn chains_and_specks_of_mass_are_no_bodies_either() {
    let plain = read(&urdf(ROBOT));
    // several empty links, one of them with a sensor frame
    let chain = "<link name='world'/><link name='foot_print'/><link name='stand'/><link name='gps'/>".to_string()
        + &fixed("a", "world", "foot_print", "xyz='0 0 1'")
        + &fixed("b", "foot_print", "stand", "xyz='0 0.4 0' rpy='0 0 0.5'")
        + &fixed("c", "foot_print", "gps", "xyz='0 0 2'")
        + &fixed("d", "stand", "{root}", "xyz='0 0 0.3'");
    assert_same(&on(ROBOT, &chain), &plain);
    // a root with a gram, as simulators ask for: its mass counts, its frame does not
    let speck = "<link name='foot_print'><inertial><mass value='0.001'/><inertia ixx='1e-6' ixy='0' ixz='0' iyy='1e-6' \
        iyz='0' izz='1e-6'/></inertial></link>"
        .to_string() + &fixed("f", "foot_print", "{root}", "xyz='0 0 0.3'");
    let model = on(ROBOT, &speck);
    assert_eq!(model.joints, plain.joints);
    assert!((model.total_mass() - plain.total_mass() - 0.001).abs() < 1e-9);
    assert_eq!(model.links[0].name, plain.links[0].name);
    // one that is where the body is needs no word
    let same = on(ROBOT, &("<link name='r'/>".to_string() + &fixed("f", "r", "{root}", "")));
    assert_same(&same, &plain);
    assert_eq!(same.warnings, []);
}

#[test]
fn an_empty_root_that_carries_the_legs_stays_the_base() {
    // the inertia of the body in a separate link, as some makers write it
    let text = urdf(ROBOT);
    let at = text.find("<inertial").unwrap();
    let end = text.find("</inertial>").unwrap() + "</inertial>".len();
    let root = text.split("<link name=\"").nth(1).unwrap().split('"').next().unwrap();
    let apart = format!("{}{}", &text[..at], &text[end..]).replace(
        "</robot>",
        &format!("<link name='mass'>{}</link>{}</robot>", &text[at..end], fixed("m", root, "mass", "xyz='0 0 0.05'")),
    );
    let model = read(&apart);
    assert_eq!(model.links[0].name, root);
    assert_eq!(model.joints, read(&text).joints);
    assert_eq!(model.warnings, []);
}

/// A maker's body that looks along its y, below a root that was put there to look along x.
#[test]
fn a_root_that_suits_the_legs_is_kept() {
    let text = urdf(ROBOT);
    let at = text.find("<link").unwrap();
    let root = text[at..].split('"').nth(1).unwrap().to_string();
    let plain = read(&text);
    // all that hangs on the body is turned against it, so that its own axes are wrong
    let turn = |text: &str| {
        let mut out = text.to_string();
        let mount = format!(
            "<link name='odd'><inertial><mass value='9'/><inertia ixx='0.1' ixy='0' ixz='0' iyy='0.1' iyz='0' izz='0.1'/>\
             </inertial></link>{}",
            fixed("mount", "odd", &root, "rpy='0 0 1.5707963267948966'")
        );
        out.insert_str(at, &mount);
        out
    };
    let odd = turn(&text);
    let front =
        format!("<link name='front'/>{}", fixed("f", "front", "odd", "xyz='0 0 0.2' rpy='0 0 -1.5707963267948966'"));
    let mut fronted = odd.clone();
    fronted.insert_str(at, &front);
    let model = read(&fronted);
    assert_eq!(model.links[0].name, "front");
    let warning = warning(&model);
    assert!(warning.contains("joints turn about its axes, not those of \"odd\""), "{warning}");
    let roles = detect(&model, &Default::default(), &Default::default()).unwrap();
    assert_eq!(roles, detect(&plain, &Default::default(), &Default::default()).unwrap());
}

#[test]
fn a_fixed_base_stands_where_its_root_says() {
    let text = urdf(ROBOT);
    let at = text.find("<link").unwrap();
    let root = text[at..].split('"').nth(1).unwrap();
    let table = format!("<link name='table'/>{}", fixed("f", "table", root, "xyz='0 0 0.7'"));
    let text = format!("{}{table}{}", &text[..at], &text[at..]);
    let model =
        load_str(&text, Path::new("r.urdf"), &LoadOptions { keeps_root: true, ..LoadOptions::default() }).unwrap();
    assert_eq!(model.links[0].name, "table");
    assert!((model.joints[0].origin.translation.z - 0.7).abs() < 1e-12);
}

#[test]
fn two_bodies_on_an_empty_root_are_told() {
    let half = |side: &str, x: f64| {
        let mass =
            "<inertial><mass value='1'/><inertia ixx='0.1' ixy='0' ixz='0' iyy='0.1' iyz='0' izz='0.1'/></inertial>";
        format!(
            "<link name='{side}'>{mass}</link><link name='{side}_leg'>{mass}</link>{}\
             <joint name='{side}_j' type='continuous'><parent link='{side}'/><child link='{side}_leg'/></joint>",
            fixed(side, "root", side, &format!("xyz='{x} 0 0.3'"))
        )
    };
    let model =
        read(&format!("<robot name='r'><link name='root'/>{}{}</robot>", half("front", 0.3), half("rear", -0.3)));
    assert_eq!(model.links[0].name, "root");
    let warning = warning(&model);
    assert!(warning.contains("link \"root\"") && warning.contains("heights are measured from it"), "{warning}");
}
