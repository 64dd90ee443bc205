//! Heights of the feet above the ground.

use bevy_ecs::prelude::*;

use crate::blocks::{Block, Blocks};
use crate::components::{Env, EnvOrigin, Feet, Robot};
use crate::dynamics::lanes::Kernel;
use crate::workers::Workers;
use crate::world::Ground;

/// Measures the feet of all robots.
pub(super) fn measure_feet(
    workers: Res<Workers>,
    ground: Res<Ground>,
    mut robots: Blocks<&'static mut Feet, Robot>,
    envs: Blocks<&'static EnvOrigin, Env>,
) -> Result {
    let ground = &ground;
    let blocks = robots.write()?.zip(envs.read()?);
    blocks.vectorize_chunks(&workers, |Block { rows: (feet, origins), .. }| FeetRows { ground, feet, origins });
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
    /// Measures the feet's heights above the ground, from where they are.
    #[inline(always)]
    pub(in crate::systems) fn measure(&mut self, ground: &Ground, origin: &EnvOrigin) {
        let Self { position, height, .. } = self;
        ground.heights_at(origin, position.iter().map(|[x, y, _]| [*x, *y]), height);
        for ([_, _, z], height) in position.iter().zip(height) {
            *height = z - *height;
        }
    }
}
