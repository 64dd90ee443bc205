//! The three matrix products of a perceptron, over lines. Nearly all time of a training is spent
//! here.
//!
//! Matrices are stored by panels of sixteen columns: the sixteen numbers of a row in a panel are a
//! [`Line`], and the lines of a panel follow one another. A block of rows times two panels of
//! columns stays in registers while the inner dimension runs, and reads memory in order.
//!
//! Every number of a product is one chain of fused multiply-adds in the order of the inner
//! dimension. So the bits depend neither on the width of the registers nor on the size of the
//! blocks.

use std::ops::Range;

use polypod_lanes::{Kernel, Lanes, Real, SimdToken, WithLanes};

use crate::activation::Activation;
use crate::lines::{Line, WIDTH};

/// Numbers of rows and inner dimensions are multiples of this.
pub(crate) const BLOCK: usize = 8;

/// `out = end(a b)`.
pub(crate) struct Product<'a> {
    /// Rows of `a` and of `out`.
    pub(crate) rows: usize,
    /// The rows that are computed.
    pub(crate) range: Range<usize>,
    /// Columns of `a`, a multiple of [`BLOCK`].
    pub(crate) inner: usize,
    /// Panels `[lines of inner][rows]`.
    pub(crate) a: &'a [Line],
    /// Panels `[panels][inner, then what `end` reads]`.
    pub(crate) b: &'a [Line],
    /// Panels `[panels][rows]`.
    pub(crate) out: &'a mut [Line],
    pub(crate) end: End<'a>,
}

/// Operation on a sum before it is written.
#[derive(Clone, Copy)]
pub(crate) enum End<'a> {
    /// Each panel of `b` has one line more: the bias. The activation follows, if there is one.
    Bias(Option<Activation>),
    /// The sum is multiplied by the activation's derivative at these outputs, panels
    /// `[panels][rows]`.
    Derivative(Activation, &'a [Line]),
    /// No operation.
    Plain,
    /// Addition of these lines, panels `[panels][rows]`.
    Add(&'a [Line]),
    /// Addition of the second lines, then multiplication by the activation's derivative at the
    /// first ones.
    AddDerivative(Activation, &'a [Line], &'a [Line]),
}

/// `gradient += transposed(input) delta`, and the sum of `delta` for the bias.
pub(crate) struct WeightGradient<'a> {
    /// Number of samples.
    pub(crate) rows: usize,
    /// The samples that are summed.
    pub(crate) range: Range<usize>,
    /// Columns of `input`, a multiple of [`BLOCK`].
    pub(crate) inner: usize,
    /// Panels `[lines of inner][rows]`.
    pub(crate) input: &'a [Line],
    /// Panels `[panels][rows]`.
    pub(crate) delta: &'a [Line],
    /// Panels `[panels][inner, then the bias]`.
    pub(crate) gradient: &'a mut [Line],
}

/// The products, compiled for an instruction set.
#[derive(Clone, Copy)]
pub(crate) struct Matrix {
    simd: SimdToken,
    pub(crate) product: fn(Product),
    pub(crate) weight_gradient: fn(WeightGradient),
}

impl Matrix {
    pub(crate) fn new(simd: SimdToken) -> Self {
        simd.with_sixteen_lanes(Products(simd))
    }

    /// Runs another computation over lines, compiled for the same instruction set.
    pub(crate) fn run(self, kernel: impl LineKernel) {
        self.simd.with_sixteen_lanes(OnLanes(kernel));
    }
}

/// [`Matrix::new`] for a lane type.
struct Products(SimdToken);

impl WithLanes for Products {
    type Output = Matrix;
    fn run<L: Lanes>(self) -> Matrix {
        Matrix {
            simd: self.0,
            product: |product| L::vectorize(product),
            weight_gradient: |gradient| L::vectorize(gradient),
        }
    }
}

/// A computation over lines: sixteen lanes at a time.
pub(crate) trait LineKernel {
    /// The computation, compiled for the instruction set of `L`.
    fn run<L: Real>(self);
}

struct OnLanes<K>(K);

impl<K: LineKernel> WithLanes for OnLanes<K> {
    type Output = ();
    fn run<L: Lanes>(self) {
        L::vectorize(self);
    }
}

