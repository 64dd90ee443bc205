//! `polypod-sim check` prints what a URDF is read as, quadruped or not, and refuses with exit code
//! 2 what is none.

use std::path::{Path, PathBuf};
use std::process::Output;

fn run(arguments: &[&str]) -> Output {
    crate::polypod_sim(&["check"]).args(arguments).output().unwrap()
}

fn data(name: &str) -> String {
    Path::new(crate::ROOT).join("tests/data/urdf").join(name).display().to_string()
}

fn printed(arguments: &[&str]) -> String {
    let output = run(arguments);
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// Output for a file that is refused.
fn refused(file: &Path) -> String {
    let output = run(&[&file.display().to_string()]);
    let error = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{error}");
    assert!(output.stdout.is_empty());
    assert!(error.starts_with("error: ") && error.contains(&file.display().to_string()), "{error}");
    assert!(!error.contains("panicked"), "{error}");
    error
}

fn assert_words(text: &str, words: &[&str]) {
    for word in words {
        assert!(text.contains(word), "{text}\nlacks {word:?}");
    }
}

#[test]
fn a_robot_without_legs_is_described() {
    let text = printed(&[&data("mixed.urdf")]);
    assert_words(
        &text,
        &[
            "cart (",
            "5.900 kg, 4 links, 3 joints (9 degrees of freedom",
            "with hand",
            "slide prismatic  on cart",
            "0.000 ..  0.400, effort 200.00, velocity 0.50",
            "-inf ..    inf, effort inf",
            "box of 0.5000 x 0.3000 x 0.1000 m",
            "hand  on arm: sphere of radius 0.0200 m",
            "no legged robot: 0 legs were found instead of 2, 4 or 6",
            "warnings: 1\n",
            "joint \"float\": a floating joint below the empty link \"world\" is left out",
        ],
    );
}

#[test]
fn a_quadruped_is_told_with_its_legs() {
    let text = printed(&[&data("meshed.urdf")]);
    assert_words(
        &text,
        &[
            "\nquadruped (+",
            "LH leg: LH_HAA = +lh_hip, LH_HFE = +lh_thigh, LH_KFE = +lh_shank, foot = lh_shank",
            "hull of 8 points",
            "warnings: 13\n",
        ],
    );
    let robot = Path::new(crate::ROOT).join("assets/robots/spot/robot.urdf");
    assert_words(&printed(&[robot.to_str().unwrap()]), &["\nquadruped (+"]);
}

#[test]
fn packages_are_looked_up() {
    let folder = std::env::temp_dir().join(format!("polypod-check-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let file = folder.join("robot.urdf");
    let text = std::fs::read_to_string(data("meshed.urdf")).unwrap();
    std::fs::write(&file, text.replace("filename=\"meshes/", "filename=\"package://meshes/")).unwrap();
    let file = file.display().to_string();
    let lost = printed(&[&file]);
    assert_words(
        &lost,
        &["\"package://meshes/cube.stl\" is not found", "link \"lf_shank\": its collision meshes are missing"],
    );
    let found = printed(&[&file, "--package-dir", &format!("meshes={}", data("meshes"))]);
    assert_words(&found, &["\nquadruped (+", "hull of 8 points"]);
    assert_eq!(run(&[&file, "--package-dir", "meshes"]).status.code(), Some(2));
    std::fs::remove_dir_all(folder).unwrap();
}

#[test]
fn what_is_no_urdf_is_refused() {
    let folder = std::env::temp_dir().join(format!("polypod-refuse-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let write = |name: &str, bytes: &[u8]| -> PathBuf {
        std::fs::write(folder.join(name), bytes).unwrap();
        folder.join(name)
    };
    assert_words(&refused(&folder.join("nowhere.urdf")), &["check the path"]);
    refused(&folder);
    refused(&write("empty.urdf", b""));
    assert_words(&refused(&write("binary.urdf", &[0x89, 0xff, 0, 1, 2, 0xfe])), &["UTF-8"]);
    refused(&write("deep.urdf", "<robot>".repeat(200_000).as_bytes()));
    let heavy = "<robot name='r'><link name='l'><inertial><mass value='1e308'/>\
         <inertia ixx='1e308' ixy='0' ixz='0' iyy='1e308' iyz='0' izz='1e308'/></inertial></link></robot>";
    assert_words(&refused(&write("heavy.urdf", heavy.as_bytes())), &["link \"l\"", "overflows"]);
    let mut chain = "<robot name='r'>".to_string();
    for i in 0..70 {
        chain += &format!(
            "<link name='l{i}'><inertial><mass value='1'/>\
             <inertia ixx='1' ixy='0' ixz='0' iyy='1' iyz='0' izz='1'/></inertial></link>"
        );
        if i > 0 {
            let parent = i - 1;
            chain +=
                &format!("<joint name='j{i}' type='continuous'><parent link='l{parent}'/><child link='l{i}'/></joint>");
        }
    }
    let error = refused(&write("chain.urdf", (chain + "</robot>").as_bytes()));
    assert_words(&error, &["joint \"j65\"", "number 65 in a chain"]);
    std::fs::remove_dir_all(folder).unwrap();
}
