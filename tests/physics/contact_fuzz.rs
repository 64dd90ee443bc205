//! Random bodies over planes: candidates find the true distance, nothing is felt where nothing
//! touches, and contacts push, along the normal and outwards.

use std::f64::consts::FRAC_PI_3;
use std::path::PathBuf;

use glam::{DMat3, DQuat, DVec3};
use polypod::dynamics::{
    ContactSettings, ControlStep, Drive, Parameters, Plane, Report, Scalar, State, StepSettings, Workspace,
};
use polypod::robot::{Articulation, Body, BodySurface, Geometry, Link, Model, Pose, Shape};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::common::size;

const SEED: u64 = 1;
const DT: f64 = 0.005;
const GRAVITY: [f64; 3] = [0.0, 0.0, -9.81];
/// Contacts take part from here, m.
const MARGIN: f64 = 0.02;
/// Rounding of f32 on distances of up to 3 m, m: a dozen operations of half a unit in the last
/// place (1.2e-7) each.
const EXACT: f64 = 1e-5;
/// Shapes sit this far from their body's origin, along each axis, m.
const LEVER: f64 = 0.3;
/// Largest rest of the coupling of friction and normal impulse after eight sweeps in one step at up
/// to 2 m/s and 3 rad/s, m. (Measured: 2.5 mm at most; 86 of 16,500 bodies above `EXACT`, of which
/// 200 sweeps leave 7.)
const UNSOLVED: f64 = 3e-3;
/// The lowest point of a rim is looked for when the cylinder leans by more than this, rad.
const UPRIGHT: f64 = 1e-3;

/// One primitive on one free body over one plane; printed when something is wrong with it.
#[derive(Clone, Debug)]
struct Sample {
    geometry: Geometry,
    shape_origin: Pose,
    mass: f64,
    com: DVec3,
    inertia: DMat3,
    friction: f64,
    plane: Plane,
    state: State<f32>,
}

fn vector(rng: &mut Pcg64Mcg, most: f64) -> DVec3 {
    DVec3::from_array(std::array::from_fn(|_| rng.random_range(-most..most)))
}

fn rotation(rng: &mut Pcg64Mcg) -> DQuat {
    loop {
        let [x, y, z, w] = std::array::from_fn(|_| rng.random_range(-1.0..1.0));
        let q = DQuat::from_xyzw(x, y, z, w);
        if (0.1..1.0).contains(&q.length()) {
            return q.normalize();
        }
    }
}

fn geometry(rng: &mut Pcg64Mcg) -> Geometry {
    let radius = rng.random_range(0.01..0.3);
    let length = rng.random_range(0.02..0.6);
    match rng.random_range(0..4) {
        0 => Geometry::Sphere { radius },
        1 => Geometry::Box { size: DVec3::from_array(std::array::from_fn(|_| rng.random_range(0.02..0.6))) },
        2 => Geometry::Cylinder { radius, length },
        _ => Geometry::Capsule { radius, length },
    }
}

fn thickness(geometry: &Geometry) -> f64 {
    match geometry {
        Geometry::Sphere { radius } | Geometry::Capsule { radius, .. } => 2.0 * radius,
        Geometry::Box { size } => size.min_element(),
        Geometry::Cylinder { radius, length } => length.min(2.0 * radius),
        Geometry::Hull { .. } => unreachable!(),
    }
}

/// Principal moments of a solid like the shape.
fn moments(geometry: &Geometry, mass: f64) -> DVec3 {
    match geometry {
        Geometry::Sphere { radius } => DVec3::splat(0.4 * mass * radius * radius),
        Geometry::Box { size } => {
            let s = *size * *size;
            DVec3::new(s.y + s.z, s.x + s.z, s.x + s.y) * (mass / 12.0)
        }
        Geometry::Cylinder { radius, length } | Geometry::Capsule { radius, length } => {
            let across = mass * (3.0 * radius * radius + length * length) / 12.0;
            DVec3::new(across, across, 0.5 * mass * radius * radius)
        }
        Geometry::Hull { .. } => unreachable!(),
    }
}

