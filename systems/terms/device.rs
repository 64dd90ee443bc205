//! Tables of a task for a device, where all that the task uses has a form there.

use avian3d::prelude::CoefficientCombine;

use super::super::view::RobotView;
use super::compile::{CompiledTask, ILLEGAL_STATE, ObservationTerm};
use super::registry::Registry;
use super::spec::TermKind;
use crate::bounds::MAX_ACTION;
use crate::config::{EventMode, HeightScannerConfig, JointPositionMode};
use crate::engine::device::{
    AutoresetForm, CombineForm, CommandForm, Delay, Form, FormKind, ObservationForm, RewardForm, Slot, TaskForm,
    TaskTables, Tiles,
};
use crate::morphology::MorphologyModel;
use crate::options::Autoreset;
use crate::world::Ground;

impl CompiledTask {
    /// The tables of the task for a robot, the one at place `index`.
    ///
    /// # Errors
    /// The first thing that has no form on the device.
    pub(in crate::systems) fn on_device(
        &self,
        registry: &Registry,
        (index, robot): (usize, &MorphologyModel),
        ground: &Ground,
        autoreset: Autoreset,
        num_actions: usize,
    ) -> Result<TaskTables, String> {
        self.check_device()?;
        let config = &self.config;
        let find = |kind: FormKind, what: &str, name: &str, params: &toml::Table| {
            registry.form(kind, name, params, robot).ok_or_else(|| format!("the {what} `{name}`"))
        };
        let rewards = self.reward_forms(registry, (index, robot))?;
        let mut ends = Vec::new();
        let named = config.terminations.iter().filter(|(name, _)| *name != ILLEGAL_STATE);
        for ((name, params), term) in named.zip(&self.terminations) {
            ends.push((term.time_out, find(FormKind::End, "termination", name, params)?));
        }
        let mut observations = Vec::new();
        let (mut column, mut kept) = (0, 0);
        let named = config.observations.groups().flat_map(|(_, terms)| terms);
        for (named, term) in named.zip(&self.observations) {
            if term.is_external || (term.error > 0.0 && term.noise > 0.0) {
                return Err(format!("the observation `{}`", term.name));
            }
            let form = if self.is_kept(registry, term) {
                let at = kept as i32;
                kept += self.own_numbers(term, robot);
                let sort = if term.spec.kind == TermKind::PerJoint { "kept_of_joints" } else { "kept" };
                Form::new(FormKind::Observation, sort, Vec::new(), Some(vec![at])).ok_or("numbers of a body")?
            } else {
                let what = match registry.is_of_body(&named.term) {
                    true => "at resets that change bodies, the observation",
                    false => "the observation",
                };
                let form = registry.form(FormKind::Observation, &named.term, &named.params, robot);
                form.ok_or_else(|| format!("{what} `{}`", named.term))?
            };
            observations.push(ObservationForm {
                form,
                column,
                size: term.size / term.history,
                memory: term.history,
                noise: term.noise,
                clip: term.clip,
                scale: term.scale,
                error: term.error,
            });
            column += term.size;
        }
        let EventForms { intervals, resets, bodies } = self.event_forms(registry, robot)?;
        let mut curricula = Vec::new();
        for (name, curriculum) in config.curriculum.iter().filter(|(_, curriculum)| curriculum.enabled) {
            let term = curriculum.term.as_ref().unwrap_or(name);
            let form = find(FormKind::Curriculum, "curriculum", term, &curriculum.params)?;
            let full = self.max_episode_length as f32 * self.step_dt;
            curricula.push(match self.schedules.tracking_term(term, &self.rewards[index]) {
                Some(at) => form.after(&[full], &[at as i32]),
                None => form,
            });
        }
        let mut other_commands = Vec::new();
        for command in &self.command_terms {
            let named = config.commands.others.get(&command.name).ok_or("a command that is unknown")?;
            other_commands.push(CommandForm {
                form: find(FormKind::Command, "command", &command.name, &named.params)?,
                numbers: command.range.clone(),
                resampling: command.resampling_time_s,
            });
        }
        let ranges = &self.velocity_ranges[index];
        let (ground_friction, combine) = ground.own_friction();
        let (commands, reset) = (&self.commands[index], &robot.config.reset);
        let single = |range: [f64; 2]| range.map(|x| x as f32);
        let [forward, left, yaw] = ranges.base();
        Ok(TaskTables::new(&TaskForm {
            slots: (robot.slots.iter())
                .map(|slot| Slot { joint: slot.joint(), column: slot.column(), sign: slot.sign })
                .collect(),
            widths: [num_actions, column],
            joints: robot.topology.num_joints(),
            feet: robot.feet.clone(),
            foot_columns: robot.foot_columns.clone(),
            kept,
            groups: robot.body_groups.iter().map(|group| *group as i32).collect(),
            autoreset: match autoreset {
                Autoreset::SameStep => AutoresetForm::SameStep,
                Autoreset::NextStep => AutoresetForm::NextStep,
                Autoreset::Disabled => AutoresetForm::Never,
            },
            longest: self.max_episode_length,
            commands: [self.has_velocity_command(), commands.heading_command],
            command_ranges: [forward, left, yaw, single(commands.heading)],
            stiffness: commands.heading_control_stiffness as f32,
            shares: [
                commands.rel_heading_envs,
                commands.rel_standing_envs,
                commands.rel_turning_envs,
                commands.rel_sideways_envs,
            ]
            .map(|share| share as f32),
            resampling: commands.resampling_time_s as f32,
            lengths: [config.sim.dt as f32, self.step_dt],
            height: ground.height as f32,
            gravity: (ground.down, ground.free_fall()),
            limits: self.limits.of_quantities().map(|(_, limit)| limit),
            margin: reset.spawn_margin as f32,
            max_action: MAX_ACTION,
            soft: reset.soft_limit_factor as f32,
            reset_ranges: [reset.base_velocity.range, reset.joint_position.range, reset.joint_velocity.range]
                .map(single),
            scales: reset.joint_position.mode == JointPositionMode::Scale,
            delays: (robot.delays.iter())
                .map(|(range, joints)| Delay { range: *range, joints: joints.clone() })
                .collect(),
            intervals,
            resets,
            ends,
            rewards,
            observations,
            curricula,
            failures: self.failures(),
            tiles: ground
                .layout
                .as_ref()
                .map(|tiles| Tiles { num: [tiles.num_rows, tiles.num_cols], size: tiles.size }),
            rays: config.sensors.height_scanner.as_ref().map(HeightScannerConfig::rays).unwrap_or_default(),
            stages: ranges.stages().to_vec(),
            widest: ranges.widest(),
            body_events: bodies,
            other_commands,
            ground_friction,
            combine: match combine {
                CoefficientCombine::Average => CombineForm::Average,
                CoefficientCombine::GeometricMean => CombineForm::GeometricMean,
                CoefficientCombine::Min => CombineForm::Min,
                CoefficientCombine::Multiply => CombineForm::Multiply,
                CoefficientCombine::Max => CombineForm::Max,
            },
        }))
    }

