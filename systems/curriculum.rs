//! Curriculum: changes of difficulty from episode to episode. Each env begins on a tile of the
//! terrain.

use bevy_ecs::prelude::*;
use serde::Deserialize;

use super::Share;
use super::terms::{CompiledTask, EpisodeEnd, Registry};
use crate::blocks::{Block, BlockSizes, Blocks};
use crate::components::{Env, EnvOrigin, EnvRng};
use crate::config::quantities::Gain;
use crate::config::{Columns, Placement, values};
use crate::engine::device::FormKind;
use crate::terrain::TerrainLayout;
use crate::world::Ground;

impl EnvOrigin {
    /// Moves to a level of the same column.
    fn move_to(&mut self, layout: &TerrainLayout, level: u32) {
        self.terrain_level = level;
        self.position = layout.origin(level, self.terrain_column);
    }
}

/// Gives every env its place: a tile whose type does not depend on the robot and whose level the
/// env's stream draws, or its place on a square grid.
pub fn place_envs(
    ground: Res<Ground>,
    task: Res<CompiledTask>,
    blocks: Res<BlockSizes>,
    share: Res<Share>,
    mut envs: Blocks<(&'static mut EnvOrigin, &'static mut EnvRng), Env>,
) -> Result {
    let scene = &task.config.scene;
    let total = share.num_envs;
    let own = envs.write()?.into_iter().flat_map(|Block { morphology, rows: (origins, rngs), .. }| {
        origins.iter_mut().zip(rngs).map(move |(origin, rng)| (usize::from(morphology.0), origin, rng))
    });
    for ((env, (robot, origin, rng)), index) in share.envs.clone().zip(own).zip(share.places(&blocks)) {
        *origin = EnvOrigin::default();
        if let Some(layout) = &ground.layout {
            let contiguous = scene.terrain.as_ref().is_some_and(|terrain| terrain.columns == Columns::Contiguous);
            let column = match contiguous {
                true => (env * layout.cols_per_scale as usize / total.max(1)) as u32,
                false => layout.column_of(index),
            };
            origin.terrain_column = layout.first_column(robot) + column;
            let level = rng.integer([0, layout.max_init_level]);
            origin.move_to(layout, level);
        } else if scene.placement == Placement::Global {
            let side = (total as f64).sqrt().ceil().max(1.0) as usize;
            let place = |i: usize| (i as f64 - 0.5 * (side - 1) as f64) * task.config.sim.env_spacing;
            origin.position = [place(env / side) as f32, place(env % side) as f32];
        }
    }
    Ok(())
}

/// All built-in curriculum terms, under Isaac Lab's names.
pub(super) fn register(registry: &mut Registry) {
    registry.curriculum("terrain_levels", terrain_levels);
    registry.on_device(FormKind::Curriculum, "terrain_levels", |p: LevelRules, _| {
        Some((vec![p.required_share as f32, p.min_length_s as f32], Some(Vec::new())))
    });
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct LevelRules {
    /// Share of the commanded distance below which a robot moves to an easier level.
    #[serde(default = "half", deserialize_with = "values::number_of::<Gain, _, _>")]
    required_share: f64,
    /// Least length of an episode after which a robot moves to an easier level, s. A shorter one
    /// does not show the robot's ability.
    #[serde(default = "one", deserialize_with = "values::non_negative")]
    min_length_s: f64,
}

fn half() -> f64 {
    0.5
}

fn one() -> f64 {
    1.0
}

/// A robot that left its tile moves to a harder level, one that fell behind its command to an
/// easier one. Beyond the hardest level it moves to a random one.
///
/// The commanded distance counts the time that the robot was given. A fall leaves the rest of the
/// episode unused, while an end from outside or a late start takes it away.
fn terrain_levels(p: &LevelRules, end: &mut EpisodeEnd, rng: &mut EnvRng) {
    let Some(layout) = end.layout else {
        return;
    };
    let length = |x: f32, y: f32| (x * x + y * y).sqrt();
    let walked = length(end.pose.position[0], end.pose.position[1]);
    let asked = length(end.command.velocity[0], end.command.velocity[1]) * end.given_s;
    let level = end.origin.terrain_level;
    let next = if walked > 0.5 * layout.size[0] {
        level + 1
    } else if walked < asked * p.required_share as f32 && end.lived_s >= p.min_length_s as f32 {
        level.saturating_sub(1)
    } else {
        return;
    };
    let next = if next < layout.num_rows { next } else { rng.integer([0, layout.num_rows - 1]) };
    end.origin.move_to(layout, next);
}