impl Sample {
    fn new(index: u64, lever: f64) -> Self {
        let mut rng = Pcg64Mcg::seed_from_u64(SEED << 32 | index);
        let rng = &mut rng;
        let geometry = geometry(rng);
        let shape_origin = Pose { rotation: DMat3::from_quat(rotation(rng)), translation: vector(rng, 1.0) * lever };
        let mass = rng.random_range(0.5..20.0);
        let inertia =
            shape_origin.rotation * DMat3::from_diagonal(moments(&geometry, mass)) * shape_origin.rotation.transpose();
        let normal = if rng.random_bool(0.5) {
            DVec3::Z
        } else {
            // a slope of up to 60 degrees
            let (turn, tilt) = (rng.random_range(0.0..std::f64::consts::TAU), rng.random_range(0.0..1.05_f64));
            DVec3::new(tilt.sin() * turn.cos(), tilt.sin() * turn.sin(), tilt.cos())
        };
        let plane = Plane { normal: normal.to_array(), offset: rng.random_range(-1.0..1.0) };
        let turn = if rng.random_bool(0.1) {
            // a face, an end or a side down, up to a little
            let upright =
                DQuat::from_rotation_arc(DVec3::Z, normal) * DQuat::from_mat3(&shape_origin.rotation).inverse();
            let axis = vector(rng, 1.0).try_normalize().unwrap_or(DVec3::X);
            DQuat::from_axis_angle(axis, rng.random_range(0.0..2.0 * UPRIGHT)) * upright
        } else {
            rotation(rng)
        };
        // inside the shape
        let com = shape_origin.translation + vector(rng, 0.25 * thickness(&geometry));
        let mut sample = Self {
            state: State::zeros(&articulation(&geometry, &shape_origin, mass, com, inertia).topology),
            friction: if rng.random_bool(0.5) { 0.0 } else { rng.random_range(0.1..1.2) },
            geometry,
            shape_origin,
            mass,
            com,
            inertia,
            plane,
        };
        sample.state.rotation = [turn.w, turn.x, turn.y, turn.z].map(|x| x as f32);
        let gap = match rng.random_range(0..3) {
            0 => rng.random_range(MARGIN..0.5),
            1 => rng.random_range(0.0..MARGIN),
            _ => rng.random_range(-0.05..0.0),
        };
        let place = vector(rng, 1.0);
        let at = |place: DVec3, sample: &mut Self| sample.state.position = place.as_vec3().to_array();
        at(place, &mut sample);
        let place = place + normal * (gap - sample.distance(&sample.state));
        at(place, &mut sample);
        if gap >= 0.0 {
            sample.state.linear_velocity = vector(rng, 2.0).as_vec3().to_array();
            sample.state.angular_velocity = vector(rng, 3.0).as_vec3().to_array();
        }
        sample
    }

    fn articulation(&self) -> Articulation {
        articulation(&self.geometry, &self.shape_origin, self.mass, self.com, self.inertia)
    }

    /// Distance of the shape from the plane by its support function.
    fn distance(&self, state: &State<f32>) -> f64 {
        let [w, x, y, z] = state.rotation.map(f64::from);
        let base = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
        let normal = DVec3::from_array(self.plane.normal);
        let centre = DVec3::from_array(state.position.map(f64::from)) + base * self.shape_origin.translation;
        // components of the normal along the shape's axes
        let n = (base * self.shape_origin.rotation).transpose() * normal;
        let reach = match &self.geometry {
            Geometry::Sphere { radius } => *radius,
            Geometry::Box { size } => 0.5 * n.abs().dot(*size),
            Geometry::Cylinder { radius, length } => 0.5 * length * n.z.abs() + radius * n.x.hypot(n.y),
            Geometry::Capsule { radius, length } => 0.5 * length * n.z.abs() + radius,
            Geometry::Hull { .. } => unreachable!(),
        };
        normal.dot(centre) - self.plane.offset - reach
    }

    /// Sine of the angle between the shape's axis and the plane's normal.
    fn lean(&self, state: &State<f32>) -> f64 {
        let [w, x, y, z] = state.rotation.map(f64::from);
        let base = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
        let n = (base * self.shape_origin.rotation).transpose() * DVec3::from_array(self.plane.normal);
        n.x.hypot(n.y)
    }

    /// How much further than the true distance the nearest candidate may be.
    fn slack(&self) -> f64 {
        match self.geometry {
            // three fixed points of an upright cylinder's rim: the nearest is at most 60 degrees
            // off the lowest
            Geometry::Cylinder { radius, .. } if self.lean(&self.state) < UPRIGHT * 1.001 => {
                0.5 * radius * self.lean(&self.state)
            }
            _ => 0.0,
        }
    }

    /// How far a step may take the lowest point off its tangent, as the body turns: constraints
    /// hold for velocities.
    fn curvature(&self, start: &State<f32>, end: &State<f32>) -> f64 {
        // the motion that pushes a body out also turns it, but is no part of the velocity
        let [a, b] = [start, end].map(|state| DQuat::from_array(state.rotation.map(f64::from)).normalize());
        let angle = a.angle_between(b).max(DVec3::from_array(end.angular_velocity.map(f64::from)).length() * DT);
        let rim = match self.geometry {
            // an end that turns on its rim comes down between two of its three points
            Geometry::Cylinder { radius, .. } => {
                let (a, b) = (self.lean(start), self.lean(end));
                let around = (angle / a.min(b)).min(FRAC_PI_3);
                radius * a.max(b) * (1.0 - around.cos())
            }
            _ => 0.0,
        };
        0.5 * angle * angle * self.reach() + rim
    }

