//! Heights of the ground around the base.

use super::{SensedRobot, Sensor};
use crate::components::{BasePose, EnvOrigin, HeightScan};
use crate::config::{HeightScannerConfig, TaskConfig};
use crate::dynamics::LARGE_GROUP;
use crate::morphology::MorphologyModel;
use crate::world::Ground;

impl Sensor for HeightScan {
    type Settings = ScanRays;

    const READS_TERRAIN: bool = true;
    const IS_SAVED: bool = false;

    fn settings(task: &TaskConfig) -> Option<ScanRays> {
        task.sensors.height_scanner.as_ref().map(ScanRays::new)
    }

    fn new(rays: &ScanRays, _: &MorphologyModel) -> Self {
        Self { hits: vec![0.0; rays.len].into() }
    }

    #[inline(always)]
    fn measure(&mut self, rays: &ScanRays, robot: &SensedRobot) {
        rays.scan(robot.ground, robot.origin, robot.pose, self);
    }
}

/// Rays of the task's height scanner about the base, m, in groups, the last of which may hold
/// copies.
#[derive(Clone, Debug, Default)]
pub struct ScanRays {
    groups: Vec<[[f32; LARGE_GROUP]; 2]>,
    len: usize,
}

impl ScanRays {
    /// Settings of a scanner.
    fn new(scanner: &HeightScannerConfig) -> Self {
        let rays = scanner.rays();
        let group = |rays: &[[f32; 2]]| [0, 1].map(|axis| std::array::from_fn(|k| rays[k.min(rays.len() - 1)][axis]));
        Self { groups: rays.chunks(LARGE_GROUP).map(group).collect(), len: rays.len() }
    }

    /// Scans the ground around a base; the grid turns with its heading alone.
    #[inline(always)]
    fn scan(&self, ground: &Ground, origin: &EnvOrigin, pose: &BasePose, scan: &mut HeightScan) {
        let Some(grid) = &ground.terrain else {
            return scan.hits.fill(ground.height as f32);
        };
        let [c, s] = pose.forward();
        let ([x0, y0, _], [x1, y1]) = (pose.position, origin.position);
        for ([x, y], heights) in self.groups.iter().zip(scan.hits.chunks_mut(LARGE_GROUP)) {
            let (mut at_x, mut at_y) = ([0.0; LARGE_GROUP], [0.0; LARGE_GROUP]);
            for k in 0..LARGE_GROUP {
                at_x[k] = x1 + (x0 + (c * x[k] - s * y[k]));
                at_y[k] = y1 + (y0 + (s * x[k] + c * y[k]));
            }
            grid.heights_below(&at_x, &at_y, heights);
        }
    }
}
