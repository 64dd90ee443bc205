//! STL, OBJ and COLLADA meshes of collision shapes are taken as the convex hull of their vertices,
//! and a warning says so; a mesh that cannot be read is left out, with a warning too.

use std::path::{Path, PathBuf};

use glam::DVec3;
use polypod::robot::{Articulation, Geometry, LoadOptions, Model, detect, load, load_str, summed_up};

fn data() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/urdf")
}

/// A link whose collision shape is this mesh, in a file of `folder`.
fn with_mesh(folder: &Path, mesh: &str) -> Model {
    let text = format!(
        "<robot name='r'><link name='l'><inertial><mass value='1'/>\
         <inertia ixx='1' ixy='0' ixz='0' iyy='1' iyz='0' izz='1'/></inertial>\
         <collision><origin xyz='0 0 1'/><geometry><mesh {mesh}/></geometry></collision></link></robot>"
    );
    let model = load_str(&text, &folder.join("r.urdf"), &LoadOptions::default()).unwrap();
    assert_eq!(model.warnings.len(), 1, "{:?}", model.warnings);
    assert_eq!(model.warnings[0].element, "link \"l\", <collision>");
    model
}

fn hull(model: &Model) -> &[DVec3] {
    match &model.bodies[0].shapes[0].geometry {
        Geometry::Hull { points } => points,
        other => panic!("{other:?}"),
    }
}

/// The eight corners of a box about `centre`, in any order.
fn assert_box(points: &[DVec3], centre: DVec3, size: DVec3) {
    assert_eq!(points.len(), 8, "{points:?}");
    for corner in 0..8u32 {
        let side = |bit: u32| f64::from(corner >> bit & 1) - 0.5;
        let wanted = centre + size * DVec3::new(side(0), side(1), side(2));
        // the files hold single precision
        assert!(points.iter().any(|point| point.distance(wanted) < 1e-7), "{points:?} lacks {wanted}");
    }
}

/// A file of this test's own.
struct Mesh(PathBuf);

