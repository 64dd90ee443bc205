//! Heights of the feet above the ground.

use bevy_ecs::prelude::*;

use crate::components::{Env, EnvOrigin, Feet, Robot};
use crate::dynamics::lanes::Kernel;
use crate::rows::Rows;
use crate::workers::Workers;
use crate::world::Ground;

/// Measures the feet of all robots.
pub(super) fn measure_feet(
    workers: Res<Workers>,
    ground: Res<Ground>,
    mut robots: Rows<&'static mut Feet, Robot>,
    envs: Rows<&'static EnvOrigin, Env>,
) -> Result {
    let (feet, origins) = (robots.write()?, envs.read()?);
    let ground = &ground;
    workers.vectorize_chunks((feet, origins), origins.len(), |_, _, (feet, origins)| FeetRows {
        ground,
        feet,
        origins,
    });
    Ok(())
}

struct FeetRows<'a> {
    ground: &'a Ground,
    feet: &'a mut [Feet],
    origins: &'a [EnvOrigin],
}

impl Kernel<f32> for FeetRows<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { ground, feet, origins } = self;
        let order = ground.order_of_tiles(origins);
        for k in 0..feet.len() {
            let row = order.as_ref().map_or(k, |order| order[k] as usize);
            feet[row].measure(ground, &origins[row]);
        }
    }
}

impl Feet {
    /// Their heights above the ground, from where they are.
    #[inline(always)]
    pub(in crate::systems) fn measure(&mut self, ground: &Ground, origin: &EnvOrigin) {
        let Self { position, height, .. } = self;
        ground.heights_at(origin, position.iter().map(|[x, y, _]| [*x, *y]), height);
        for ([_, _, z], height) in position.iter().zip(height) {
            *height = z - *height;
        }
    }
}