impl<L: Real, K: LineKernel> Kernel<L> for OnLanes<K> {
    type Output = ();
    #[inline(always)]
    fn run(self) {
        self.0.run::<L>();
    }
}

/// Size of the blocks that stay in registers, with a line of each panel and a number of a row. More
/// sums at once hide the latency of a multiply-add and load fewer numbers for each.
trait Blocking: Lanes {
    /// Whether [`BLOCK`] rows times two panels fit into the registers.
    const MANY_REGISTERS: bool = Self::REGISTERS > 2 * BLOCK;
    /// Whether [`SIX`] rows times a panel fit: 15 of the 16 registers of AVX2, 29 of the 32 of
    /// NEON. Else four rows times a panel.
    const SIX_ROWS: bool = Self::REGISTERS > SIX + 1;
}

/// Rows of a block where registers hold eight lines.
const SIX: usize = 6;

impl<L: Lanes> Blocking for L {}

/// A product that is computed panel by panel.
trait Panels {
    /// Number of panels.
    fn count(&self) -> usize;
    /// Computes `W` panels, blocks of at most `R` lines at a time.
    fn columns<L: Real, const R: usize, const W: usize>(&mut self, panel: usize);
}

/// Computes all panels, as many side by side as the registers hold.
#[inline(always)]
fn all_panels<L: Blocking>(mut product: impl Panels) {
    let panels = product.count();
    if L::MANY_REGISTERS {
        let mut panel = 0;
        while panel + 2 <= panels {
            product.columns::<L, BLOCK, 2>(panel);
            panel += 2;
        }
        if panel < panels {
            product.columns::<L, BLOCK, 1>(panel);
        }
    } else {
        for panel in 0..panels {
            if L::SIX_ROWS {
                product.columns::<L, SIX, 1>(panel);
            } else {
                product.columns::<L, { BLOCK / 2 }, 1>(panel);
            }
        }
    }
}

impl<L: Blocking> Kernel<L> for Product<'_> {
    type Output = ();
    #[inline(always)]
    fn run(self) {
        all_panels::<L>(self);
    }
}

impl Panels for Product<'_> {
    #[inline(always)]
    fn count(&self) -> usize {
        self.out.len() / self.rows
    }

    #[inline(always)]
    fn columns<L: Real, const R: usize, const W: usize>(&mut self, panel: usize) {
        let inner = self.inner;
        let stride = inner + usize::from(matches!(self.end, End::Bias(_)));
        let all = self.b;
        let mut b: [&[Line]; W] = [&[]; W];
        let mut start = [L::zero(); W];
        for w in 0..W {
            b[w] = &all[(panel + w) * stride..][..inner];
            if let End::Bias(_) = self.end {
                start[w] = L::load(&all[(panel + w) * stride + inner].0);
            }
        }
        let Range { start: mut row, end } = self.range.clone();
        while row + R <= end && !(R == SIX && row + BLOCK == end) {
            self.block::<L, R, W>(panel, row, &b, &start);
            row += R;
        }
        // the eight rows that are left of 32, for example
        while R == SIX && row + 4 <= end {
            self.block::<L, 4, W>(panel, row, &b, &start);
            row += 4;
        }
        while row + 2 <= end {
            self.block::<L, 2, W>(panel, row, &b, &start);
            row += 2;
        }
        if row < end {
            self.block::<L, 1, W>(panel, row, &b, &start);
        }
    }
}

