//! Contact forces of all bodies; contact and air times of feet, counted in physics steps.

use smallvec::smallvec;

use super::{SensedRobot, Sensor};
use crate::components::{ContactForces, ContactSensor, FORCE_HISTORY, PerFoot};
use crate::config::TaskConfig;
use crate::morphology::MorphologyModel;

/// Normal force from which a body counts as in contact, N.
const FORCE_THRESHOLD: f32 = 1.0;

impl Sensor for ContactSensor {
    type Settings = ();

    fn settings(_: &TaskConfig) -> Option<()> {
        Some(())
    }

    fn new((): &(), morphology: &MorphologyModel) -> Self {
        Self { peak_force: smallvec![0.0; morphology.topology.num_bodies], ..Self::default() }
    }

    #[inline(always)]
    fn measure(&mut self, (): &(), robot: &SensedRobot) {
        self.read(robot.forces, &robot.morphology.feet, robot.dt);
    }

    fn begin(&mut self, (): &(), _: &SensedRobot) {
        let mut peak_force = std::mem::take(&mut self.peak_force);
        peak_force.fill(0.0);
        *self = Self { peak_force, ..Self::default() };
    }
}

impl ContactSensor {
    /// The forces of a control step; `feet` are the contact bodies that are feet.
    #[inline(always)]
    fn read(&mut self, forces: &ContactForces, feet: &PerFoot<usize>, dt: f32) {
        let larger = |x: f32, other: f32| if other > x { other } else { x };
        let mut peaks = PerFoot::default();
        let steps = &forces.feet_normal[..];
        for normal in &steps[steps.len().saturating_sub(FORCE_HISTORY)..] {
            for (peak, normal) in peaks.iter_mut().zip(normal) {
                *peak = larger(*peak, *normal);
            }
        }
        self.peak_force.fill(0.0);
        for (&body, peak) in feet.iter().zip(peaks) {
            self.peak_force[body] = peak;
        }
        for force in &forces.others {
            self.peak_force[force.body as usize] = force.normal.into_iter().fold(0.0, larger);
        }
        let Self { contact_time: contact, air_time: air, last_contact_time, last_air_time, .. } = self;
        for normal in steps {
            // by selection: which foot stands when is hard to foresee
            for foot in 0..normal.len() {
                let stands = normal[foot] > FORCE_THRESHOLD;
                let (longer_contact, longer_air) = (contact[foot] + dt, air[foot] + dt);
                last_air_time[foot] = if stands & (air[foot] > 0.0) { longer_air } else { last_air_time[foot] };
                last_contact_time[foot] =
                    if !stands & (contact[foot] > 0.0) { longer_contact } else { last_contact_time[foot] };
                contact[foot] = if stands { longer_contact } else { 0.0 };
                air[foot] = if stands { 0.0 } else { longer_air };
            }
        }
    }
}