    /// Numbers of an observation in one control step that are a robot's own.
    fn own_numbers(&self, term: &ObservationTerm, robot: &MorphologyModel) -> usize {
        let size = term.size / term.history;
        if term.spec.kind == TermKind::PerJoint { size / self.num_joints * robot.slots.len() } else { size }
    }

    /// Whether the device keeps the numbers of an observation, which change with the body alone.
    fn is_kept(&self, registry: &Registry, term: &ObservationTerm) -> bool {
        registry.is_of_body(&term.name) && term.write.is_some() && self.reset_body_events.is_empty()
    }

    /// Writes the numbers of a robot's body that observations show, as the device keeps them.
    pub(in crate::systems) fn write_kept(&self, registry: &Registry, view: &RobotView, out: &mut Vec<f32>) {
        for term in self.observations.iter().filter(|term| self.is_kept(registry, term)) {
            if let Some(write) = &term.write {
                let first = out.len();
                out.resize(first + self.own_numbers(term, view.morphology), 0.0);
                write(view, &mut out[first..]);
            }
        }
    }

    /// Checks the task apart from its terms.
    ///
    /// # Errors
    /// The first thing that has no form on the device.
    fn check_device(&self) -> Result<(), String> {
        let sensors = &self.config.sensors;
        let lacks = [
            (self.config.physics.mirror_links, "physics.mirror_links"),
            (sensors.ray_caster_camera.is_some(), "sensors.ray_caster_camera"),
        ];
        lacks.into_iter().find(|(lacks, _)| *lacks).map_or(Ok(()), |(_, what)| Err(what.to_owned()))
    }

