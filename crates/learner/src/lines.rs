//! Memory in lines of sixteen numbers.

/// Numbers in a line.
pub const WIDTH: usize = 16;

/// Sixteen numbers in one aligned cache line.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C, align(64))]
pub struct Line(pub [f32; WIDTH]);

impl Line {
    /// Sixteen zeros.
    pub const ZERO: Self = Self([0.0; WIDTH]);

    /// Sum of its numbers, in a fixed order that lanes can follow.
    #[inline(always)]
    pub(crate) fn sum(&self) -> f32 {
        let mut half = WIDTH / 2;
        let mut sums = self.0;
        while half > 0 {
            for i in 0..half {
                sums[i] += sums[i + half];
            }
            half /= 2;
        }
        sums[0]
    }
}

/// Number of lines for `count` numbers.
pub(crate) const fn lines_of(count: usize) -> usize {
    count.div_ceil(WIDTH)
}
