//! Start of a new episode: the robot is lifted above the ground, and quantities that follow from
//! its state are computed.

use bevy_ecs::prelude::*;

use super::StateWritten;
use crate::blocks::{Block, Blocks};
use crate::components::{BasePose, BaseVelocity, Body, Env, EnvOrigin, Episode, Feet, JointState, Robot};
use crate::dynamics::lanes::{Kernel, SimdDispatch};
use crate::dynamics::math::{Mat3, Spatial, add, dot, mul_vec, mul_vec_transposed, quat_to_mat, splat};
use crate::dynamics::{ContactKind, HeightGrid, Parameters, Topology, Workspace, forward_kinematics, point_motion};
use crate::morphology::{Morphologies, MorphologyModel};
use crate::workers::{Pool, Workers};
use crate::world::Ground;

/// Half the side of the square about the base's origin above whose highest ground a robot begins,
/// m.
const FOOTPRINT: f32 = 0.5;
/// Distance below which a shape counts as placed, m: the default pose is, but for rounding.
const TOLERANCE: f32 = 1e-4;

/// Components of robots that are read and written.
type RobotColumns =
    (&'static Body, &'static BaseVelocity, &'static JointState, &'static mut BasePose, &'static mut Feet);

/// Scratch memory of a thread, of each morphology that it has met.
type Scratch = Vec<Option<Workspace<f32>>>;

/// Lifts the robots whose episode has just begun above the ground, and places their feet.
///
/// The reset sampled a pose, and maybe a body, with another lowest point than the default pose. A
/// robot whose state a caller has written stays where it is.
pub(super) fn place_robots(
    workers: Res<Workers>,
    morphologies: Res<Morphologies>,
    ground: Res<Ground>,
    written: Res<StateWritten>,
    mut pool: Local<Option<Pool<Scratch>>>,
    mut robots: Blocks<RobotColumns, Robot>,
    envs: Blocks<(&'static Episode, &'static EnvOrigin), Env>,
) -> Result {
    let envs = envs.read()?;
    if !envs.iter().any(|block| block.rows.0.iter().any(|episode| episode.fresh)) {
        return Ok(());
    }
    let morphologies = &*morphologies;
    let scratch = || morphologies.0.iter().map(|_| None).collect();
    let pool = &*pool.get_or_insert_with(|| Pool::new(workers.threads(), scratch));
    let (ground, lifts) = (&*ground, !written.0);
    robots.write()?.zip(envs).for_each_chunk(&workers, |Block { morphology, rows, .. }| {
        let ((bodies, velocities, joints, poses, feet), (episodes, origins)) = rows;
        pool.with(|scratch| {
            workers.dispatch().vectorize(PlacedRows {
                simd: workers.dispatch(),
                morphology: morphologies.get(morphology),
                ground,
                lifts,
                work: &mut scratch[usize::from(morphology.0)],
                bodies,
                velocities,
                joints,
                episodes,
                origins,
                poses,
                feet,
            });
        });
    });
    Ok(())
}

struct PlacedRows<'a> {
    simd: SimdDispatch,
    morphology: &'a MorphologyModel,
    ground: &'a Ground,
    lifts: bool,
    work: &'a mut Option<Workspace<f32>>,
    bodies: &'a [Body],
    velocities: &'a [BaseVelocity],
    joints: &'a [JointState],
    episodes: &'a [Episode],
    origins: &'a [EnvOrigin],
    poses: &'a mut [BasePose],
    feet: &'a mut [Feet],
}

impl Kernel<f32> for PlacedRows<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { simd, morphology, ground, lifts, work, bodies, velocities, joints, episodes, origins, poses, feet } =
            self;
        for i in 0..bodies.len() {
            if !episodes[i].fresh {
                continue;
            }
            let work = work.get_or_insert_with(|| Workspace::new(&morphology.topology));
            let posed = Posed {
                simd,
                topology: &morphology.topology,
                parameters: &bodies[i].0,
                rotation: quat_to_mat(&poses[i].rotation),
                lifts,
                work,
            };
            posed.place(morphology, ground, &origins[i], (&velocities[i], &joints[i]), &mut poses[i], &mut feet[i]);
        }
    }
}