    /// The furthest point of the shape from the base's origin.
    fn reach(&self) -> f64 {
        let size = match &self.geometry {
            Geometry::Sphere { radius } => *radius,
            Geometry::Box { size } => 0.5 * size.length(),
            Geometry::Cylinder { radius, length } => radius.hypot(0.5 * length),
            Geometry::Capsule { radius, length } => radius + 0.5 * length,
            Geometry::Hull { .. } => unreachable!(),
        };
        size + self.shape_origin.translation.length()
    }
}

fn articulation(geometry: &Geometry, origin: &Pose, mass: f64, com: DVec3, inertia: DMat3) -> Articulation {
    let model = Model {
        name: "body".into(),
        source: PathBuf::new(),
        links: vec![Link { name: "body".into(), mass, com, inertia, merged: Vec::new() }],
        joints: Vec::new(),
        bodies: vec![Body {
            name: "body".into(),
            link: 0,
            shapes: vec![Shape { geometry: geometry.clone(), origin: *origin }],
            surface: BodySurface::default(),
        }],
        locked: Vec::new(),
        warnings: Vec::new(),
    };
    Articulation::new(&model, true, &[], None)
}

/// Result of a physics step.
struct Outcome {
    state: State<f32>,
    force: DVec3,
}

/// Some physics steps of a sample; without ground if `ground` is false.
struct PackWorkspace {
    articulation: Articulation,
    parameters: Parameters<f32>,
    work: Workspace<f32>,
    settings: ContactSettings,
}

impl PackWorkspace {
    fn new(sample: &Sample) -> Self {
        let articulation = sample.articulation();
        let mut parameters = Parameters::from_scalars(&articulation.topology, &articulation.parameters);
        parameters.static_friction = sample.friction as f32;
        parameters.dynamic_friction = sample.friction as f32;
        let work = Workspace::new(&articulation.topology);
        // a box on eight corners that share its load; robots are content with fewer
        let settings = ContactSettings { iterations: 8, ground: Some(sample.plane), ..ContactSettings::default() };
        Self { articulation, parameters, work, settings }
    }

    fn gap(&mut self, state: &State<f32>) -> f64 {
        let topology = &self.articulation.topology;
        let gaps = f32::candidate_gaps(topology, &self.parameters, &self.settings, state, &mut self.work);
        assert_eq!(gaps.len(), topology.contacts.len());
        gaps.into_iter().fold(f64::INFINITY, |least, gap| least.min(f64::from(gap)))
    }

    fn step(&mut self, state: &State<f32>, ground: bool) -> Outcome {
        let topology = &self.articulation.topology;
        let contact = ContactSettings { ground: self.settings.ground.filter(|_| ground), ..self.settings };
        let settings = StepSettings { dt: DT, decimation: 1, gravity: GRAVITY, contact };
        let mut state = state.clone();
        let mut report = Report::zeros(topology, 1);
        ControlStep {
            topology,
            settings: &settings,
            terrain: None,
            parameters: &self.parameters,
            nominal: None,
            drive: &Drive::zeros(topology, 1),
            substeps: 0..1,
            state: &mut state,
            report: &mut report,
            work: &mut self.work,
        }
        .run();
        Outcome { state, force: DVec3::from_array(report.body_force[0].map(f64::from)) }
    }
}

fn nearly(a: &State<f32>, b: &State<f32>) -> bool {
    let close = |a: &[f32], b: &[f32]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5);
    close(&a.linear_velocity, &b.linear_velocity) && close(&a.angular_velocity, &b.angular_velocity)
}

fn motion(state: &State<f32>) -> ([f32; 3], [f32; 4], [f32; 3], [f32; 3]) {
    (state.position, state.rotation, state.linear_velocity, state.angular_velocity)
}

