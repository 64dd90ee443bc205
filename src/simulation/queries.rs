//! Poses, velocities and the terms of the equations of motion.
//!
//! All are computed in double precision from the present state, whatever the precision of the
//! simulation.

use glam::{DMat3, DQuat, DVec3};

use super::Simulation;
use super::envs::EnvRows;
use super::parameters::LinkId;
use super::rows::Rows;
use crate::dynamics::math::{Spatial, mul_vec, mul_vec_transposed, quat_to_mat};
use crate::dynamics::{Dynamics, Scalar, State, Workspace, point_motion};
use crate::error::Error;
use crate::workers::MatrixRows;

/// Poses of links in the world.
#[derive(Clone, Debug, PartialEq)]
pub struct LinkPoses {
    /// Origins, m, `[num_envs, links, 3]`.
    pub position: Vec<f64>,
    /// Orientations of the URDF frames (w, x, y, z), `w >= 0`, `[num_envs, links, 4]`.
    pub quaternion: Vec<f64>,
}

/// Velocities of links, in world axes.
#[derive(Clone, Debug, PartialEq)]
pub struct LinkVelocities {
    /// Velocities of the origins, m/s, `[num_envs, links, 3]`.
    pub linear: Vec<f64>,
    /// Angular velocities, rad/s, `[num_envs, links, 3]`.
    pub angular: Vec<f64>,
}

type Bodies<'a> = Dynamics<'a, f64>;

impl Simulation {
    /// `f(dynamics of an env, env, its row)` for every env; the rows, `[num_envs, width]`.
    fn query(&self, width: usize, f: impl Fn(&mut Bodies, usize, &mut [f64]) + Sync) -> Vec<f64> {
        let mut out = vec![0.0; self.num_envs() * width];
        let topology = &self.robot.topology;
        let rows = MatrixRows { data: &mut out, width };
        self.workers.for_each_chunk(rows, self.num_envs(), |first, count, mut rows| {
            let (mut state, mut row) = (State::zeros(topology), self.robot.env());
            let mut work = Workspace::new(topology);
            for i in 0..count {
                let env = first + i;
                self.engine.fetch(env, EnvRows::of(&mut row));
                row.read(&mut state, 0);
                // single precision leaves a quaternion a little off
                let length = state.rotation.iter().map(|x| x * x).sum::<f64>().sqrt();
                state.rotation = state.rotation.map(|x| x / length);
                let mut dynamics = Dynamics {
                    topology,
                    parameters: &self.bodies[env],
                    state: &state,
                    gravity: self.settings.gravity,
                    work: &mut work,
                };
                f(&mut dynamics, env, rows.row(i));
            }
        });
        out
    }

    /// Computes the poses of the links.
    pub fn link_pose(&self) -> LinkPoses {
        let links = self.num_links();
        let rows = self.query(7 * links, |body, _, out| {
            let rotation = link_states(body);
            let base = matrix(&rotation);
            let (positions, quaternions) = out.split_at_mut(3 * links);
            for (l, link) in body.work.links.iter().enumerate() {
                let position = DVec3::from_array(body.state.position) + base * DVec3::from_array(link.position);
                let mut q = DQuat::from_mat3(&(base * matrix(&link.rotation) * self.robot.align[l])).normalize();
                if q.w < 0.0 {
                    q = -q;
                }
                positions[3 * l..3 * l + 3].copy_from_slice(&position.to_array());
                quaternions[4 * l..4 * l + 4].copy_from_slice(&[q.w, q.x, q.y, q.z]);
            }
        });
        let (position, quaternion) = split_columns(&rows, 7 * links, 3 * links);
        LinkPoses { position, quaternion }
    }

    /// Computes the velocities of the links.
    pub fn link_velocity(&self) -> LinkVelocities {
        let links = self.num_links();
        let rows = self.query(6 * links, |body, _, out| {
            let rotation = link_states(body);
            let (linear, angular) = out.split_at_mut(3 * links);
            for (l, link) in body.work.links.iter().enumerate() {
                let (_, velocity) = point_motion(link, &[0.0; 3]);
                linear[3 * l..3 * l + 3].copy_from_slice(&mul_vec(&rotation, &velocity));
                angular[3 * l..3 * l + 3].copy_from_slice(&mul_vec(&rotation, &link.velocity.ang));
            }
        });
        let (linear, angular) = split_columns(&rows, 6 * links, 3 * links);
        LinkVelocities { linear, angular }
    }

    /// Mass matrix, armature included, `[num_envs, nv, nv]`.
    pub fn mass_matrix(&self) -> Vec<f64> {
        self.query(self.nv() * self.nv(), |body, _, out| out.copy_from_slice(&f64::mass_matrix(body)))
    }

    /// Bias force `c` of `M qacc + c = force`, gravity included, `[num_envs, nv]`.
    pub fn bias_force(&self) -> Vec<f64> {
        self.query(self.nv(), |body, _, out| out.copy_from_slice(&f64::bias_force(body)))
    }

