//! Parts of a network of joints besides matrix products: attention over the joints of a body, and
//! codes of joints.
//!
//! A tile has rows of samples, and rows of the joints of its bodies. A sample reads its body's
//! rows, which all samples of that body share.

use polypod_lanes::Real;
use polypod_lanes::elementary::exp;

use crate::activation::Activation;
use crate::lines::{Line, WIDTH};
use crate::matrix::LineKernel;

/// Number of heads, or joints, that are summed side by side.
const SIDE_BY_SIDE: usize = 8;

/// A body of a tile, and its consecutive samples.
#[derive(Clone, Debug)]
pub(crate) struct Run {
    /// First sample.
    pub(crate) first: usize,
    /// Number of samples.
    pub(crate) count: usize,
    /// The first of the body's joints.
    pub(crate) start: usize,
    /// Number of the body's joints.
    pub(crate) joints: usize,
}

/// Adds what a body says of a joint to what the joint does, and applies the activation.
pub(crate) struct AddBodies<'a> {
    pub(crate) runs: &'a [Run],
    /// Number of samples.
    pub(crate) rows: usize,
    /// Number of joints that a sample has room for.
    pub(crate) most: usize,
    /// Panels `[panels][joints of the bodies]`.
    pub(crate) by: &'a [Line],
    /// Number of joints of the bodies.
    pub(crate) num_joints: usize,
    pub(crate) activation: Activation,
    /// Panels `[panels][most][rows]`.
    pub(crate) state: &'a mut [Line],
}

impl LineKernel for AddBodies<'_> {
    #[inline(always)]
    fn run<L: Real>(self) {
        let Self { runs, rows, most, by, num_joints, activation, state } = self;
        for (place, lines) in state.chunks_exact_mut(rows).enumerate() {
            let (panel, joint) = (place / most, place % most);
            let mut next = 0;
            for run in runs {
                let own = match joint < run.joints {
                    true => L::load(&by[panel * num_joints + run.start + joint].0),
                    false => L::zero(),
                };
                for line in &mut lines[run.first..][..run.count] {
                    activation.apply(L::load(&line.0) + own).store(&mut line.0);
                }
                next = run.first + run.count;
            }
            for line in &mut lines[next..] {
                activation.apply(L::load(&line.0)).store(&mut line.0);
            }
        }
    }
}

/// The attention of a tile: each head's shares in the joints of a body.
pub(crate) struct Attention<'a> {
    pub(crate) runs: &'a [Run],
    pub(crate) rows: usize,
    pub(crate) most: usize,
    pub(crate) heads: usize,
    /// Number of lines of a joint's value.
    pub(crate) lines: usize,
    /// Panels `[lines of heads][joints of the bodies]`.
    pub(crate) shares: &'a [Line],
    pub(crate) num_joints: usize,
}

impl Attention<'_> {
    #[inline(always)]
    fn share<L: Real>(&self, joint: usize, head: usize) -> L {
        L::broadcast(self.shares[head / WIDTH * self.num_joints + joint].0[head % WIDTH])
    }

    /// Gathers `N` heads of a sample.
    #[inline(always)]
    fn gather<L: Real, const N: usize>(
        &self,
        run: &Run,
        [line, row, head]: [usize; 3],
        values: &[Line],
        out: &mut [Line],
    ) {
        let mut sums = [L::zero(); N];
        for joint in 0..run.joints {
            let value = L::load(&values[(line * self.most + joint) * self.rows + row].0);
            for i in 0..N {
                sums[i] = self.share::<L>(run.start + joint, head + i).mul_add(value, sums[i]);
            }
        }
        for i in 0..N {
            sums[i].store(&mut out[((head + i) * self.lines + line) * self.rows + row].0);
        }
    }

    /// The derivatives of the values of `N` joints of a sample.
    #[inline(always)]
    fn spread<L: Real, const N: usize>(
        &self,
        run: &Run,
        [line, row, joint]: [usize; 3],
        delta: &[Line],
        out: &mut [Line],
    ) {
        let mut sums = [L::zero(); N];
        for head in 0..self.heads {
            let delta = L::load(&delta[(head * self.lines + line) * self.rows + row].0);
            for i in 0..N {
                sums[i] = self.share::<L>(run.start + joint + i, head).mul_add(delta, sums[i]);
            }
        }
        for i in 0..N {
            sums[i].store(&mut out[(line * self.most + joint + i) * self.rows + row].0);
        }
    }

    /// The derivatives of the shares of `N` heads in a joint.
    #[inline(always)]
    fn compare<L: Real, const N: usize>(
        &self,
        run: &Run,
        [joint, head]: [usize; 2],
        values: &[Line],
        delta: &[Line],
        out: &mut [Line],
    ) {
        let mut sums = [L::zero(); N];
        for line in 0..self.lines {
            for row in run.first..run.first + run.count {
                let value = L::load(&values[(line * self.most + joint) * self.rows + row].0);
                for i in 0..N {
                    let delta = L::load(&delta[((head + i) * self.lines + line) * self.rows + row].0);
                    sums[i] = delta.mul_add(value, sums[i]);
                }
            }
        }
        for i in 0..N {
            let mut line = Line::ZERO;
            sums[i].store(&mut line.0);
            let head = head + i;
            out[head / WIDTH * self.num_joints + run.start + joint].0[head % WIDTH] = line.sum();
        }
    }
}

