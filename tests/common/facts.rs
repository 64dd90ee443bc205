//! Figures of publishers' descriptions, read by other means, and the comparison with them.

use polypod::robot::Model;
use serde::Deserialize;

#[derive(Deserialize)]
pub struct LinkFacts {
    name: String,
    mass: f64,
    com: [f64; 3],
    /// ixx, ixy, ixz, iyy, iyz, izz.
    inertia: [f64; 6],
}

/// Largest differences from the facts.
pub struct Tolerances {
    /// Mass of a link, kg.
    pub mass: f64,
    /// Centre of mass, m.
    pub com: f64,
    /// Bound as a share of the link's largest number.
    pub inertia: f64,
}

#[track_caller]
pub fn assert_near(values: impl IntoIterator<Item = f64>, facts: &[f64], tolerance: f64, what: &str) {
    let values: Vec<f64> = values.into_iter().collect();
    assert_eq!(values.len(), facts.len(), "{what}");
    for (value, fact) in values.iter().zip(facts) {
        assert!((value - fact).abs() <= tolerance, "{what}: {values:?} is not {facts:?}");
    }
}

/// Names, masses and inertias of a robot's links, the root first.
#[track_caller]
pub fn assert_links(model: &Model, facts: &[LinkFacts], tolerances: &Tolerances) {
    assert_eq!(model.links.len(), facts.len(), "{}", model.name);
    for (link, fact) in model.links.iter().zip(facts) {
        let what = format!("{}, link {}", model.name, fact.name);
        assert_eq!(link.name, fact.name, "{}", model.name);
        assert_near([link.mass], &[fact.mass], tolerances.mass, &what);
        assert_near(link.com.to_array(), &fact.com, tolerances.com, &what);
        let i = &link.inertia;
        let ours = [i.x_axis.x, i.x_axis.y, i.x_axis.z, i.y_axis.y, i.y_axis.z, i.z_axis.z];
        let largest = fact.inertia.iter().fold(0.0, |a: f64, b| a.max(b.abs()));
        assert_near(ours, &fact.inertia, tolerances.inertia * largest, &what);
    }
}
