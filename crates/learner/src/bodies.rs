//! The bodies that a part has met in an iteration, as networks of joints read them from
//! observations.

use std::collections::HashMap;

use crate::gaussian::Gaussian;
use crate::joints::JointNetwork;
use crate::lines::{Line, WIDTH};
use crate::network::Mirror;
use crate::normalizer::Normalizer;

/// A body: its joints, and a network's inputs for each.
#[derive(Clone, Debug, Default)]
pub(crate) struct Body {
    /// Slots of its joints.
    pub(crate) slots: Vec<usize>,
    /// `[joints][lines]`: numbers of the descriptions, their logarithms, and their differences
    /// within the body; normalised.
    pub(crate) features: Vec<Line>,
    /// `[joints][lines]`: differences within the body.
    pub(crate) relative: Vec<Line>,
}

/// The bodies of some samples. Samples whose descriptions have the same bits share a body.
#[derive(Default)]
pub(crate) struct Bodies {
    numbers: HashMap<Vec<u32>, usize>,
    /// Each body, and its mirror image where images are used.
    all: Vec<[Body; 2]>,
    /// Description of each body.
    keys: Vec<Vec<u32>>,
    /// Number of the body of each sample.
    pub(crate) of_samples: Vec<usize>,
    /// Distribution of the actions while the samples were collected, of each body; None before its
    /// first action.
    pub(crate) old: Vec<Option<Gaussian>>,
    /// The last body of each env.
    last: Vec<usize>,
    scratch: Vec<u32>,
}

impl Bodies {
    /// Forgets all bodies.
    pub(crate) fn clear(&mut self) {
        *self = Self::default();
    }

    /// Number of the bodies.
    pub(crate) fn len(&self) -> usize {
        self.all.len()
    }

    /// A body, or its mirror image.
    pub(crate) fn get(&self, body: usize, is_image: bool) -> &Body {
        &self.all[body][usize::from(is_image)]
    }

    /// Deviations of the actions of the last bodies of all envs, one for each joint.
    pub(crate) fn last_deviations(&self) -> impl Iterator<Item = f32> {
        self.last.iter().filter_map(|&body| self.old.get(body)?.as_ref()).flat_map(Gaussian::deviations)
    }

    /// Number of the body that an env's observation describes.
    pub(crate) fn number_of(
        &mut self,
        network: &JointNetwork,
        normalizers: &[Normalizer],
        env: usize,
        observation: &[Line],
        mirror: Option<&Mirror>,
    ) -> usize {
        let at = |column: usize| observation[column / WIDTH].0[column % WIDTH];
        self.scratch.clear();
        self.scratch.extend(network.described_columns().map(|column| at(column).to_bits()));
        if let Some(&last) = self.last.get(env)
            && self.keys[last] == self.scratch
        {
            return last;
        }
        let number = match self.numbers.get(&self.scratch) {
            Some(&number) => number,
            None => {
                let number = self.all.len();
                let body = network.describe(normalizers, at);
                let image = mirror.map(|mirror| {
                    network.describe(normalizers, |column| {
                        let (index, sign) = mirror.observation[column];
                        at(index) * sign
                    })
                });
                self.all.push([body, image.unwrap_or_default()]);
                self.keys.push(self.scratch.clone());
                self.old.push(None);
                self.numbers.insert(self.scratch.clone(), number);
                number
            }
        };
        // envs come in order
        if env < self.last.len() {
            self.last[env] = number;
        } else {
            self.last.push(number);
        }
        number
    }
}
