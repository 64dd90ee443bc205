//! Poses and velocities of robots' links, asked for between control steps.

use bevy_ecs::prelude::*;
use glam::DMat3;

use super::Sim;
use crate::components::{BasePose, BaseVelocity, Body, ContactForces, EnvId, EnvOrigin, Episode, JointState, Robot};
use crate::dynamics::lanes::{Kernel, SimdDispatch};
use crate::dynamics::math::{Mat3, Spatial, add, mul_mat, mul_vec, mul_vec_transposed, quat_to_mat};
use crate::dynamics::{Workspace, forward_kinematics, point_motion};
use crate::error::Error;
use crate::geometry_export::quaternion;
use crate::morphology::{Morphologies, MorphologyModel};
use crate::simulation::named_link;
use crate::workers::{MatrixRows, Workers};
use crate::world::Ground;

/// Poses and velocities of a robot's links, a row per env.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LinkRows {
    /// Origins of the URDF frames relative to the env's origin on the ground, m, `[envs, links,
    /// 3]`.
    pub position: Vec<f32>,
    /// Orientations of the URDF frames, w, x, y, z with `w >= 0`, `[envs, links, 4]`.
    pub quaternion: Vec<f32>,
    /// Velocities of the origins, world axes, m/s, `[envs, links, 3]`.
    pub linear_velocity: Vec<f32>,
    /// Angular velocities, world axes, rad/s, `[envs, links, 3]`.
    pub angular_velocity: Vec<f32>,
    /// Net contact forces of the last physics step on the bodies of each link, world axes, N,
    /// `[envs, links, 3]`.
    pub contact_force: Vec<f32>,
}

/// Components that the links of an env follow from.
type Columns<'w> = (&'w EnvId, &'w BasePose, &'w BaseVelocity, &'w JointState, &'w Body, &'w ContactForces);

impl Sim {
    /// Links of the robot at place `index`, of its bodies as they were randomised: those of these
    /// names, in this order, or all. A broken state gives zeros.
    ///
    /// # Errors
    /// A link that the robot does not have, or that is fixed to another one.
    pub fn links(&mut self, index: usize, names: Option<&[String]>) -> Result<LinkRows, Error> {
        let envs = self.env_ids(index);
        let Some(model) = self.morphologies().get(index) else {
            return Ok(LinkRows::default());
        };
        let wanted: Vec<usize> = match names {
            None => (0..model.topology.num_links()).collect(),
            Some(names) => {
                let found = names.iter().map(|name| named_link(&model.model, name, "links: names"));
                found.collect::<Result<_, _>>()?
            }
        };
        let world = self.world_mut();
        let mut origins = vec![(EnvOrigin::default(), false); envs.len()];
        for (env, origin, episode) in world.query::<(&EnvId, &EnvOrigin, &Episode)>().iter(world) {
            if envs.contains(&(env.0 as usize)) {
                origins[env.0 as usize - envs.start] = (*origin, episode.invalid);
            }
        }
        let mut query = world.query_filtered::<Columns<'static>, With<Robot>>();
        let mut robots: Vec<Columns<'_>> =
            query.iter(world).filter(|(env, ..)| envs.contains(&(env.0 as usize))).collect();
        robots.sort_unstable_by_key(|(env, ..)| **env);
        let (ground, workers) = (world.resource::<Ground>(), world.resource::<Workers>());
        let Some(model) = world.resource::<Morphologies>().0.get(index) else {
            return Ok(LinkRows::default());
        };
        let wanted = Wanted::new(model, &wanted);
        let links = wanted.links.len();
        let zeros = |width: usize| vec![0.0_f32; envs.len() * links * width];
        let mut rows = LinkRows {
            position: zeros(3),
            quaternion: zeros(4),
            linear_velocity: zeros(3),
            angular_velocity: zeros(3),
            contact_force: zeros(3),
        };
        let out = (
            MatrixRows { data: &mut rows.position, width: 3 * links },
            MatrixRows { data: &mut rows.quaternion, width: 4 * links },
            MatrixRows { data: &mut rows.linear_velocity, width: 3 * links },
            MatrixRows { data: &mut rows.angular_velocity, width: 3 * links },
            MatrixRows { data: &mut rows.contact_force, width: 3 * links },
        );
        workers.for_each_chunk(out, envs.len(), |first, count, out| {
            let (robots, origins) = (&robots[first..first + count], &origins[first..first + count]);
            let simd = workers.dispatch();
            simd.vectorize(LinksOfChunk { simd, model, ground, wanted: &wanted, robots, origins, out });
        });
        Ok(rows)
    }
}