impl Product<'_> {
    /// Computes `R` rows of `W` panels.
    #[inline(always)]
    fn block<L: Real, const R: usize, const W: usize>(
        &mut self,
        panel: usize,
        row: usize,
        b: &[&[Line]; W],
        start: &[L; W],
    ) {
        let (rows, inner) = (self.rows, self.inner);
        // lines between two branches, a divisor of BLOCK: with fewer multiply-adds a branch costs
        // more
        let steps = if W == 1 { 4 } else { 1 };
        let mut sums = [*start; R];
        let mut k = 0;
        while k < inner {
            let a = &self.a[k / WIDTH * rows + row..][..R];
            for i in (0..WIDTH.min(inner - k)).step_by(steps) {
                let mut lines: [&[Line]; W] = [&[]; W];
                for w in 0..W {
                    lines[w] = &b[w][k + i..][..steps];
                }
                for j in 0..steps {
                    let mut line = [L::zero(); W];
                    for w in 0..W {
                        line[w] = L::load(&lines[w][j].0);
                    }
                    for r in 0..R {
                        let x = L::broadcast(a[r].0[(i + j) % WIDTH]);
                        for w in 0..W {
                            sums[r][w] = x.mul_add(line[w], sums[r][w]);
                        }
                    }
                }
            }
            k += WIDTH;
        }
        // sums that are written first stay in registers
        for w in 0..W {
            let out = &mut self.out[(panel + w) * rows + row..][..R];
            for r in 0..R {
                sums[r][w].store(&mut out[r].0);
            }
        }
        for w in 0..W {
            self.finish::<L, R>((panel + w) * rows + row);
        }
    }

    /// Applies the activation or its derivative to `R` lines.
    #[inline(always)]
    fn finish<L: Real, const R: usize>(&mut self, first: usize) {
        let out = &mut self.out[first..][..R];
        match self.end {
            End::Bias(None) | End::Plain => {}
            End::Bias(Some(activation)) => {
                for line in out {
                    activation.apply(L::load(&line.0)).store(&mut line.0);
                }
            }
            End::Derivative(activation, y) => {
                for (line, y) in out.iter_mut().zip(&y[first..]) {
                    (L::load(&line.0) * activation.derivative(L::load(&y.0))).store(&mut line.0);
                }
            }
            End::Add(others) => {
                for (line, other) in out.iter_mut().zip(&others[first..]) {
                    (L::load(&line.0) + L::load(&other.0)).store(&mut line.0);
                }
            }
            End::AddDerivative(activation, y, others) => {
                for ((line, other), y) in out.iter_mut().zip(&others[first..]).zip(&y[first..]) {
                    let sum = L::load(&line.0) + L::load(&other.0);
                    (sum * activation.derivative(L::load(&y.0))).store(&mut line.0);
                }
            }
        }
    }
}

impl<L: Blocking> Kernel<L> for WeightGradient<'_> {
    type Output = ();
    #[inline(always)]
    fn run(self) {
        all_panels::<L>(self);
    }
}

impl Panels for WeightGradient<'_> {
    #[inline(always)]
    fn count(&self) -> usize {
        self.gradient.len() / (self.inner + 1)
    }

    #[inline(always)]
    fn columns<L: Real, const R: usize, const W: usize>(&mut self, panel: usize) {
        let (rows, inner, range) = (self.rows, self.inner, self.range.clone());
        let mut delta: [&[Line]; W] = [&[]; W];
        for w in 0..W {
            delta[w] = &self.delta[(panel + w) * rows + range.start..][..range.len()];
        }
        let mut k = 0;
        while k < inner {
            if R != SIX {
                self.block::<L, R, W>(panel, k, &delta);
                k += R;
            } else if k % WIDTH == 0 && k + WIDTH <= inner {
                // a block has the columns of one line
                self.block::<L, 6, W>(panel, k, &delta);
                self.block::<L, 5, W>(panel, k + 6, &delta);
                self.block::<L, 5, W>(panel, k + 11, &delta);
                k += WIDTH;
            } else {
                self.block::<L, 4, W>(panel, k, &delta);
                k += 4;
            }
        }
        for w in 0..W {
            let bias = &mut self.gradient[(panel + w) * (inner + 1) + inner];
            let mut sum = L::load(&bias.0);
            for line in delta[w] {
                sum = sum + L::load(&line.0);
            }
            sum.store(&mut bias.0);
        }
    }
}

