//! Passive springs of joints, integrated by Newmark's method with average acceleration: a spring
//! loses no energy to the step.

use super::articulation::Topology;
use super::lanes::Real;
use super::parameters::BodyNumbers;
use super::settings::SPRING_STIFFNESS;
use super::state::{State, Workspace};

/// Adds the springs' implicit share to the diagonal of the mass matrix; nothing where no joint has
/// one.
#[inline(always)]
pub(super) fn add_spring_inertia<S: Real, B: BodyNumbers<S>>(
    topology: &Topology,
    parameters: B,
    dt: S,
    work: &mut Workspace<S>,
) {
    if !topology.has_springs {
        return;
    }
    let share = dt * dt * S::splat(SPRING_STIFFNESS);
    for (b, block) in topology.blocks().iter().enumerate() {
        for place in 0..block.len {
            let diagonal = &mut work.factor.blocks[b].diagonal[place];
            *diagonal = parameters.spring(block.joints[place])[0].mul_add(share, *diagonal);
        }
    }
}

/// Adds the springs' impulses over a step to those of the joints, `[blocks]`; nothing where no
/// joint has one.
#[inline(always)]
pub(super) fn add_spring_impulses<S: Real, B: BodyNumbers<S>>(
    topology: &Topology,
    parameters: B,
    dt: S,
    state: &State<S>,
    work: &mut Workspace<S>,
) {
    if !topology.has_springs {
        return;
    }
    for (b, block) in topology.blocks().iter().enumerate() {
        for place in 0..block.len {
            let j = block.joints[place];
            let [stiffness, rest] = parameters.spring(j);
            let force = stiffness * (rest - state.joint_position[j]);
            let impulse = &mut work.rhs_joint[b][place];
            *impulse = force.mul_add(dt, *impulse);
        }
    }
}
