//! Every number that was chosen and not derived: what a caller sets, and what the kernels were
//! tuned with.

use super::ground::Plane;

/// Usual number of Gauss-Seidel sweeps per physics step.
///
/// Their error is a fifth to a half of the error of a physics step of 5 ms (`polypod accuracy`,
/// table "Error of the contact solver"). Eight sweeps halve that and cost a ninth of a control
/// step.
pub const SWEEPS: usize = 4;

/// Settings that all packs of a simulation share.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepSettings {
    /// Physics step, s.
    pub dt: f64,
    /// Physics steps per control step.
    pub decimation: usize,
    /// Gravity in world axes, m/s^2.
    pub gravity: [f64; 3],
    /// Contacts and joint bounds.
    pub contact: ContactSettings,
}

/// Settings of contacts and joint bounds by a task or a caller.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ContactSettings {
    /// Gauss-Seidel sweeps per physics step: fewer where they change little, more where links are
    /// jammed.
    pub iterations: usize,
    /// Share of a penetration that one physics step removes.
    pub correction: f64,
    /// Largest speed at which a penetration is pushed out, m/s.
    pub max_depenetration_velocity: f64,
    /// Approach speed from which restitution acts, m/s.
    pub bounce_threshold: f64,
    /// Ground below the robots; None for none.
    pub ground: Option<Plane>,
    /// The tuned constants.
    pub solver: SolverSettings,
}

impl Default for ContactSettings {
    fn default() -> Self {
        Self {
            iterations: SWEEPS,
            correction: 0.2,
            max_depenetration_velocity: 1.0,
            bounce_threshold: 0.5,
            ground: Some(Plane::level(0.0)),
            solver: SolverSettings::default(),
        }
    }
}

/// Tuned constants of contacts and joint bounds.
///
/// No task changes them. They are fields, so that an experiment needs no new build of the kernels
/// and so that a snapshot of a simulation knows them. The kernels read a field where they used a
/// literal: the bits are the same.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SolverSettings {
    // Bounds for constraints to take part in a physics step. Each constraint costs all lanes of a
    // pack.
    /// Largest gap at which a ground contact takes part, m. A larger gap finds faster approaches in
    /// time and builds more rows. 2 cm is what a point at 4 m/s moves in 5 ms.
    pub ground_margin: f64,
    /// Gap at which a ground contact takes part whatever its velocity, m. The approach of the point
    /// in the step is added. It leaves room for velocities that the other constraints of the step
    /// cause: 4 mm in 5 ms is 0.8 m/s.
    pub ground_reach: f64,
    /// Gap at which a pair of links takes part whatever its velocity, m; otherwise as
    /// `ground_reach`. Less, since many links of a robot are always near each other. Chosen by
    /// hand.
    pub pair_reach: f64,
    /// Margin of the coarse tests of pairs, m. It exceeds the rounding error of `f32` positions a
    /// few metres long, so that a coarse test never rejects what the exact one accepts.
    pub pair_rounding: f64,
    /// Distance from a position limit at which it takes part whatever the joint's velocity, rad or
    /// m. The joint's way in two physics steps is added.
    pub limit_reach: f64,
    /// Largest such distance, rad or m. In between it is the way in one step at the velocity limit:
    /// a contact may throw a joint against its stop within one step. The bound keeps joints without
    /// a velocity limit out.
    pub max_limit_reach: f64,
    /// Share of the velocity limit from which it takes part. The rest is room for what a joint
    /// gains in one step. Chosen by hand.
    pub velocity_limit_share: f64,

    // How far constraints give way.
    /// Compliance of ground contacts along their normals, as a share of the whole robot's
    /// compliance (one over its mass). It bounds the impulses of contacts that cannot be satisfied,
    /// such as a fixed base with its feet in the ground. A standing robot sinks by less than a
    /// micrometre.
    pub ground_compliance: f64,
    /// Compliance of contacts between links of one robot, ten times as much: these may press where
    /// no joint gives way, which a floating robot never does against the ground. With rigid
    /// contacts such robots flew apart.
    pub pair_compliance: f64,
    /// Least compliance of a contact's tangents, as a share of the whole robot's. A floating robot
    /// gives way at least as its whole mass would; a link fixed to the world may not give way at
    /// all, and the division stays finite.
    pub min_tangent_compliance: f64,
    /// Penetration that is left alone, m. With 0.1 mm most steps have nothing to push out, which
    /// saves a standing robot a thirtieth of its time over 0.01 mm.
    pub penetration_slop: f64,
    /// Excess over a position limit that is left alone, rad or m. Limits are exact in reduced
    /// coordinates: less will do.
    pub limit_slop: f64,

    // The regular sweeps.
    /// Regular sweeps from one measurement of their effect to the next; 0 measures none. A
    /// measurement reads the whole velocity twice: with four sweeps it pays once.
    pub check_interval: usize,
    /// The regular sweeps end in lanes where one changes the velocity by less than this, m/s of the
    /// whole robot in kinetic energy. A leg of a hundredth of the mass may still change ten times
    /// as much. It trades time (a seventh of a control step of standing robots) against creep,
    /// which stays below 1 mm in 10 s on a slope of 20 degrees.
    pub min_change: f64,

    // Extra rounds where links are jammed. A light leg between a joint limit and the ground gets
    // little of the base's weight per sweep; a base that goes on falling while it is held up wins
    // energy.
    /// Extra rounds at most. They bound the time of a pack in which a robot never settles.
    pub max_extra_rounds: usize,
    /// Sweeps of an extra round at most.
    pub sweeps_per_round: usize,
    /// A contact is settled when another sweep would change its velocity by less than this, m/s.
    /// Lower values spend on every footfall what only jams need.
    pub settled_change: f64,
    /// Push speed from which a contact counts as deep, m/s: 1 mm of penetration in steps of 5 ms.
    pub deep_push: f64,
    /// `settled_change` of deep contacts, m/s. A link between the ground and the base that gives
    /// way a little in every step sinks: at 0.3 m/s as far as 23 mm
    /// (`tests/physics/jammed_links_do_not_sink.rs`).
    pub settled_change_deep: f64,
    /// Shares of the squared friction bound between which friction counts as being at its bound.
    /// Wide enough for the rounding of an impulse that was scaled onto the bound.
    pub at_friction_bound: [f64; 2],
    /// Least response of a normal velocity to its impulse and the friction that follows, as a share
    /// of the response without friction. Friction may drive a point into the ground faster than the
    /// impulse lifts it; the division stays stable.
    pub min_following_response: f64,
    /// Share of its way that a normal impulse goes when it turns back. Half ends a cycle between
    /// two states.
    pub turn_back_share: f64,

    // Limits, and the push out of penetrations, which moves bodies without velocity.
    /// Sweeps over joint limits alone after each round, at most. They have the last word: a contact
    /// that gives way is soft ground, a limit that gives way is a broken leg.
    pub limit_sweeps: usize,
    /// These sweeps end in lanes where none changes a joint velocity by more than this, rad/s or
    /// m/s. In 5 ms it turns a joint by less than a microradian.
    pub limit_tolerance: f64,
    /// Sweeps that push penetrations out, at most. The next step pushes the rest.
    pub push_sweeps: usize,
    /// These sweeps end in lanes where none changes a velocity by more than this, m/s or rad/s. In
    /// 5 ms it moves a point by 5 micrometres, a twentieth of `penetration_slop`.
    pub push_tolerance: f64,
}