/// Gathers what the heads see in the joints' values.
pub(crate) struct Gather<'a> {
    pub(crate) attention: Attention<'a>,
    /// Panels `[lines][most][rows]`.
    pub(crate) values: &'a [Line],
    /// Panels `[heads][lines][rows]`.
    pub(crate) out: &'a mut [Line],
}

impl LineKernel for Gather<'_> {
    #[inline(always)]
    fn run<L: Real>(self) {
        let Self { attention, values, out } = self;
        for run in attention.runs {
            for row in run.first..run.first + run.count {
                for line in 0..attention.lines {
                    let mut head = 0;
                    while head + SIDE_BY_SIDE <= attention.heads {
                        attention.gather::<L, SIDE_BY_SIDE>(run, [line, row, head], values, out);
                        head += SIDE_BY_SIDE;
                    }
                    for head in head..attention.heads {
                        attention.gather::<L, 1>(run, [line, row, head], values, out);
                    }
                }
            }
        }
    }
}

/// The derivatives of values and shares from those of what was gathered.
pub(crate) struct GatherBack<'a> {
    pub(crate) attention: Attention<'a>,
    /// Panels `[lines][most][rows]`.
    pub(crate) values: &'a [Line],
    /// Panels `[heads][lines][rows]`.
    pub(crate) delta: &'a [Line],
    /// Derivatives of the values; zero where a body has no joint.
    pub(crate) of_values: &'a mut [Line],
    /// Derivatives of the shares, panels `[lines of heads][joints of the bodies]`.
    pub(crate) of_shares: &'a mut [Line],
}

impl LineKernel for GatherBack<'_> {
    #[inline(always)]
    fn run<L: Real>(self) {
        let Self { attention, values, delta, of_values, of_shares } = self;
        for run in attention.runs {
            for row in run.first..run.first + run.count {
                for line in 0..attention.lines {
                    let mut joint = 0;
                    while joint + SIDE_BY_SIDE <= run.joints {
                        attention.spread::<L, SIDE_BY_SIDE>(run, [line, row, joint], delta, of_values);
                        joint += SIDE_BY_SIDE;
                    }
                    while joint + 4 <= run.joints {
                        attention.spread::<L, 4>(run, [line, row, joint], delta, of_values);
                        joint += 4;
                    }
                    for joint in joint..run.joints {
                        attention.spread::<L, 1>(run, [line, row, joint], delta, of_values);
                    }
                }
            }
            for joint in 0..run.joints {
                let mut head = 0;
                while head + SIDE_BY_SIDE <= attention.heads {
                    attention.compare::<L, SIDE_BY_SIDE>(run, [joint, head], values, delta, of_shares);
                    head += SIDE_BY_SIDE;
                }
                for head in head..attention.heads {
                    attention.compare::<L, 1>(run, [joint, head], values, delta, of_shares);
                }
            }
        }
    }
}

/// Turns logarithms of shares into shares: for each head they sum up to 1 over the joints of a
/// body.
pub(crate) struct Softmax<'a> {
    pub(crate) runs: &'a [Run],
    pub(crate) num_joints: usize,
    /// Addends of the logarithms, panels `[lines of heads][joints of the bodies]`.
    pub(crate) added: &'a [Line],
    /// Shares of the attention, of the same size.
    pub(crate) shares: &'a mut [Line],
}

impl LineKernel for Softmax<'_> {
    #[inline(always)]
    fn run<L: Real>(self) {
        let Self { runs, num_joints, added, shares } = self;
        for (panel, added) in shares.chunks_exact_mut(num_joints).zip(added.chunks_exact(num_joints)) {
            for run in runs.iter().filter(|run| run.joints > 0) {
                let own = run.start..run.start + run.joints;
                let (lines, added) = (&mut panel[own.clone()], &added[own]);
                let mut most = L::splat(-1e30);
                for (line, added) in lines.iter_mut().zip(added) {
                    let sum = L::load(&line.0) + L::load(&added.0);
                    sum.store(&mut line.0);
                    most = most.max(sum);
                }
                let mut total = L::zero();
                for line in &mut *lines {
                    let share = exp(L::load(&line.0) - most);
                    share.store(&mut line.0);
                    total = total + share;
                }
                for line in lines {
                    (L::load(&line.0) / total).store(&mut line.0);
                }
            }
        }
    }
}

