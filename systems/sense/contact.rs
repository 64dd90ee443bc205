//! Contact forces of all bodies; contact and air times of feet, counted in physics steps.

use smallvec::smallvec;

use super::{SensedRobot, Sensor};
use crate::components::{ContactForces, ContactSensor, FORCE_HISTORY};
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
        let times = || smallvec![0.0; morphology.feet.len()];
        Self {
            peak_force: smallvec![0.0; morphology.topology.num_bodies],
            contact_time: times(),
            air_time: times(),
            last_contact_time: times(),
            last_air_time: times(),
        }
    }

    #[inline(always)]
    fn measure(&mut self, (): &(), robot: &SensedRobot) {
        self.read(robot.forces, &robot.morphology.feet, robot.dt);
    }

    fn begin(&mut self, (): &(), _: &SensedRobot) {
        self.peak_force.fill(0.0);
        for times in [&mut self.contact_time, &mut self.air_time, &mut self.last_contact_time, &mut self.last_air_time]
        {
            times.fill(0.0);
        }
    }
}

impl ContactSensor {
    /// The forces of a control step; `feet` are the contact bodies that are feet.
    #[inline(always)]
    fn read(&mut self, forces: &ContactForces, feet: &[usize], dt: f32) {
        self.read_peaks(forces, feet);
        let Self { contact_time, air_time, last_contact_time, last_air_time, .. } = self;
        let times = [&mut contact_time[..], &mut air_time[..], &mut last_contact_time[..], &mut last_air_time[..]];
        count_times(times, &forces.feet_normal, dt);
    }

    /// The largest forces of a control step.
    #[inline(always)]
    pub(in crate::systems) fn read_peaks(&mut self, forces: &ContactForces, feet: &[usize]) {
        let larger = |x: f32, other: f32| if other > x { other } else { x };
        let steps = forces.feet_normal.chunks_exact(feet.len().max(1));
        self.peak_force.fill(0.0);
        for normal in steps.clone().skip(steps.len().saturating_sub(FORCE_HISTORY)) {
            for (&body, normal) in feet.iter().zip(normal) {
                self.peak_force[body] = larger(self.peak_force[body], *normal);
            }
        }
        for force in &forces.others {
            self.peak_force[force.body as usize] = force.normal.into_iter().fold(0.0, larger);
        }
    }
}

/// Advances contact, air, last contact and last air times of the feet by physics steps of `dt`,
/// with these normal forces, `[steps, feet]`. Four feet, as most robots have, are counted side by
/// side.
#[inline(always)]
fn count_times(times: [&mut [f32]; 4], normal: &[f32], dt: f32) {
    let [contact, air, last_contact, last_air] = times;
    let feet = contact.len();
    if let (Ok(contact), Ok(air), Ok(last_contact), Ok(last_air)) = (
        <&mut [f32; 4]>::try_from(&mut *contact),
        <&mut [f32; 4]>::try_from(&mut *air),
        <&mut [f32; 4]>::try_from(&mut *last_contact),
        <&mut [f32; 4]>::try_from(&mut *last_air),
    ) {
        let mut own = [*contact, *air, *last_contact, *last_air];
        for normal in normal.as_chunks::<4>().0 {
            let [contact, air, last_contact, last_air] = &mut own;
            for foot in 0..4 {
                count(
                    [&mut contact[foot], &mut air[foot], &mut last_contact[foot], &mut last_air[foot]],
                    normal[foot],
                    dt,
                );
            }
        }
        [*contact, *air, *last_contact, *last_air] = own;
        return;
    }
    for normal in normal.chunks_exact(feet.max(1)) {
        for foot in 0..feet {
            count([&mut contact[foot], &mut air[foot], &mut last_contact[foot], &mut last_air[foot]], normal[foot], dt);
        }
    }
}

/// Counts a physics step of one foot by selection, without branches: contacts are hard to predict.
#[inline(always)]
fn count([contact, air, last_contact, last_air]: [&mut f32; 4], normal: f32, dt: f32) {
    let stands = normal > FORCE_THRESHOLD;
    let (longer_contact, longer_air) = (*contact + dt, *air + dt);
    *last_air = if stands & (*air > 0.0) { longer_air } else { *last_air };
    *last_contact = if !stands & (*contact > 0.0) { longer_contact } else { *last_contact };
    *contact = if stands { longer_contact } else { 0.0 };
    *air = if stands { 0.0 } else { longer_air };
}