/// A robot, and memory for its links.
struct Posed<'a> {
    simd: SimdDispatch,
    topology: &'a Topology,
    parameters: &'a Parameters<f32>,
    /// Turns base axes to world axes.
    rotation: Mat3<f32>,
    /// Whether it is lifted above the ground.
    lifts: bool,
    work: &'a mut Workspace<f32>,
}

impl Posed<'_> {
    #[inline(always)]
    fn place(
        self,
        morphology: &MorphologyModel,
        ground: &Ground,
        origin: &EnvOrigin,
        (velocity, joints): (&BaseVelocity, &JointState),
        pose: &mut BasePose,
        feet: &mut Feet,
    ) {
        let base = Spatial { ang: velocity.angular, lin: mul_vec_transposed(&self.rotation, &velocity.linear) };
        let (q, qd) = (&joints.position, &joints.velocity);
        forward_kinematics(self.simd, self.topology, self.parameters, q, qd, &base, self.work);
        if self.lifts {
            self.lift(morphology, ground, origin, pose);
        }
        for (s, &link) in self.topology.sites.iter().enumerate() {
            let (at, motion) = point_motion(&self.work.links[link], &self.parameters.site_position[s]);
            feet.position[s] = add(&pose.position, &mul_vec(&self.rotation, &at));
            feet.velocity[s] = mul_vec(&self.rotation, &motion);
        }
        feet.measure(ground, origin);
    }

    /// Lifts the base until no collision shape is nearer to the ground than the reset's margin.
    #[inline(always)]
    fn lift(&self, morphology: &MorphologyModel, ground: &Ground, origin: &EnvOrigin, pose: &mut BasePose) {
        let margin = morphology.config.reset.spawn_margin as f32;
        let missing = match &ground.terrain {
            None => margin - (pose.position[2] + self.lowest() - ground.height as f32),
            Some(grid) => {
                let ([x, y, z], [x0, y0]) = (&mut pose.position, origin.position);
                let at = [x0 + *x, y0 + *y];
                let highest = grid.highest_near(at[0], at[1], FOOTPRINT);
                *z += highest - ground.height as f32;
                self.missing_on(grid, at, highest, margin - *z)
            }
        };
        if missing > TOLERANCE {
            pose.position[2] += missing;
        }
    }

    /// Height of a contact candidate's lowest point above the base's origin, m, and its centre,
    /// base axes.
    #[inline(always)]
    fn candidate(&self, contact: usize) -> (f32, [f32; 3]) {
        let (of, p) = (&self.topology.contacts[contact], self.parameters);
        let (link, up) = (&self.work.links[of.link], &self.rotation[2]);
        let centre = add(&link.position, &mul_vec(&link.rotation, &p.contact_position[contact]));
        let mut below = p.contact_radius[contact];
        if let ContactKind::Rim { across, .. } = of.kind {
            let up = mul_vec_transposed(&link.rotation, up);
            let (c, s) = (dot(&splat(&across[0]), &up), dot(&splat(&across[1]), &up));
            below += p.contact_rim[contact] * c.mul_add(c, s * s).sqrt();
        }
        (dot(up, &centre) - below, centre)
    }

    /// Height of the robot's lowest point above the base's origin, m.
    #[inline(always)]
    fn lowest(&self) -> f32 {
        let mut lowest = f32::INFINITY;
        for contact in 0..self.topology.contacts.len() {
            lowest = lowest.min(self.candidate(contact).0);
        }
        lowest
    }

    /// Length by which some candidate's lowest point is less than `least` above the base's origin
    /// and the ground around it, m; `highest` is the highest ground in the footprint about the
    /// base, which is `at` a place of the grid.
    #[inline(always)]
    fn missing_on(&self, grid: &HeightGrid, at: [f32; 2], highest: f32, least: f32) -> f32 {
        let mut missing = f32::NEG_INFINITY;
        for contact in 0..self.topology.contacts.len() {
            let (low, centre) = self.candidate(contact);
            let [x, y] = [dot(&self.rotation[0], &centre), dot(&self.rotation[1], &centre)];
            let reach = self.parameters.contact_radius[contact] + self.parameters.contact_rim[contact];
            let is_within = x.abs().max(y.abs()) + reach <= FOOTPRINT;
            // most candidates are above all ground around them
            let bound = if is_within { highest } else { grid.highest };
            if least + bound - low > TOLERANCE.max(missing) {
                missing = missing.max(least + grid.highest_near(at[0] + x, at[1] + y, reach) - low);
            }
        }
        missing
    }
}