/// The derivatives of logarithms of shares, in place of those of the shares.
pub(crate) struct SoftmaxBack<'a> {
    pub(crate) runs: &'a [Run],
    pub(crate) num_joints: usize,
    pub(crate) shares: &'a [Line],
    pub(crate) delta: &'a mut [Line],
}

impl LineKernel for SoftmaxBack<'_> {
    #[inline(always)]
    fn run<L: Real>(self) {
        let Self { runs, num_joints, shares, delta } = self;
        for (delta, shares) in delta.chunks_exact_mut(num_joints).zip(shares.chunks_exact(num_joints)) {
            for run in runs {
                let own = run.start..run.start + run.joints;
                let (delta, shares) = (&mut delta[own.clone()], &shares[own]);
                let mut mean = L::zero();
                for (delta, share) in delta.iter().zip(shares) {
                    mean = L::load(&delta.0).mul_add(L::load(&share.0), mean);
                }
                for (delta, share) in delta.iter_mut().zip(shares) {
                    (L::load(&share.0) * (L::load(&delta.0) - mean)).store(&mut delta.0);
                }
            }
        }
    }
}

/// Codes of joints: sines with deviation 1.
pub(crate) struct Sines<'a> {
    pub(crate) phases: &'a [Line],
    pub(crate) codes: &'a mut [Line],
}

impl LineKernel for Sines<'_> {
    #[inline(always)]
    fn run<L: Real>(self) {
        let root = L::splat(std::f64::consts::SQRT_2);
        for (phase, code) in self.phases.iter().zip(self.codes) {
            (root * L::load(&phase.0).sin_cos().0).store(&mut code.0);
        }
    }
}

/// The derivatives of phases, in place of those of the codes.
pub(crate) struct SinesBack<'a> {
    pub(crate) phases: &'a [Line],
    pub(crate) delta: &'a mut [Line],
}

impl LineKernel for SinesBack<'_> {
    #[inline(always)]
    fn run<L: Real>(self) {
        let root = L::splat(std::f64::consts::SQRT_2);
        for (phase, delta) in self.phases.iter().zip(self.delta) {
            (root * L::load(&phase.0).sin_cos().1 * L::load(&delta.0)).store(&mut delta.0);
        }
    }
}

/// Replaces numbers by their exponentials.
pub(crate) struct Exponentials<'a>(pub(crate) &'a mut [Line]);

impl LineKernel for Exponentials<'_> {
    #[inline(always)]
    fn run<L: Real>(self) {
        for line in self.0 {
            exp(L::load(&line.0)).store(&mut line.0);
        }
    }
}

/// Multiplies `delta` by the activation's derivatives at the outputs `y`.
pub(crate) struct Derivatives<'a> {
    pub(crate) activation: Activation,
    pub(crate) y: &'a [Line],
    pub(crate) delta: &'a mut [Line],
}

impl LineKernel for Derivatives<'_> {
    #[inline(always)]
    fn run<L: Real>(self) {
        for (y, delta) in self.y.iter().zip(self.delta) {
            (self.activation.derivative(L::load(&y.0)) * L::load(&delta.0)).store(&mut delta.0);
        }
    }
}

/// Sums the derivatives of a body's joints over its samples.
pub(crate) struct SumOverSamples<'a> {
    pub(crate) runs: &'a [Run],
    pub(crate) rows: usize,
    pub(crate) most: usize,
    /// Panels `[panels][most][rows]`.
    pub(crate) delta: &'a [Line],
    pub(crate) num_joints: usize,
    /// Panels `[panels][joints of the bodies]`.
    pub(crate) out: &'a mut [Line],
}

impl LineKernel for SumOverSamples<'_> {
    #[inline(always)]
    fn run<L: Real>(self) {
        let Self { runs, rows, most, delta, num_joints, out } = self;
        for (panel, out) in out.chunks_exact_mut(num_joints).enumerate() {
            for run in runs {
                for joint in 0..run.joints {
                    let mut sum = L::zero();
                    for line in &delta[(panel * most + joint) * rows + run.first..][..run.count] {
                        sum = sum + L::load(&line.0);
                    }
                    sum.store(&mut out[run.start + joint].0);
                }
            }
        }
    }
}
