//! Numbers of the robots that may differ from env to env.

use glam::{DMat3, DVec3};

use super::Simulation;
use super::options::{check_non_negative, check_not_below_zero};
use super::rows::{EnvIds, Rows};
use crate::bounds::LARGEST;
use crate::config::{ConfigError, ConfigErrorKind, did_you_mean};
use crate::dynamics::{Parameters, SharedArray};
use crate::error::Error;
use crate::robot::{Model, symmetric};

/// A link, by name or index.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LinkId<'a> {
    /// Name of the link in the URDF.
    Name(&'a str),
    /// Place of the link in [`Simulation::link_names`].
    Index(usize),
}

impl<'a> From<&'a str> for LinkId<'a> {
    fn from(name: &'a str) -> Self {
        Self::Name(name)
    }
}

impl From<usize> for LinkId<'_> {
    fn from(index: usize) -> Self {
        Self::Index(index)
    }
}

/// Index of the link called `name`; `element` is the argument that names it.
///
/// # Errors
/// A link that does not exist, or is fixed to another.
pub(crate) fn named_link(model: &Model, name: &str, element: &'static str) -> Result<usize, Error> {
    let links = &model.links;
    if let Some(index) = links.iter().position(|link| link.name == name) {
        return Ok(index);
    }
    let file = model.source.display().to_string();
    let (problem, remedy) = match links.iter().find(|link| link.merged.iter().any(|merged| merged == name)) {
        Some(carrier) => (format!("`{name}` is fixed to `{0}`", carrier.name), format!("name `{}`", carrier.name)),
        None => {
            let known = links.iter().map(|link| link.name.as_str());
            (format!("there is no link `{name}`"), did_you_mean(name, known, "links"))
        }
    };
    Err(ConfigError::invalid(file, element, problem, remedy).of_kind(ConfigErrorKind::UnknownName).into())
}

/// A list of numbers of joints.
type JointList = fn(&mut Parameters<f64>) -> &mut SharedArray<f64>;