impl Default for SolverSettings {
    fn default() -> Self {
        Self {
            ground_margin: 0.02,
            ground_reach: 0.004,
            pair_reach: 0.002,
            pair_rounding: 1e-4,
            limit_reach: 0.05,
            max_limit_reach: 0.25,
            velocity_limit_share: 0.7,
            ground_compliance: 1e-3,
            pair_compliance: 0.01,
            min_tangent_compliance: 0.5,
            penetration_slop: 1e-4,
            limit_slop: 1e-5,
            check_interval: 2,
            min_change: 0.0005,
            max_extra_rounds: 14,
            sweeps_per_round: 4,
            settled_change: 0.3,
            deep_push: 0.04,
            settled_change_deep: 0.03,
            at_friction_bound: [0.98, 1.02],
            min_following_response: 0.2,
            turn_back_share: 0.5,
            limit_sweeps: 8,
            limit_tolerance: 1e-4,
            push_sweeps: 4,
            push_tolerance: 0.001,
        }
    }
}

// Constants that are no fields. The actuators' share is part of the integrator, a fixed number of
// halvings is a loop that the compiler unrolls, and a height grid answers rays and scanners, which
// have no settings at hand.

/// Share of a step by which an actuator's stiffness looks ahead: numerical damping of
/// `STIFFNESS_LOOK_AHEAD * dt * kp`.
///
/// 1 is the backward Euler method, whose damping at 5 ms is a quarter of the legs' own; 0 damps
/// nothing. Values of 0.1 to 0.3 follow a step of the target most closely (measured by `polypod
/// accuracy`).
pub(super) const STIFFNESS_LOOK_AHEAD: f64 = 0.2;
/// Share of `dt^2 kp` that joins the diagonal: the least that keeps every stiffness and step
/// stable. Newmark's beta over his gamma = 1/2 + `STIFFNESS_LOOK_AHEAD`, `(gamma + 1/2)^2 / 4`.
pub(super) const IMPLICIT_STIFFNESS: f64 = (1.0 + STIFFNESS_LOOK_AHEAD) * (1.0 + STIFFNESS_LOOK_AHEAD) / 4.0;
/// Share of `dt^2 k` of a joint's spring that joins the diagonal: Newmark's method with average
/// acceleration (`gamma = 1/2`). It is stable for every stiffness and damps nothing: a spring loses
/// no energy to the step.
pub(super) const SPRING_STIFFNESS: f64 = 0.25;
/// Halvings in the search for the point of a segment that is nearest to a box. They leave 1/256 of
/// the segment.
pub(super) const SEGMENT_HALVINGS: usize = 9;
/// Squared length below which a vector between two shapes has no direction, m^2: 10 micrometres,
/// which `f32` resolves.
pub(super) const MIN_SQUARED_LENGTH: f64 = 1e-10;
/// The steepest slope that a contact feels, rise over run. In a grid a wall is a slope within one
/// cell; a steeper normal would be horizontal but for rounding.
pub(super) const MAX_SLOPE: f32 = 10.0;
/// Depth below a cell's plane from which the ground beyond the cell's side falls away, m. More
/// would round fewer edges of steps; less would take the rounding of a smooth surface for an edge.
pub(super) const MIN_DROP: f64 = 1e-3;
/// Edge lengths of the squares whose largest heights are known, m, for links and for contact
/// candidates. Small squares reject more, and a link must fit into one.
pub(super) const HEIGHT_SQUARES: [f32; 2] = [0.5, 0.125];
