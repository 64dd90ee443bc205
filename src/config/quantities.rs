//! Quantities of configs: the range of numbers that a simulation can use, and the unit.
//!
//! Bounds are generous. Beyond them lies a mistake, or a number that single precision turns into an
//! infinity or a zero.

/// A quantity of a config.
pub trait Quantity {
    /// The least number.
    const LEAST: f64;
    /// The greatest number.
    const MOST: f64;
    /// Unit of the quantity, after a space; empty for plain numbers.
    const UNIT: &'static str;
}

macro_rules! quantities {
    ($( $(#[$doc:meta])* $name:ident: $least:expr => $most:expr, $unit:literal; )*) => { $(
        $(#[$doc])*
        pub enum $name {}

        impl Quantity for $name {
            const LEAST: f64 = $least;
            const MOST: f64 = $most;
            const UNIT: &'static str = $unit;
        }
    )* };
}

quantities! {
    /// A component of gravity.
    Gravity: -100.0 => 100.0, " m/s^2";
    /// An angle, or a sliding joint's position.
    Angle: -1000.0 => 1000.0, " rad";
    /// An angle of a base from the vertical that ends an episode.
    Tilt: 0.01 => std::f64::consts::PI, " rad";
    /// A camera's angle of view.
    ViewAngle: 0.01 => 3.0, " rad";
    /// The farthest that a camera sees.
    CameraRange: 0.01 => 100.0, " m";
    /// A time by which something is late.
    Latency: 0.0 => 10.0, " s";
    /// An angle by which an object on the ground leans.
    LeanDegrees: 0.0 => 60.0, " degrees";
    /// A place along an axis of the world.
    Coordinate: -1e4 => 1e4, " m";
    /// A length.
    Length: 1e-3 => 1e4, " m";
    /// A length that may be zero.
    Extent: 0.0 => 1e4, " m";
    /// A distance of neighbouring points or heights.
    Spacing: 1e-5 => 100.0, " m";
    /// A height above or below something.
    Height: -100.0 => 100.0, " m";
    /// A height above something.
    Rise: 0.0 => 100.0, " m";
    /// Rise over run.
    Slope: 0.0 => 1000.0, "";
    /// Rise over run that is not zero.
    SteepSlope: 1e-3 => 1e6, "";
    /// Difficulty of terrain.
    Difficulty: -10.0 => 10.0, "";
    /// Proportion among others.
    Proportion: 1e-6 => 1e6, "";
    /// A number of cycles per second.
    Frequency: 0.0 => 100.0, " Hz";
    /// A part of a cycle.
    Turns: 0.0 => 1.0, "";
    /// A count of control steps.
    Steps: 0.0 => 1e15, " control steps";
    /// A time that may be zero.
    Time: 0.0 => 1e6, " s";
    /// A time within which something happens.
    Duration: 1e-6 => 1e9, " s";
    /// Torque per position error.
    Stiffness: 0.0 => 1e6, " N m/rad";
    /// Torque per velocity.
    Damping: 0.0 => 1e6, " N m s/rad";
    /// A motor's largest torque.
    TorqueLimit: 1e-3 => 1e6, " N m";
    /// A torque's magnitude.
    Friction: 0.0 => 1e6, " N m";
    /// A joint's largest speed.
    JointSpeedLimit: 1e-3 => 1e6, " rad/s";
    /// A rotor's inertia as seen at the joint.
    RotorInertia: 0.0 => 1e3, " kg m^2";
    /// Joint target per unit of action.
    ActionScale: 1e-6 => 100.0, " rad per unit of action";
    /// A joint's velocity at a reset.
    JointVelocity: -500.0 => 500.0, " rad/s";
    /// A base's velocity at a reset; episodes of faster bases end at once.
    BaseVelocity: -50.0 => 50.0, " m/s or rad/s";
    /// A velocity that a push adds.
    Push: -100.0 => 100.0, " m/s";
    /// A planar speed from which something counts.
    SpeedThreshold: 0.0 => 1000.0, " m/s";
    /// A speed beyond which a state counts as broken; what walks is faster than the least.
    SpeedLimit: 1.0 => 1e6, " m/s or rad/s";
    /// A speed at which shapes are pushed apart.
    PushSpeed: 1e-6 => 1000.0, " m/s";
    /// A mass that is added.
    MassOffset: -1e4 => 1e4, " kg";
    /// A shift of a centre of mass.
    Shift: -10.0 => 10.0, " m";
    /// A component of a force or a torque.
    Force: -1e5 => 1e5, " N or N m";
    /// A normal force from which something counts.
    ForceThreshold: 0.0 => 1e6, " N";
    /// A coefficient of friction.
    FrictionCoefficient: 0.0 => 100.0, "";
    /// A coefficient of torsional or rolling friction.
    FrictionLength: 0.0 => 10.0, " m";
    /// A factor of either sign.
    Factor: -1e6 => 1e6, "";
    /// A factor that makes nothing smaller than zero.
    Gain: 0.0 => 1e6, "";
    /// A factor between a body and another one.
    BodyFactor: 0.01 => 100.0, "";
    /// The share of its torque that a motor gives.
    Strength: 0.0 => 100.0, "";
    /// A limit of a number that is observed.
    Bound: -1e9 => 1e9, "";
    /// A power to which factors are raised.
    Power: 0.0 => 10.0, "";
    /// Half the width of a noise.
    Noise: 0.0 => 1e6, "";
    /// The width of a bell curve: its square divides.
    Width: 1e-4 => 1e6, "";
    /// A reward term's factor.
    Weight: -1e6 => 1e6, "";
}