/// Fault of a sample, if any.
fn check(sample: &Sample) -> Result<(), String> {
    let ensure = |holds: bool, what: &dyn Fn() -> String| if holds { Ok(()) } else { Err(what()) };
    let mut workspace = PackWorkspace::new(sample);
    let before = sample.distance(&sample.state);
    let gap = workspace.gap(&sample.state);
    ensure(gap > before - EXACT && gap < before + EXACT + sample.slack(), &|| {
        format!("nearest candidate at {gap} m, true distance {before} m")
    })?;

    let Outcome { state, force } = workspace.step(&sample.state, true);
    let free = workspace.step(&sample.state, false).state;
    let impulses = &state.impulse;
    let touches = impulses.iter().any(|impulse| *impulse != [0.0; 3]);
    let after = sample.distance(&state);

    // nothing is felt where nothing touches
    let clear =
        gap > MARGIN + EXACT || (gap > 0.0 && sample.distance(&free) > sample.curvature(&sample.state, &free) + EXACT);
    if clear {
        ensure(!touches && force == DVec3::ZERO, &|| format!("phantom contact: gap {gap} m, impulses {impulses:?}"))?;
    }
    let same = match gap > MARGIN + EXACT {
        true => motion(&state) == motion(&free),
        // a contact's row may have pushed in one sweep and let go in another, up to rounding
        false => touches || nearly(&state, &free),
    };
    ensure(same, &|| "no contact, yet not in free fall".into())?;

    // contacts push, inside the cone of friction
    for [normal, t1, t2] in impulses.iter().map(|impulse| impulse.map(f64::from)) {
        ensure(normal >= 0.0, &|| format!("pulls with {normal} N s"))?;
        let most = sample.friction * normal;
        ensure(t1.hypot(t2) <= most * (1.0 + 1e-5), &|| format!("friction {} N s of {most} N s", t1.hypot(t2)))?;
    }
    let normal = DVec3::from_array(sample.plane.normal);
    let sum: f64 = impulses.iter().map(|impulse| f64::from(impulse[0])).sum();
    let along = force.dot(normal);
    ensure((along - sum / DT).abs() <= 1e-5 * along.abs(), &|| format!("force {along} N, impulses {} N", sum / DT))?;
    if sample.friction == 0.0 {
        let across = (force - normal * along).length();
        ensure(across <= 1e-6 * along, &|| format!("a force of {across} N across the normal, {along} N along it"))?;
    }

    // and outwards
    if before < -EXACT {
        ensure(sum > 0.0, &|| format!("{before} m deep and not pushed"))?;
    }
    let lost = before.min(0.0) - after - sample.curvature(&sample.state, &state);
    let allowed = match (before < 0.0, sample.friction == 0.0) {
        (true, _) => EXACT,
        // eight sweeps over eight corners leave a little
        (false, true) => 3.0 * EXACT,
        (false, false) => UNSOLVED,
    };
    ensure(lost < allowed, &|| format!("goes from {before} m to {after} m, {lost} m more than its turning explains"))?;
    Ok(())
}

#[test]
fn one_step_of_a_hundred_thousand_bodies() {
    let mut bad = Vec::new();
    for index in 0..size(100_000, 1_000_000) {
        let sample = Sample::new(index, LEVER);
        if let Err(what) = check(&sample) {
            bad.push(format!("SEED {SEED}, Sample::new({index}, {LEVER}): {what}\n{sample:?}"));
        }
    }
    assert!(bad.is_empty(), "{} samples fail, among them\n{}", bad.len(), bad[..bad.len().min(3)].join("\n"));
}

/// Bodies that start inside the ground, at rest, with their origin in the shape as a robot's is: on
/// the way out no step takes them deeper.
#[test]
fn bodies_are_pushed_out() {
    let mut samples: Vec<(u64, Sample)> =
        (0..size(4000, 40_000)).map(|index| (index, Sample::new(index, 0.0))).collect();
    samples.retain(|(_, sample)| sample.distance(&sample.state) < 0.0);
    assert!(samples.len() > 1000);
    for (index, sample) in samples {
        let mut workspace = PackWorkspace::new(&sample);
        let mut state = sample.state.clone();
        let mut distance = sample.distance(&state);
        let mut highest = distance;
        // 5 cm at 5 mm, then a fifth, per step
        for step in 0..40 {
            let next = workspace.step(&state, true).state;
            let now = sample.distance(&next);
            let lost = distance.min(0.0) - now - sample.curvature(&state, &next);
            assert!(
                lost < 3e-4, // at speeds up to 1 m/s, after eight sweeps; measured: 0.12 mm
                "SEED {SEED}, Sample::new({index}, 0.0), step {step}: from {distance} m to {now} m\n{sample:?}"
            );
            (state, distance, highest) = (next, now, highest.max(now));
        }
        // less than 0.1 mm is left alone; 0.5 mm for the points that stand for a rim
        assert!(highest > -6e-4, "SEED {SEED}, Sample::new({index}, 0.0): still {highest} m deep\n{sample:?}");
    }
}