impl Mesh {
    fn new(name: &str, text: impl AsRef<[u8]>) -> Self {
        let folder = std::env::temp_dir().join(format!("polypod-hulls-{}-{name}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::write(folder.join(name), text).unwrap();
        Self(folder)
    }
}

impl Drop for Mesh {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

fn obj(points: &[DVec3]) -> String {
    let vertices: String = points.iter().map(|p| format!("v {} {} {}\n", p.x, p.y, p.z)).collect();
    // tobj hands on the vertices of faces
    vertices + &(1..=points.len()).map(|i| format!("f {i} {i} {i}\n")).collect::<String>()
}

#[test]
fn every_format_gives_the_same_cube() {
    for mesh in ["cube.stl", "cube_ascii.stl", "cube.obj", "cube.dae"] {
        let model = with_mesh(&data(), &format!("filename='meshes/{mesh}'"));
        assert_box(hull(&model), DVec3::new(0.0, 0.0, 0.1), DVec3::splat(0.2));
        let warning = model.warnings[0].to_string();
        assert!(warning.contains(mesh) && warning.contains("convex hull of 8 of its"), "{warning}");
        assert_eq!(warning.contains("up_axis Y_UP is not applied"), mesh == "cube.dae", "{warning}");
    }
}

#[test]
fn scale_stretches_and_mirrors() {
    let model = with_mesh(&data(), "filename='meshes/cube.stl' scale='1 2 -3'");
    assert_box(hull(&model), DVec3::new(0.0, 0.0, -0.3), DVec3::new(0.2, 0.4, 0.6));
}

#[test]
fn corners_touch_the_ground() {
    let model = with_mesh(&data(), "filename='meshes/cube.stl'");
    let parameters = Articulation::new(&model, true, &[], None).parameters;
    let corners: Vec<DVec3> = parameters.contact_position.iter().map(|p| DVec3::from_array(*p)).collect();
    assert_box(&corners, DVec3::new(0.0, 0.0, 1.1), DVec3::splat(0.2));
    assert!(parameters.contact_radius.iter().all(|radius| *radius == 0.0));
}

#[test]
fn feet_are_found_on_meshes() {
    let model = load(&data().join("meshed.urdf"), &LoadOptions::default()).unwrap();
    assert_eq!(model.bodies.len(), 13);
    let roles = detect(&model, &Default::default(), &Default::default()).unwrap();
    for (leg, name) in ["lf_shank", "lh_shank", "rf_shank", "rh_shank"].iter().enumerate() {
        assert_eq!(model.bodies[roles.foot_body[leg]].name, *name);
        // the middle of the shank's lower face
        assert!(roles.foot_point[leg].distance(DVec3::new(0.0, 0.0, -0.25)) < 1e-7, "{}", roles.foot_point[leg]);
    }
}

/// A ball of many points keeps its extreme ones, and the warning tells how much the rest sticks
/// out.
#[test]
fn round_meshes_are_thinned_out() {
    let (radius, rings) = (0.1, 150);
    let angle = |i: usize, n: usize| std::f64::consts::TAU * i as f64 / n as f64;
    let ball: Vec<DVec3> = (0..=rings)
        .flat_map(|i| (0..60).map(move |j| (angle(i, 2 * rings), angle(j, 60))))
        .map(|(a, b)| DVec3::new(a.sin() * b.cos(), a.sin() * b.sin(), a.cos()) * radius)
        .collect();
    let file = Mesh::new("ball.obj", obj(&ball));
    let model = with_mesh(&file.0, "filename='ball.obj'");
    let points = hull(&model);
    assert_eq!(points.len(), 32);
    assert!(points.iter().all(|point| (point.length() - radius).abs() < 1e-6));
    for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
        for direction in [axis, -axis] {
            let reach = points.iter().map(|point| point.dot(direction)).fold(0.0, f64::max);
            assert!(reach > 0.9999 * radius, "{direction} {reach}");
        }
    }
    let problem = &model.warnings[0].problem;
    let (_, rest) = problem.split_once("up to ").expect(problem);
    let stated: f64 = rest.split_once(" mm").expect(problem).0.parse().unwrap();
    // the reach of hull and ball differ by that at most, along any direction; and by nearly that
    // along some
    let lost = |direction: &DVec3| {
        let reach = |points: &[DVec3]| points.iter().map(|p| p.dot(*direction)).fold(0.0, f64::max);
        1e3 * (reach(&ball) - reach(points))
    };
    let worst = ball.iter().map(|point| lost(&point.normalize())).fold(0.0, f64::max);
    // two decimals are stated, and directions are sampled every 2 degrees or so
    assert!(worst <= stated + 0.005 && worst > 0.9 * stated, "{worst} {stated}");
    // the points along axes and diagonals leave 0.193 of a ball's radius; the other eighteen take a
    // third off
    assert!(stated < 0.667 * 19.3, "{stated}");
}

#[test]
fn thin_and_flat_meshes_keep_their_corners() {
    let corners = |size: DVec3| -> Vec<DVec3> {
        (0..8u32).map(|i| size * DVec3::new(f64::from(i & 1), f64::from(i >> 1 & 1), f64::from(i >> 2))).collect()
    };
    let plate = DVec3::new(1.0, 0.5, 1e-4);
    let file = Mesh::new("plate.obj", obj(&corners(plate)));
    assert_box(hull(&with_mesh(&file.0, "filename='plate.obj'")), 0.5 * plate, plate);

    // duplicates, points of edges and faces, and no thickness at all
    let sheet: Vec<DVec3> =
        (0..100).map(|i| DVec3::new(f64::from(i % 10) / 9.0, f64::from(i / 10) / 9.0, 0.5)).collect();
    let file = Mesh::new("sheet.obj", obj(&[sheet.clone(), sheet].concat()));
    let model = with_mesh(&file.0, "filename='sheet.obj'");
    for corner in [[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]] {
        let wanted = DVec3::new(corner[0], corner[1], 0.5);
        assert!(hull(&model).iter().any(|point| point.distance(wanted) < 1e-6), "{:?}", hull(&model));
    }
    assert!(hull(&model).iter().all(|point| point.z == 0.5));

    for few in [1, 2, 3] {
        let points: Vec<DVec3> = (0..few).map(|i| DVec3::new(f64::from(i), 0.0, 0.0)).collect();
        let file = Mesh::new("few.obj", obj(&points));
        let model = with_mesh(&file.0, "filename='few.obj'");
        let reach = hull(&model).iter().map(|point| point.x).fold(0.0, f64::max);
        assert_eq!(reach, f64::from(few - 1));
    }
}

#[test]
fn unreadable_meshes_are_left_out() {
    let cube = std::fs::read(data().join("meshes/cube.stl")).unwrap();
    let mut nan = cube.clone();
    nan[96..100].copy_from_slice(&f32::NAN.to_le_bytes());
    let collada = |inside: &str| format!("<COLLADA>{inside}</COLLADA>").into_bytes();
    let cases: [(&str, Vec<u8>, &str); 14] = [
        ("empty.stl", Vec::new(), "no vertices"),
        ("short.stl", cube[..400].to_vec(), "cut short"),
        ("nan.stl", nan, "NaN"),
        ("word.stl", b"solid x\nfacet normal 0 0 1\nouter loop\nvertex 0 0 a\n".to_vec(), "cut short"),
        ("bad.stl", b"solid x\nfacet normal 0 0 1\nouter loop\nvertex 0 0 a\nendsolid\n".to_vec(), "invalid float"),
        ("index.obj", b"v 0 0 0\nf 1 2 3\n".to_vec(), "not read"),
        ("faceless.obj", b"v 0 0 0\n".to_vec(), "no vertices"),
        ("far.obj", b"v 1e9 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\n".to_vec(), "from its origin"),
        ("binary.dae", vec![0xff; 50], "not read"),
        ("other.dae", b"<html/>".to_vec(), "not <COLLADA>"),
        ("unit.dae", collada("<asset><unit meter='-1'/></asset>"), "unit meter"),
        ("lost.dae", collada("<visual_scene><node><instance_geometry url='#x'/></node></visual_scene>"), "\"#x\""),
        ("skew.dae", collada("<visual_scene><node><skew>1 2 3</skew></node></visual_scene>"), "<skew> with 3 numbers"),
        ("robot.glb", b"glTF".to_vec(), "\".glb\" is not read"),
    ];
    for (name, bytes, words) in cases {
        let file = Mesh::new(name, bytes);
        let model = with_mesh(&file.0, &format!("filename='{name}'"));
        assert!(model.bodies.is_empty(), "{name}");
        let warning = model.warnings[0].to_string();
        assert!(warning.contains(words) && warning.contains(name) && warning.contains("left out"), "{warning}");
    }
}

/// A COLLADA file with one geometry of these vertices and this inside its scene.
fn scene(vertices: usize, inside: &str, nodes: &str) -> String {
    let numbers: String = (0..vertices).map(|i| format!("{} {} {} ", i % 2, i / 2 % 2, i % 5)).collect();
    format!(
        "<COLLADA><library_geometries><geometry id='g'><mesh><source id='s'><float_array>{numbers}</float_array></source>\
         <vertices><input semantic='POSITION' source='#s'/></vertices></mesh></geometry></library_geometries>\
         <library_nodes>{nodes}</library_nodes><visual_scene>{inside}</visual_scene></COLLADA>"
    )
}

#[test]
fn what_a_mesh_is_multiplied_by_is_counted_before_memory_is_taken() {
    let refused = |name: &str, text: String, words: &str| {
        let file = Mesh::new(name, text);
        let model = with_mesh(&file.0, &format!("filename='{name}'"));
        assert!(model.bodies.is_empty(), "{name}");
        assert!(model.warnings[0].problem.contains(words), "{}", model.warnings[0]);
    };
    let geometry = "<instance_geometry url='#g'/>";
    let many = "more than 4194304 vertices";
    // 4e8 vertices of 0.8 MB
    refused("instances.dae", scene(20_000, &format!("<node>{}</node>", geometry.repeat(20_000)), ""), many);
    // nodes that hold the one before twice
    let doubled: String = (1..30)
        .map(|i| format!("<node id='n{i}'>{}</node>", format!("<instance_node url='#n{}'/>", i - 1).repeat(2)))
        .collect();
    let nodes = format!("<node id='n0'>{geometry}</node>{doubled}");
    refused("doubled.dae", scene(1000, "<node><instance_node url='#n29'/></node>", &nodes), many);
    // a node of many transformations, instantiated again and again
    let turns = format!("<node id='t'>{}</node>", "<translate>0 0 0</translate>".repeat(20_000));
    let again = format!("<node>{}</node>", "<instance_node url='#t'/>".repeat(20_000));
    refused("turns.dae", scene(8, &again, &turns), "too many nodes");
    refused(
        "matrix.dae",
        scene(8, &format!("<node><matrix>{}</matrix></node>", "1 ".repeat(1 << 20)), ""),
        "more than 16",
    );
    let attributes: String = (0..100_000).map(|i| format!(" a{i}=''")).collect();
    refused("attributes.dae", scene(8, &format!("<node{attributes}/>"), ""), "100000 attributes");
    // a face is a fan of triangles; vertices that no face names count as well
    refused("fan.obj", format!("v 0 0 0\nv 1 0 0\nv 0 1 0\nf{}\n", " 1".repeat(1_400_010)), many);
    refused("vertices.obj", "v 0 0 0\n".repeat((4 << 20) + 1) + "f 1 2 3\n", many);
}

#[test]
fn instances_stand_where_the_scene_puts_them() {
    let node = |x: usize| format!("<node><translate>{x} 0 0</translate><instance_geometry url='#g'/></node>");
    let nodes: String = (0..1000).map(node).collect();
    let file = Mesh::new("row.dae", scene(14, &nodes, ""));
    let model = with_mesh(&file.0, "filename='row.dae' scale='0.001 1 1'");
    let reach = |of: fn(&DVec3) -> f64| hull(&model).iter().map(of).fold(0.0, f64::max);
    assert!((reach(|point| point.x) - 1.0).abs() < 1e-9 && reach(|point| point.z) == 4.0, "{:?}", hull(&model));
    assert!(model.warnings[0].problem.contains("of its 14000 vertices"), "{}", model.warnings[0]);
}

/// Hulls are kept by the contents of their files, not by the files' names.
#[test]
fn a_mesh_that_changes_has_a_new_hull() {
    let cube = |size: f64| -> Vec<DVec3> {
        (0..8u32).map(|i| size * DVec3::new(f64::from(i & 1), f64::from(i >> 1 & 1), f64::from(i >> 2))).collect()
    };
    let file = Mesh::new("part.obj", obj(&cube(0.1)));
    let size = |scale: &str| {
        let model = with_mesh(&file.0, &format!("filename='part.obj' {scale}"));
        hull(&model).iter().map(|point| point.max_element()).fold(0.0, f64::max)
    };
    let near = |a: f64, b: f64| (a - b).abs() < 1e-6;
    assert!(near(size(""), 0.1) && near(size("scale='2 2 2'"), 0.2) && near(size(""), 0.1));
    std::fs::write(file.0.join("part.obj"), obj(&cube(0.3))).unwrap();
    assert!(near(size(""), 0.3));
}

#[test]
fn many_meshes_are_one_warning() {
    let link = |i: usize, mesh: &str| {
        format!(
            "<link name='l{i}'><collision><geometry><mesh filename='{mesh}'/></geometry></collision></link>\
             <joint name='j{i}' type='fixed'><parent link='base'/><child link='l{i}'/></joint>"
        )
    };
    let meshes = ["meshes/cube.stl", "lost_a.stl", "meshes/cube.obj", "lost_b.stl", "meshes/cube.dae"];
    let links: String = meshes.iter().enumerate().map(|(i, mesh)| link(i, mesh)).collect();
    let text = format!(
        "<robot name='r'><link name='base'><inertial><mass value='1'/><inertia ixx='1' ixy='0' ixz='0' iyy='1' iyz='0' izz='1'/>\
         </inertial></link>{links}<loop/></robot>"
    );
    let model = load_str(&text, &data().join("r.urdf"), &LoadOptions::default()).unwrap();
    assert_eq!(model.warnings.len(), 6);
    let shown: Vec<String> = summed_up(&model.warnings).iter().map(|warning| warning.finding()).collect();
    assert_eq!(shown.len(), 3, "{shown:?}");
    assert!(shown[0].contains("<loop>"), "{shown:?}");
    assert!(shown[1].contains("3 meshes are taken as convex hulls, which they leave by up to 0.0 mm"), "{shown:?}");
    assert!(
        shown[2].contains("2 meshes are left out; the first: link \"l1\"") && shown[2].contains("lost_a.stl"),
        "{shown:?}"
    );
    assert!(shown[1..].iter().all(|line| line.contains("`polypod check ") && line.contains("r.urdf` lists them")));
    // one alone is shown as it is
    assert_eq!(summed_up(&model.warnings[..2]), model.warnings[..2]);
}