impl WeightGradient<'_> {
    /// Computes `R` lines of `W` panels, from the columns of one line of inputs.
    #[inline(always)]
    fn block<L: Real, const R: usize, const W: usize>(&mut self, panel: usize, k: usize, delta: &[&[Line]; W]) {
        let (rows, inner, range) = (self.rows, self.inner, self.range.clone());
        let input = &self.input[k / WIDTH * rows + range.start..][..range.len()];
        let column = k % WIDTH;
        let mut sums = [[L::zero(); W]; R];
        for w in 0..W {
            let gradient = &self.gradient[(panel + w) * (inner + 1) + k..][..R];
            for r in 0..R {
                sums[r][w] = L::load(&gradient[r].0);
            }
        }
        for t in 0..range.len() {
            let mut line = [L::zero(); W];
            for w in 0..W {
                line[w] = L::load(&delta[w][t].0);
            }
            let x = &input[t].0[column..][..R];
            for r in 0..R {
                let x = L::broadcast(x[r]);
                for w in 0..W {
                    sums[r][w] = x.mul_add(line[w], sums[r][w]);
                }
            }
        }
        for w in 0..W {
            let gradient = &mut self.gradient[(panel + w) * (inner + 1) + k..][..R];
            for r in 0..R {
                sums[r][w].store(&mut gradient[r].0);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use polypod_lanes::Simd;

    use super::*;
    use crate::lines::lines_of;

    /// Rows, inner dimension, columns. The rows and inner dimensions leave every remainder of a
    /// block that occurs.
    const SIZES: [(usize, usize, usize); 7] =
        [(8, 8, 1), (16, 24, 16), (24, 88, 37), (8, 40, 64), (32, 48, 33), (11, 16, 12), (96, 128, 128)];

    fn numbers(count: usize, seed: u32) -> Vec<f32> {
        let mut x = seed;
        let mut next = || {
            x = x.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (x >> 8) as f32 / 8_388_608.0 - 1.0
        };
        (0..count).map(|_| next()).collect()
    }

    /// A row-major matrix by panels, with `rows` rows of lines.
    fn panels(matrix: &[f32], rows: usize, columns: usize) -> Vec<Line> {
        let mut lines = vec![Line::ZERO; lines_of(columns) * rows];
        for row in 0..rows {
            for column in 0..columns {
                lines[column / WIDTH * rows + row].0[column % WIDTH] = matrix[row * columns + column];
            }
        }
        lines
    }

    /// One chain of fused multiply-adds in order.
    fn chain(start: f32, terms: impl Iterator<Item = (f32, f32)>) -> f32 {
        terms.fold(start, |sum, (a, b)| a.mul_add(b, sum))
    }

    #[test]
    fn products_are_chains_in_order_on_every_instruction_set() {
        for (rows, inner, columns) in SIZES {
            let (a, b) = (numbers(rows * inner, 1), numbers((inner + 1) * columns, 2));
            for simd in Simd::available() {
                let mut out = vec![Line::ZERO; lines_of(columns) * rows];
                (Matrix::new(simd.token().unwrap()).product)(Product {
                    rows,
                    range: 0..rows,
                    inner,
                    a: &panels(&a, rows, inner),
                    b: &panels(&b, inner + 1, columns),
                    out: &mut out,
                    end: End::Bias(Some(Activation::Relu)),
                });
                for row in 0..rows {
                    for column in 0..columns {
                        let terms = (0..inner).map(|k| (a[row * inner + k], b[k * columns + column]));
                        let expected = chain(b[inner * columns + column], terms).max(0.0);
                        let found = out[column / WIDTH * rows + row].0[column % WIDTH];
                        assert_eq!(found.to_bits(), expected.to_bits(), "{} {row} {column}", simd.name());
                    }
                }
            }
        }
    }

    #[test]
    fn weight_gradients_are_chains_in_order_on_every_instruction_set() {
        for (rows, inner, columns) in SIZES {
            let (input, delta) = (numbers(rows * inner, 3), numbers(rows * columns, 4));
            for simd in Simd::available() {
                let mut gradient = vec![Line([0.5; WIDTH]); lines_of(columns) * (inner + 1)];
                (Matrix::new(simd.token().unwrap()).weight_gradient)(WeightGradient {
                    rows,
                    range: 0..rows,
                    inner,
                    input: &panels(&input, rows, inner),
                    delta: &panels(&delta, rows, columns),
                    gradient: &mut gradient,
                });
                for column in 0..columns {
                    let delta = |row: usize| delta[row * columns + column];
                    for k in 0..=inner {
                        let input = |row: usize| if k == inner { 1.0 } else { input[row * inner + k] };
                        let expected = chain(0.5, (0..rows).map(|row| (input(row), delta(row))));
                        let found = gradient[column / WIDTH * (inner + 1) + k].0[column % WIDTH];
                        assert_eq!(found.to_bits(), expected.to_bits(), "{} {k} {column}", simd.name());
                    }
                }
            }
        }
    }
}
