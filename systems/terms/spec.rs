//! What an observation term is: stated once, where it is registered, and read there by export, mirror images and docs.

use serde::Serialize;

use crate::config::HeightScannerConfig;
use crate::morphology::MorphologyModel;

/// What the numbers of a term are, which says how they change in a mirror that exchanges left and right.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum TermKind {
    /// Numbers that a mirror leaves alone.
    Scalar,
    /// A vector x, y, z: y changes its sign.
    Vector,
    /// A pseudovector x, y, z, such as an angular velocity: x and z change their signs.
    Pseudovector,
    /// Forward and left velocity and yaw rate: the last two change their signs.
    PlanarVelocity,
    /// A number of each joint, canonical order: joints change sides, and some of them their signs.
    PerJoint,
    /// A number of each ray of the height scanner: its rows change sides.
    Scan,
    /// Numbers of the whole body, then one of each joint, then one of the whole body.
    Body,
}

/// Kind, units and meaning of an observation term.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct TermSpec {
    /// What its numbers are.
    pub kind: TermKind,
    /// SI units; empty for numbers without.
    pub units: &'static str,
    /// What it says, with its frame.
    pub description: &'static str,
    /// What a robot's sensors have to give for it, by the names of a folded graph's inputs; empty: the term itself.
    pub inputs: &'static [&'static str],
}

impl TermSpec {
    /// A term that a deployment measures as it is.
    pub const fn new(kind: TermKind, units: &'static str, description: &'static str) -> Self {
        Self { kind, units, description, inputs: &[] }
    }

    /// A term that is computed from other inputs.
    pub const fn from_inputs(self, inputs: &'static [&'static str]) -> Self {
        Self { inputs, ..self }
    }

    /// The mirror image of `size` numbers: of each, which number takes its place and with which sign.
    pub(crate) fn mirror(
        &self,
        size: usize,
        robot: &MorphologyModel,
        scanner: Option<&HeightScannerConfig>,
    ) -> Vec<(usize, f32)> {
        let signs = |signs: [f32; 3]| (0..size).map(|i| (i, signs[i % 3])).collect();
        let joints = |first: usize| robot.mirrored_slots().into_iter().map(move |(slot, sign)| (first + slot, sign));
        match self.kind {
            TermKind::Scalar => signs([1.0; 3]),
            TermKind::Vector => signs([1.0, -1.0, 1.0]),
            TermKind::Pseudovector => signs([-1.0, 1.0, -1.0]),
            TermKind::PlanarVelocity => signs([1.0, -1.0, -1.0]),
            TermKind::PerJoint => joints(0).collect(),
            TermKind::Scan => {
                // rows from right to left, each from back to front
                let rows = scanner.map_or(1, |scanner| scanner.counts()[1]).max(1);
                let length = size / rows;
                (0..rows).rev().flat_map(|row| (row * length..(row + 1) * length).map(|i| (i, 1.0))).collect()
            }
            TermKind::Body => {
                let first = size - 1 - robot.mirrored_slots().len();
                let body = (0..first).map(|i| (i, 1.0));
                body.chain(joints(first)).chain([(size - 1, 1.0)]).collect()
            }
        }
    }
}