    fn reward_forms(
        &self,
        registry: &Registry,
        (index, robot): (usize, &MorphologyModel),
    ) -> Result<Vec<RewardForm>, String> {
        let set = self.config.reward_set(robot.name(), &robot.config.reward_set).map_err(|error| error.to_string())?;
        let mut rewards = Vec::new();
        for term in &self.rewards[index] {
            let form = set.get(&term.name).and_then(|of| {
                registry.form(FormKind::Reward, of.term.as_ref().unwrap_or(&term.name), &of.params, robot)
            });
            let form = form.ok_or_else(|| format!("the reward `{}`", term.name))?;
            rewards.push(RewardForm { form, weight: term.weight, later: term.later.clone() });
        }
        Ok(rewards)
    }

    fn event_forms(&self, registry: &Registry, robot: &MorphologyModel) -> Result<EventForms, String> {
        let (mut intervals, mut resets, mut bodies) = (Vec::new(), Vec::new(), Vec::new());
        for (name, event) in self.config.events.iter().filter(|(_, event)| event.enabled) {
            let of_kind = |kind| {
                let form = registry.form(kind, name, &event.params, robot);
                form.ok_or_else(|| format!("the event `{name}`"))
            };
            match event.mode {
                EventMode::Startup => {}
                EventMode::Interval => {
                    let place = registry.interval.get(name.as_str()).map(|(place, _)| *place);
                    let time = event.interval_range_s.unwrap_or_default().map(|x| x as f32);
                    intervals.push((place, (time, of_kind(FormKind::Interval)?)));
                }
                EventMode::Reset => match registry.body.get(name.as_str()) {
                    Some((place, _)) => bodies.push((*place, of_kind(FormKind::BodyEvent)?)),
                    None => {
                        let place = registry.reset.get(name.as_str()).map(|(place, _)| *place);
                        resets.push((place, of_kind(FormKind::Reset)?));
                    }
                },
            }
        }
        intervals.sort_by_key(|(place, _)| *place);
        resets.sort_by_key(|(place, _)| *place);
        bodies.sort_by_key(|(place, _)| *place);
        Ok(EventForms {
            intervals: intervals.into_iter().map(|of| of.1).collect(),
            resets: resets.into_iter().map(|of| of.1).collect(),
            bodies: bodies.into_iter().map(|of| of.1).collect(),
        })
    }
}

/// Events of a task, each sort in the order in which they happen.
struct EventForms {
    /// Events that happen again and again, each with the range of its time, s.
    intervals: Vec<([f32; 2], Form)>,
    /// Events of a new state.
    resets: Vec<Form>,
    /// Events of a new body.
    bodies: Vec<Form>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_text_of_the_device_has_the_terms_that_say_so_and_no_others() {
        let registry = Registry::builtin();
        for kind in FormKind::ALL {
            let names: Vec<&str> = registry.with_forms().filter(|(of, _)| *of == kind).map(|(_, name)| name).collect();
            for name in &names {
                assert!(Form::new(kind, name, Vec::new(), None).is_some(), "{kind:?} {name}");
            }
            // numbers of bodies have two forms that no term has to itself
            let common = if kind == FormKind::Observation { 2 } else { 0 };
            assert_eq!(names.len() + common, kind.count(), "{kind:?}");
        }
    }
}