    /// Accelerations, `[num_envs, nv]`, that generalised forces cause: one per joint or degree of
    /// freedom, for all envs or each. Without contacts, joint limits, damping and friction.
    ///
    /// # Errors
    /// Another number of values, or one that is not finite.
    pub fn forward_dynamics(&self, force: &[f64]) -> Result<Vec<f64>, Error> {
        let (nv, joints) = (self.nv(), self.num_joints());
        let of_joints = force.len() == joints || (force.len() == joints * self.num_envs() && force.len() != nv);
        let width = if of_joints { joints } else { nv };
        let rows = Rows::vectors("force", force, width, self.num_envs())?;
        Ok(self.query(nv, |body, env, out| {
            let force: Vec<f64> =
                (0..nv).map(|k| (k + width).checked_sub(nv).map_or(0.0, |k| rows.get(env, k))).collect();
            out.copy_from_slice(&f64::forward_dynamics(body, &force));
        }))
    }

    /// Generalised forces, `[num_envs, nv]`, that cause the accelerations `qacc`, `[nv]` or
    /// `[num_envs, nv]`.
    ///
    /// # Errors
    /// Another number of values, or one that is not finite.
    pub fn inverse_dynamics(&self, qacc: &[f64]) -> Result<Vec<f64>, Error> {
        let nv = self.nv();
        let rows = Rows::vectors("qacc", qacc, nv, self.num_envs())?;
        Ok(self.query(nv, |body, env, out| {
            let qacc: Vec<f64> = (0..nv).map(|k| rows.get(env, k)).collect();
            out.copy_from_slice(&f64::inverse_dynamics(body, &qacc));
        }))
    }

    /// Jacobian of a point of a link, given in its URDF frame, m, `[num_envs, 6, nv]`: linear
    /// velocity of the point, then angular velocity of the link, world axes.
    ///
    /// # Errors
    /// No such link, or a point that is not finite.
    pub fn jacobian<'a>(&self, link: impl Into<LinkId<'a>>, point: [f64; 3]) -> Result<Vec<f64>, Error> {
        let link = self.link_index(link)?;
        Rows::vectors("point", &point, 3, 1)?;
        let point = (self.robot.align[link] * DVec3::from_array(point)).to_array();
        Ok(self.query(6 * self.nv(), |body, _, out| out.copy_from_slice(&f64::jacobian(body, link, &point))))
    }

    /// Distance of each link's shapes from the ground, m, negative inside it, `[num_envs, links]`;
    /// infinite for a link without shapes and without ground.
    pub fn ground_gap(&self) -> Vec<f64> {
        let topology = &self.robot.topology;
        self.query(self.num_links(), |body, _, out| {
            out.fill(f64::INFINITY);
            let gaps = f64::candidate_gaps(topology, body.parameters, &self.settings.contact, body.state, body.work);
            for (contact, gap) in topology.contacts.iter().zip(gaps) {
                out[contact.link] = out[contact.link].min(gap);
            }
        })
    }

    /// Kinetic energy, armature included, and potential energy in gravity, zero at the world's
    /// origin, J, `[num_envs]` each.
    pub fn energy(&self) -> (Vec<f64>, Vec<f64>) {
        let rows = self.query(2, |body, _, out| (out[0], out[1]) = f64::energy(body));
        split_columns(&rows, 2, 1)
    }

    /// Centre of mass in the world, m, `[num_envs, 3]`.
    pub fn center_of_mass(&self) -> Vec<f64> {
        self.query(3, |body, _, out| out.copy_from_slice(&f64::center_of_mass(body)))
    }

    /// Linear momentum, kg m/s, and angular momentum about the centre of mass, kg m^2/s, world
    /// axes, `[num_envs, 3]` each; without rotors.
    pub fn momentum(&self) -> (Vec<f64>, Vec<f64>) {
        let rows = self.query(6, |body, _, out| {
            let (linear, angular) = f64::momentum(body);
            out[..3].copy_from_slice(&linear);
            out[3..].copy_from_slice(&angular);
        });
        split_columns(&rows, 6, 3)
    }
}

/// Leaves poses and velocities of the links in the workspace, in base axes; the base's rotation.
fn link_states(body: &mut Bodies) -> [[f64; 3]; 3] {
    let state = body.state;
    let rotation = quat_to_mat(&state.rotation);
    let base = if body.topology.floating {
        Spatial { ang: state.angular_velocity, lin: mul_vec_transposed(&rotation, &state.linear_velocity) }
    } else {
        Spatial::zero()
    };
    let (position, velocity) = (&state.joint_position, &state.joint_velocity);
    f64::forward_kinematics(body.topology, body.parameters, position, velocity, &base, body.work);
    rotation
}

/// Matrix with these rows.
fn matrix(rows: &[[f64; 3]; 3]) -> DMat3 {
    DMat3::from_cols_array_2d(rows).transpose()
}

/// The first `at` columns, and the rest.
fn split_columns(rows: &[f64], width: usize, at: usize) -> (Vec<f64>, Vec<f64>) {
    let (mut left, mut right) = (Vec::new(), Vec::new());
    for row in rows.chunks_exact(width) {
        left.extend(&row[..at]);
        right.extend(&row[at..]);
    }
    (left, right)
}
