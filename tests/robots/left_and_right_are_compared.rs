//! Limbs on the left and on the right that are no mirror images of each other draw a warning that
//! says what differs.

use std::path::Path;

use polypod::config::Library;
use polypod::robot::{LoadOptions, detect, load_str, unequal_sides};

fn urdf(robot: &str) -> String {
    Library::new(Vec::new()).robot(robot).unwrap().urdf_text
}

fn warnings(text: &str) -> Vec<String> {
    let model = load_str(text, Path::new("r.urdf"), &LoadOptions::default()).unwrap();
    let roles = detect(&model, &Default::default(), &Default::default()).unwrap();
    unequal_sides(&model, &roles).iter().map(ToString::to_string).collect()
}

/// The text with one replacement after the first place of a word.
fn after(text: &str, word: &str, old: &str, new: &str) -> String {
    let at = text.find(word).unwrap_or_else(|| panic!("no {word}"));
    let place = at + text[at..].find(old).unwrap_or_else(|| panic!("no {old} after {word}"));
    format!("{}{new}{}", &text[..place], &text[place + old.len()..])
}

#[track_caller]
fn assert_one(text: &str, words: &[&str]) {
    let found = warnings(text);
    assert_eq!(found.len(), 1, "{found:#?}");
    for word in ["no mirror images", "symmetry=false"].iter().chain(words) {
        assert!(found[0].contains(word), "{} lacks {word}", found[0]);
    }
}

#[test]
fn robots_of_the_library_have_equal_sides() {
    let library = Library::new(Vec::new());
    for entry in library.robots().unwrap() {
        let loaded = library.robot(&entry.name).unwrap();
        let options = LoadOptions { locked_joints: loaded.config.locked_joints.clone(), ..LoadOptions::default() };
        let model = load_str(&loaded.urdf_text, &loaded.urdf_path, &options).unwrap();
        let roles = detect(&model, &loaded.config.joint_roles, &loaded.config.feet).unwrap();
        assert_eq!(unequal_sides(&model, &roles), [], "{}", entry.name);
    }
}

#[test]
fn masses_and_lengths_of_legs() {
    let text = urdf("unitree_go2");
    let heavy = after(&text, "<link name=\"FR_calf\"", "<mass value=\"0.194\"", "<mass value=\"0.294\"");
    assert_one(&heavy, &["limbs LF and RF", "\"FL_calf\" has 0.194 kg and \"FR_calf\" 0.294 kg"]);
    let long = after(&text, "<joint name=\"RL_calf_joint\"", "-0.213", "-0.233");
    assert_one(&long, &["limbs LH and RH", "\"RL_calf_joint\" lies 0.2330 m", "\"RR_calf_joint\" 0.2130 m"]);
}

#[test]
fn joints_that_turn_to_different_sides() {
    let text = urdf("unitree_go2");
    let limits = ["lower=\"-2.7227\" upper=\"-0.83776\"", "lower=\"0.83776\" upper=\"2.7227\""];
    let turned = after(&text, "<joint name=\"FR_calf_joint\"", limits[0], limits[1]);
    let words = ["limbs LF and RF", "\"FL_calf_joint\" reaches from -2.72 to -0.84 rad", "mirrored, from 0.84 to 2.72"];
    assert_one(&turned, &words);
    // a hip that opens to the left on both sides
    let mut opens = text;
    for (side, limits) in [("FL", "lower=\"-0.2\" upper=\"0.9\""), ("FR", "lower=\"-0.2\" upper=\"0.9\"")] {
        let word = format!("<joint name=\"{side}_hip_joint\"");
        opens = after(&opens, &word, "lower=\"-1.0472\" upper=\"1.0472\"", limits);
    }
    assert_one(&opens, &["\"FL_hip_joint\" reaches from -0.20 to 0.90 rad", "mirrored, from -0.90 to 0.20"]);
    // a fifth of it is a maker's choice
    let mut opens = urdf("unitree_go2");
    opens = after(&opens, "<joint name=\"FR_hip_joint\"", "lower=\"-1.0472\"", "lower=\"-0.8\"");
    assert_eq!(warnings(&opens), Vec::<String>::new());
}

#[test]
fn feet_of_other_sizes() {
    let large = after(
        &urdf("unitree_go2"),
        "<link name=\"FR_foot\"",
        "<collision><origin xyz=\"-0.002 0 0\"/><geometry><sphere radius=\"0.022\"",
        "<collision><origin xyz=\"-0.002 0 0\"/><geometry><sphere radius=\"0.032\"",
    );
    assert_one(&large, &["limbs LF and RF", "foot \"FL_foot\" is", "\"FR_foot\""]);
}

const BIPED: &str = "<robot name='r'>\
    <link name='base'><inertial><mass value='9'/><inertia ixx='0.1' ixy='0' ixz='0' iyy='0.1' iyz='0' izz='0.1'/></inertial></link>";

/// A leg of hip, thigh, knee and ankle; the sole, with this length, is the ankle's or that of the
/// link before.
fn leg(side: &str, y: f64, sole: f64, has_sole_on_ankle: bool) -> String {
    let inertial = "<inertial><origin xyz='0 0 -0.1'/><mass value='1'/>\
        <inertia ixx='0.01' ixy='0' ixz='0' iyy='0.01' iyz='0' izz='0.01'/></inertial>";
    let shape = |z: f64| {
        format!("<collision><origin xyz='0.02 0 {z}'/><geometry><box size='{sole} 0.08 0.03'/></geometry></collision>")
    };
    let mut text = String::new();
    let mut parent = "base".to_string();
    let joints = [
        ("roll", "1 0 0", 0.0),
        ("pitch", "0 1 0", 0.0),
        ("knee", "0 1 0", -0.3),
        ("ankle", "0 1 0", -0.3),
        ("turn", "1 0 0", 0.0),
    ];
    for (at, (name, axis, z)) in joints.into_iter().enumerate() {
        let own = format!("{side}_{name}");
        let y = if at == 0 { y } else { 0.0 };
        let sole = if (name == "turn") == has_sole_on_ankle && (name == "turn" || name == "ankle") {
            shape(-0.04)
        } else {
            String::new()
        };
        text += &format!(
            "<link name='{own}'>{inertial}{sole}</link><joint name='{own}_j' type='revolute'><origin xyz='0 {y} {z}'/>\
             <parent link='{parent}'/><child link='{own}'/><axis xyz='{axis}'/><limit lower='-2' upper='2' effort='50' velocity='9'/></joint>"
        );
        parent = own;
    }
    text
}

#[test]
fn soles_on_other_links_or_cut_short() {
    let robot = |right: String| format!("{BIPED}{}{right}</robot>", leg("l", 0.1, 0.2, true));
    assert_eq!(warnings(&robot(leg("r", -0.1, 0.2, true))), [""; 0]);
    assert_one(
        &robot(leg("r", -0.1, 0.2, false)),
        &["limbs L and R", "feet \"l_turn\" and \"r_ankle\" are moved by joints of other roles"],
    );
    assert_one(
        &robot(leg("r", -0.1, 0.12, true)),
        &["foot \"l_turn\" is 0.200 x 0.080 x 0.030 m", "\"r_turn\" 0.120 x"],
    );
    // a joint that one side lacks
    let fixed = leg("r", -0.1, 0.2, true)
        .replace("<joint name='r_turn_j' type='revolute'", "<joint name='r_turn_j' type='fixed'");
    assert_one(&robot(fixed), &["5 joints against 4", "\"l_turn_j\" (L_ANKLE_ROLL) has no counterpart"]);
}
