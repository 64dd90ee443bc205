//! A contact candidate inside a sphere of the same link never touches the ground first, and is
//! skipped; all others are tested.

use polypod::dynamics::ContactKind;
use polypod::robot::{Articulation, LoadOptions, load_str};

/// A lower leg with a spherical foot of 2 cm at its end, and one part more.
fn candidates(part: &str) -> Vec<([f64; 3], f64)> {
    let inertia =
        r#"<inertial><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>"#;
    let text = format!(
        r#"<robot name="leg"><link name="base">{inertia}</link>
        <link name="shank">{inertia}{part}
          <collision><origin xyz="0 0 -0.2"/><geometry><sphere radius="0.02"/></geometry></collision></link>
        <joint name="knee" type="revolute"><parent link="base"/><child link="shank"/><axis xyz="0 1 0"/>
          <limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"#
    );
    let model = load_str(&text, std::path::Path::new("leg.urdf"), &LoadOptions::default()).unwrap();
    let Articulation { topology, parameters, .. } = Articulation::new(&model, true, &[], None);
    assert!(topology.contacts.iter().all(|c| c.link == 1));
    let contacts = topology.contacts.iter().enumerate();
    contacts
        .map(|(i, c)| {
            let rim = if let ContactKind::Rim { .. } = c.kind { parameters.contact_rim[i] } else { 0.0 };
            (parameters.contact_position[i], parameters.contact_radius[i] + rim)
        })
        .collect()
}

fn collision(at: &str, geometry: &str) -> String {
    format!(r#"<collision><origin xyz="{at}"/><geometry>{geometry}</geometry></collision>"#)
}

#[test]
fn only_the_end_of_a_box_inside_the_foot_is_left_out() {
    let thin = candidates(&collision("0 0 -0.1", r#"<box size="0.016 0.016 0.2"/>"#));
    assert_eq!(thin.len(), 1 + 4, "{thin:?}");
    assert!(thin.iter().all(|(at, radius)| at[2] > -0.01 || *radius == 0.02), "{thin:?}");
    // the corners stick out: 0.015 * sqrt(2) is more than 0.02
    let wide = candidates(&collision("0 0 -0.1", r#"<box size="0.03 0.03 0.2"/>"#));
    assert_eq!(wide.len(), 1 + 8, "{wide:?}");
}

#[test]
fn a_rim_counts_by_its_furthest_point() {
    // the lower rim is 0.015 m above the foot's centre, 0.01725 m if the leg is stretched by 15 %:
    // inside up to sqrt(0.02^2 - 0.01725^2) = 0.0101 m
    for (radius, rims) in [(0.01, 1), (0.0102, 2)] {
        let found = candidates(&collision("0 0 -0.1", &format!(r#"<cylinder radius="{radius}" length="0.17"/>"#)));
        assert_eq!(found.len(), 1 + 3 * rims, "radius {radius}: {found:?}");
    }
}

#[test]
fn of_two_equal_spheres_one_stays() {
    assert_eq!(candidates(&collision("0 0 -0.2", r#"<sphere radius="0.02"/>"#)).len(), 1);
    assert_eq!(candidates(&collision("0 0 -0.2", r#"<sphere radius="0.01"/>"#)).len(), 1);
    assert_eq!(candidates(&collision("0 0 -0.2", r#"<sphere radius="0.03"/>"#)), [([0.0, 0.0, -0.2], 0.03)]);
}
