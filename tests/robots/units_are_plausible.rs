//! Numbers that are plausible in another unit only draw a warning that names element, value, unit
//! and remedy.

use std::fmt::Write as _;
use std::path::Path;

use polypod::config::Library;
use polypod::robot::{LoadOptions, Model, load_str};

const ROBOTS: [&str; 3] = ["unitree_go2", "unitree_h1", "anymal_d"];

fn urdf(robot: &str) -> String {
    Library::new(Vec::new()).robot(robot).unwrap().urdf_text
}

fn read(text: &str) -> Model {
    load_str(text, Path::new("r.urdf"), &LoadOptions::default()).unwrap_or_else(|error| panic!("{error}"))
}

/// The text with each number of these attributes of an element multiplied.
fn scaled(text: &str, element: &str, attributes: &[&str], factor: f64) -> String {
    let mut out = String::new();
    let mut rest = text;
    while let Some(at) = rest.find(&format!("<{element}")) {
        let end = at + rest[at..].find('>').unwrap();
        out += &rest[..at];
        let mut tag = rest[at..end].to_string();
        for attribute in attributes {
            let Some(from) = tag.find(&format!(" {attribute}=\"")).map(|from| from + attribute.len() + 3) else {
                continue;
            };
            let to = from + tag[from..].find('"').unwrap();
            let numbers = tag[from..to].split_whitespace().map(|x| x.parse::<f64>().unwrap() * factor);
            let mut new = String::new();
            numbers.for_each(|x| write!(new, "{x} ").unwrap());
            tag.replace_range(from..to, new.trim());
        }
        out += &tag;
        rest = &rest[end..];
    }
    out + rest
}

/// The text must draw one warning more than as it is, with all of these words.
#[track_caller]
fn assert_warned(text: &str, words: &[&str]) {
    let warnings: Vec<String> = read(text).warnings.iter().map(ToString::to_string).collect();
    let is_wanted = |warning: &&String| words.iter().all(|word| warning.contains(word));
    assert_eq!(warnings.iter().filter(is_wanted).count(), 1, "{words:?}: {warnings:#?}");
}

#[test]
fn robots_of_the_library_draw_none() {
    let library = Library::new(Vec::new());
    for entry in library.robots().unwrap() {
        assert_eq!(read(&library.robot(&entry.name).unwrap().urdf_text).warnings, [], "{}", entry.name);
    }
}

#[test]
fn masses_in_grams() {
    for robot in ROBOTS {
        let text = urdf(robot);
        assert_warned(&scaled(&text, "mass", &["value"], 1000.0), &["<mass value>", "grams", "write kilograms"]);
    }
    // one link alone
    let text = urdf(ROBOTS[0]).replace("<mass value=\"0.194\"", "<mass value=\"194\"");
    assert_warned(&text, &["_calf\", <mass value>", "its mass is 194 kg", "(as are 3 more)", "grams"]);
}

#[test]
fn inertias_in_other_units() {
    let all = ["ixx", "ixy", "ixz", "iyy", "iyz", "izz"];
    for robot in ROBOTS {
        let text = scaled(&urdf(robot), "inertia ", &all, 1e6);
        assert_warned(&text, &["<inertia>", "looks like kg mm^2;", "write the inertia in kg m^2"]);
    }
    // inertias of one link alone
    let text = urdf(ROBOTS[0]);
    let at = text.find("<link name=\"FR_calf\"").unwrap();
    let text = text[..at].to_string() + &scaled(&text[at..], "inertia ", &all, 1e6);
    assert_warned(&text, &["link \"FR_calf\", <inertia>", "kg mm^2"]);
}

#[test]
fn lengths_in_millimetres() {
    for robot in ROBOTS {
        let text = urdf(robot);
        assert_warned(&scaled(&text, "origin", &["xyz"], 1000.0), &["<origin xyz>", "millimetres", "write metres"]);
        // the shapes alone
        let shapes = scaled(&scaled(&text, "sphere", &["radius"], 1000.0), "box", &["size"], 1000.0);
        let shapes = scaled(&shapes, "cylinder", &["radius", "length"], 1000.0);
        assert_warned(&shapes, &["<collision>", "m large", "millimetres", "write metres"]);
    }
    // one alone, with which the engine can compute, and one with which it cannot
    let long = |z: &str| urdf(ROBOTS[0]).replacen("<origin xyz=\"0 0 -0.213\"", &format!("<origin xyz=\"0 0 {z}\""), 1);
    assert_warned(&long("-21.3"), &["<origin xyz>", "21.3000 m away", "millimetres"]);
    let refused = load_str(&long("-213"), Path::new("r.urdf"), &LoadOptions::default()).unwrap_err().to_string();
    for words in ["link \"base\"", "213.", "m from the base", "single precision", "millimetres"] {
        assert!(refused.contains(words), "{refused}");
    }
}

/// A robot with one foot that is the mesh of a cube with edges of `size`.
fn with_mesh(size: f64, scale: &str) -> String {
    let folder = std::env::temp_dir().join(format!("polypod-units-{}-{size}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let file = folder.join("foot.obj");
    let half = 0.5 * size;
    let side = |corner: u32, bit: u32| if corner >> bit & 1 == 0 { -half } else { half };
    let vertex = |corner: u32| format!("v {} {} {}\n", side(corner, 0), side(corner, 1), side(corner, 2));
    let vertices: String = (0..8).map(vertex).collect();
    let faces: String = (1..=8).map(|i| format!("f {i} {i} {i}\n")).collect();
    std::fs::write(&file, vertices + &faces).unwrap();
    let mesh = format!("<mesh filename=\"{}\" {scale}/>", file.display());
    let text = urdf(ROBOTS[0]);
    let before = "<collision><geometry>";
    let at = text.find(&format!("{before}<sphere")).unwrap() + before.len();
    let end = at + text[at..].find("/>").unwrap() + 2;
    format!("{}{mesh}{}", &text[..at], &text[end..])
}

#[test]
fn meshes_in_millimetres() {
    assert_warned(&with_mesh(60.0, ""), &["<collision>", "is 60.0000 m large", "scale=\"0.001 0.001 0.001\""]);
    assert_warned(&with_mesh(0.06, "scale=\"0.001 0.001 0.001\""), &["is 0.0600 mm large", "remove the scale"]);
    let right = read(&with_mesh(60.0, "scale=\"0.001 0.001 0.001\""));
    assert_eq!(right.warnings.len(), 1, "{:?}", right.warnings);
    assert!(right.warnings[0].problem.contains("convex hull"));
}

#[test]
fn angles_in_degrees() {
    for robot in ROBOTS {
        let text = scaled(&urdf(robot), "limit", &["lower", "upper"], 57.29577951308232);
        assert_warned(&text, &["<limit>", "rad are", "turns", "degrees", "write radians"]);
    }
    let text = urdf(ROBOTS[0]);
    let turned = text.replacen("<origin xyz=\"0 0 -0.213\"", "<origin xyz=\"0 0 -0.213\" rpy=\"0 90 0\"", 1);
    assert_warned(&turned, &["<origin rpy>", "0 90 0 rad", "degrees"]);
}

#[test]
fn efforts_in_newton_millimetres() {
    for robot in ROBOTS {
        let text = scaled(&urdf(robot), "limit", &["effort"], 1000.0);
        assert_warned(&text, &["<limit effort>", "N mm", "write the motor's effort in N m"]);
    }
}