impl Simulation {
    /// Index of a link.
    ///
    /// # Errors
    /// A link that does not exist, or is fixed to another and has no mass.
    pub fn link_index<'a>(&self, link: impl Into<LinkId<'a>>) -> Result<usize, Error> {
        let links = &self.robot.model.links;
        let name = match link.into() {
            LinkId::Index(index) if index < links.len() => return Ok(index),
            LinkId::Index(index) => {
                let remedy = format!("the links are 0 to {}", links.len() - 1);
                return Err(Error::argument("link", format!("there is no link {index}"), remedy));
            }
            LinkId::Name(name) => name,
        };
        named_link(&self.robot.model, name, "link")
    }

    /// `change(row, numbers)` of the robots in some envs. It rounds what it sets.
    fn edit(&mut self, envs: &EnvIds, mut change: impl FnMut(usize, &mut Parameters<f64>)) {
        for row in 0..envs.len() {
            let env = envs.get(row);
            change(row, &mut self.bodies[env]);
            self.engine.upload(env, &self.bodies[env]);
        }
    }

    /// Sets a number of every joint in some envs. Numbers that a caller repeats with every step
    /// cost no upload.
    fn edit_joints(&mut self, envs: &EnvIds, list: JointList, rows: &Rows) {
        let round = self.rounding();
        for row in 0..envs.len() {
            let env = envs.get(row);
            let body = &mut self.bodies[env];
            let mut changes = false;
            for joint in 0..list(body).len() {
                let new = round(rows.get(row, joint));
                if list(body)[joint] != new {
                    list(body)[joint] = new;
                    changes = true;
                }
            }
            if changes {
                self.engine.upload(env, body);
            }
        }
    }

    /// Sets a link's mass, kg: one number or one per env. Its inertia about the centre of mass is
    /// scaled along, as if the density had changed; set the inertia afterwards if it did not.
    ///
    /// # Errors
    /// A mass that is not positive, another number of values, no such link or env.
    pub fn set_mass<'a>(
        &mut self,
        env_ids: Option<&[usize]>,
        link: impl Into<LinkId<'a>>,
        mass: &[f64],
    ) -> Result<(), Error> {
        let (link, envs) = (self.link_index(link)?, EnvIds::new(env_ids, self.num_envs())?);
        let rows = Rows::vectors("mass", mass, 1, envs.len())?;
        if let Some(bad) = mass.iter().find(|m| **m <= 0.0) {
            return Err(Error::argument("mass", format!("{bad} kg"), "pass positive masses"));
        }
        let round = self.rounding();
        self.edit(&envs, |row, p| {
            let mass = rows.get(row, 0);
            let scale = mass / p.mass[link];
            p.inertia[link] = p.inertia[link].map(|x| round(x * scale));
            p.mass[link] = round(mass);
        });
        Ok(())
    }

    /// Sets a link's centre of mass in its URDF frame, m: `[3]` or `[n, 3]`.
    ///
    /// # Errors
    /// Another number of values, one that is not finite, no such link or env.
    pub fn set_com<'a>(
        &mut self,
        env_ids: Option<&[usize]>,
        link: impl Into<LinkId<'a>>,
        com: &[f64],
    ) -> Result<(), Error> {
        let (link, envs) = (self.link_index(link)?, EnvIds::new(env_ids, self.num_envs())?);
        let rows = Rows::vectors("com", com, 3, envs.len())?;
        let (align, round) = (self.robot.align[link], self.rounding());
        self.edit(&envs, |row, p| p.com[link] = (align * DVec3::from_array(rows.vector(row))).to_array().map(round));
        Ok(())
    }

    /// Sets a link's inertia about its centre of mass in the axes of its URDF frame, kg m^2: xx,
    /// yy, zz, xy, xz, yz, once or per env.
    ///
    /// # Errors
    /// An inertia that no body can have, another number of values, no such link or env.
    pub fn set_inertia<'a>(
        &mut self,
        env_ids: Option<&[usize]>,
        link: impl Into<LinkId<'a>>,
        inertia: &[f64],
    ) -> Result<(), Error> {
        let (link, envs) = (self.link_index(link)?, EnvIds::new(env_ids, self.num_envs())?);
        let rows = Rows::vectors("inertia", inertia, 6, envs.len())?;
        for row in 0..envs.len() {
            let given = std::array::from_fn(|k| rows.get(row, k));
            if !is_physical(given) {
                return Err(Error::argument(
                    "inertia",
                    format!("row {row}, {given:?} (xx, yy, zz, xy, xz, yz), is the inertia of no rigid body"),
                    "pass a positive definite matrix whose principal moments obey the triangle inequality",
                ));
            }
        }
        let (align, round) = (self.robot.align[link], self.rounding());
        self.edit(&envs, |row, p| {
            let given = matrix(std::array::from_fn(|k| rows.get(row, k)));
            p.inertia[link] = symmetric(align * given * align.transpose()).map(round);
        });
        Ok(())
    }

    /// Sets the friction coefficients between robot and ground, already combined: one number or one
    /// per env. The dynamic one is the static one unless given. Torsional and rolling friction
    /// stay.
    ///
    /// # Errors
    /// A negative coefficient, another number of values, no such env.
    pub fn set_friction(
        &mut self,
        env_ids: Option<&[usize]>,
        static_friction: &[f64],
        dynamic_friction: Option<&[f64]>,
    ) -> Result<(), Error> {
        let envs = EnvIds::new(env_ids, self.num_envs())?;
        let dynamic_friction = dynamic_friction.unwrap_or(static_friction);
        check_non_negative("static friction", static_friction)?;
        check_non_negative("dynamic friction", dynamic_friction)?;
        let sticking = Rows::vectors("static friction", static_friction, 1, envs.len())?;
        let sliding = Rows::vectors("dynamic friction", dynamic_friction, 1, envs.len())?;
        let round = self.rounding();
        self.edit(&envs, |row, p| {
            p.static_friction = round(sticking.get(row, 0));
            p.dynamic_friction = round(sliding.get(row, 0));
        });
        Ok(())
    }

    /// Sets stiffness (N m/rad), damping (N m s/rad) or both: one number, `[joints]` or `[n,
    /// joints]`.
    ///
    /// # Errors
    /// A negative gain, another number of values, no such env.
    pub fn set_gains(
        &mut self,
        env_ids: Option<&[usize]>,
        kp: Option<&[f64]>,
        kd: Option<&[f64]>,
    ) -> Result<(), Error> {
        let envs = EnvIds::new(env_ids, self.num_envs())?;
        let joints = self.num_joints();
        let rows = |element, values: Option<_>| match values {
            Some(values) => {
                check_non_negative(element, values)?;
                Rows::of_joints(element, values, joints, envs.len()).map(Some)
            }
            None => Ok(None),
        };
        let (kp, kd) = (rows("kp", kp)?, rows("kd", kd)?);
        if !self.robot.networks.is_empty() && (kp.is_some() || kd.is_some()) {
            let element = if kp.is_some() { "kp" } else { "kd" };
            let problem = "this robot's actuators are networks, which have no gains";
            return Err(Error::argument(element, problem, "leave the gains out, or pass torques"));
        }
        if let Some(rows) = kp {
            self.edit_joints(&envs, |p| &mut p.stiffness, &rows);
        }
        if let Some(rows) = kd {
            self.edit_joints(&envs, |p| &mut p.damping, &rows);
        }
        Ok(())
    }

    /// Sets the largest effort of the actuators, N m or N: one number, `[joints]` or `[n, joints]`;
    /// infinity for none. A limit that depends on the position is scaled so that this is its
    /// largest value.
    ///
    /// # Errors
    /// A negative limit, another number of values, no such env.
    pub fn set_effort_limit(&mut self, env_ids: Option<&[usize]>, limit: &[f64]) -> Result<(), Error> {
        let envs = EnvIds::new(env_ids, self.num_envs())?;
        let joints = self.num_joints();
        check_not_below_zero("effort_limit", limit)?;
        let rows = Rows::of_limits("effort_limit", limit, joints, envs.len())?;
        let has_table = |j: usize| self.robot.topology.joints[j].effort_table.is_some();
        let scaled: Vec<f64> = (0..envs.len())
            .flat_map(|row| (0..joints).map(move |j| (row, j)))
            .map(|(row, j)| match rows.get(row, j) {
                // an infinite factor would meet zeros of the table
                limit if has_table(j) => limit.min(LARGEST) / self.effort_scale[j],
                limit if limit > LARGEST => f64::INFINITY,
                limit => limit,
            })
            .collect();
        self.edit_joints(&envs, |p| &mut p.effort_limit, &Rows::per_env(&scaled, joints));
        Ok(())
    }

    /// Sets the reflected rotor inertia of the joints, kg m^2 or kg: one number, `[joints]` or `[n,
    /// joints]`.
    ///
    /// # Errors
    /// A negative value, another number of values, no such env.
    pub fn set_armature(&mut self, env_ids: Option<&[usize]>, armature: &[f64]) -> Result<(), Error> {
        let envs = EnvIds::new(env_ids, self.num_envs())?;
        check_non_negative("armature", armature)?;
        let rows = Rows::of_joints("armature", armature, self.num_joints(), envs.len())?;
        self.edit_joints(&envs, |p| &mut p.armature, &rows);
        Ok(())
    }
}

/// Symmetric matrix of xx, yy, zz, xy, xz, yz.
fn matrix([xx, yy, zz, xy, xz, yz]: [f64; 6]) -> DMat3 {
    DMat3::from_cols(DVec3::new(xx, xy, xz), DVec3::new(xy, yy, yz), DVec3::new(xz, yz, zz))
}

/// Whether a mass distribution can have this inertia: `I` and `tr(I) / 2 - I` are positive
/// definite, the latter but for rounding, because that of a flat body is singular.
fn is_physical(inertia: [f64; 6]) -> bool {
    let inertia = matrix(inertia);
    let trace = inertia.x_axis.x + inertia.y_axis.y + inertia.z_axis.z;
    let positive = |m: DMat3| {
        let minor = m.x_axis.x * m.y_axis.y - m.x_axis.y * m.x_axis.y;
        m.x_axis.x > 0.0 && minor > 0.0 && m.determinant() > 0.0
    };
    positive(inertia) && positive(DMat3::from_diagonal(DVec3::splat(trace * (0.5 + 1e-6))) - inertia)
}