/// Links that a caller asks for.
struct Wanted {
    /// Numbers of the links.
    links: Vec<usize>,
    /// Turns from their axes in the model to those of the URDF.
    align: Vec<Mat3<f32>>,
    /// Place among `links` of each contact body that is fixed to one of them, in the order of the
    /// bodies.
    bodies: Vec<(usize, usize)>,
}

impl Wanted {
    fn new(model: &MorphologyModel, links: &[usize]) -> Self {
        let align = |link: &usize| {
            let columns = model.align[*link].transpose().to_cols_array_2d();
            columns.map(|row| row.map(|x| x as f32))
        };
        let places = |(body, link): (usize, usize)| {
            let of_link = move |(place, wanted): (usize, &usize)| (*wanted == link).then_some((place, body));
            links.iter().enumerate().filter_map(of_link)
        };
        let bodies = model.model.bodies.iter().map(|body| body.link).enumerate();
        Self {
            links: links.to_vec(),
            align: links.iter().map(align).collect(),
            bodies: bodies.flat_map(places).collect(),
        }
    }
}

/// Envs in a row, and the rows of their links.
struct LinksOfChunk<'a> {
    simd: SimdDispatch,
    model: &'a MorphologyModel,
    ground: &'a Ground,
    wanted: &'a Wanted,
    robots: &'a [Columns<'a>],
    /// Origin of each env, and whether its state is broken.
    origins: &'a [(EnvOrigin, bool)],
    /// Positions, quaternions, linear and angular velocities, forces.
    out: (MatrixRows<'a, f32>, MatrixRows<'a, f32>, MatrixRows<'a, f32>, MatrixRows<'a, f32>, MatrixRows<'a, f32>),
}

impl Kernel<f32> for LinksOfChunk<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { simd, model, ground, wanted, robots, origins, out } = self;
        let (mut positions, mut quaternions, mut linear_velocities, mut angular_velocities, mut forces) = out;
        let topology = &model.topology;
        let mut work = Workspace::new(topology);
        let mut net = vec![[0.0; 3]; topology.num_bodies];
        for (i, ((_, pose, velocity, joints, body, touching), (origin, is_broken))) in
            robots.iter().zip(origins).enumerate()
        {
            if *is_broken {
                continue;
            }
            let rotation = quat_to_mat(&pose.rotation);
            let base = Spatial { ang: velocity.angular, lin: mul_vec_transposed(&rotation, &velocity.linear) };
            let (q, qd) = (&joints.position, &joints.velocity);
            forward_kinematics(simd, topology, &body.0, q, qd, &base, &mut work);
            let height = ground.height_at(origin, [0.0; 2]);
            let rows = (
                positions.row(i).as_chunks_mut::<3>().0,
                quaternions.row(i).as_chunks_mut::<4>().0,
                linear_velocities.row(i).as_chunks_mut::<3>().0,
                angular_velocities.row(i).as_chunks_mut::<3>().0,
            );
            for (place, (&link, align)) in wanted.links.iter().zip(&wanted.align).enumerate() {
                let link = &work.links[link];
                let [x, y, z] = add(&pose.position, &mul_vec(&rotation, &link.position));
                rows.0[place] = [x, y, z - height];
                let turned = mul_mat(&rotation, &mul_mat(&link.rotation, align));
                let columns = DMat3::from_cols_array_2d(&turned.map(|row| row.map(f64::from))).transpose();
                rows.1[place] = quaternion(&columns).map(|x| x as f32);
                let (_, linear) = point_motion(link, &[0.0; 3]);
                rows.2[place] = mul_vec(&rotation, &linear);
                rows.3[place] = mul_vec(&rotation, &link.velocity.ang);
            }
            touching.write_net(&model.feet, &mut net);
            let row = forces.row(i).as_chunks_mut::<3>().0;
            for &(place, body) in &wanted.bodies {
                row[place].iter_mut().zip(&net[body]).for_each(|(sum, x)| *sum += x);
            }
        }
    }
}
