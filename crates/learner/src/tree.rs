//! Sums over parts in an order that does not depend on the owners of the parts: the order of a
//! binary tree that halves them.

use std::ops::Range;

use polypod_lanes::Kernel;

use crate::lines::{Line, WIDTH};
use crate::moments::Moments;

/// Largest number of sums that wait for their right neighbour at the same time: more than the depth
/// of a tree with the largest number of leaves.
const MOST_WAITING: usize = 16;
/// Number of lines that go through the tree together.
const BLOCK: usize = 8;

/// The order in which leaves are summed.
#[derive(Clone, Debug)]
pub(crate) struct Tree {
    /// Sums that are complete with each leaf.
    complete: Vec<usize>,
}

impl Tree {
    /// Halves `parts` down to the leaves.
    pub(crate) fn new(parts: Range<usize>, is_leaf: &impl Fn(&Range<usize>) -> bool) -> Self {
        let mut complete = Vec::new();
        descend(parts, is_leaf, &mut complete);
        Self { complete }
    }

    /// A tree with a leaf for each of `count` parts.
    pub(crate) fn of_parts(count: usize) -> Self {
        Self::new(0..count, &|_| false)
    }

    /// Number of sums that are complete with each leaf.
    pub(crate) fn complete(&self) -> &[usize] {
        &self.complete
    }

    /// Sums the leaves.
    pub(crate) fn fold<T>(&self, leaves: impl IntoIterator<Item = T>, add: impl Fn(T, T) -> T) -> Option<T> {
        let mut waiting = Vec::new();
        for (leaf, &complete) in leaves.into_iter().zip(&self.complete) {
            let mut sum = leaf;
            for left in waiting.drain(waiting.len().saturating_sub(complete)..).rev() {
                sum = add(left, sum);
            }
            waiting.push(sum);
        }
        waiting.pop()
    }
}

/// The two halves of some parts.
pub(crate) fn halves(parts: &Range<usize>) -> [Range<usize>; 2] {
    let middle = parts.start + parts.len() / 2;
    [parts.start..middle, middle..parts.end]
}

fn descend(parts: Range<usize>, is_leaf: &impl Fn(&Range<usize>) -> bool, complete: &mut Vec<usize>) {
    if parts.len() <= 1 || is_leaf(&parts) {
        complete.push(0);
        return;
    }
    for half in halves(&parts) {
        descend(half, is_leaf, complete);
    }
    if let Some(last) = complete.last_mut() {
        *last += 1;
    }
}

/// Number of values of a [`Term`].
pub(crate) const NUMBERS: usize = 5;

/// Term that is summed over parts and sent to other workers.
pub(crate) trait Term: Copy + Default {
    /// Values of the term, as they are sent.
    fn numbers(self) -> [f64; NUMBERS];
    /// The term of some values.
    fn from_numbers(numbers: [f64; NUMBERS]) -> Self;
    /// The sum of two.
    fn add(self, other: Self) -> Self;
}

impl Term for [f64; NUMBERS] {
    fn numbers(self) -> [f64; NUMBERS] {
        self
    }
    fn from_numbers(numbers: [f64; NUMBERS]) -> Self {
        numbers
    }
    fn add(self, other: Self) -> Self {
        std::array::from_fn(|i| self[i] + other[i])
    }
}

impl Term for Moments {
    fn numbers(self) -> [f64; NUMBERS] {
        [self.count, self.mean, self.squares, 0.0, 0.0]
    }
    fn from_numbers([count, mean, squares, ..]: [f64; NUMBERS]) -> Self {
        Self { count, mean, squares }
    }
    fn add(self, other: Self) -> Self {
        self.merge(other)
    }
}

/// Sums lines of leaves, and the squares of the sums.
pub(crate) struct SumLines<'a> {
    pub(crate) tree: &'a Tree,
    pub(crate) leaves: Vec<&'a [Line]>,
    pub(crate) total: &'a mut [Line],
}

impl Kernel<f32> for SumLines<'_> {
    /// Sum of the squares.
    type Output = f64;
    #[inline(always)]
    fn run(self) -> f64 {
        debug_assert_eq!(self.leaves.len(), self.tree.complete.len());
        let mut squares = [0.0f64; WIDTH];
        let mut waiting = [[Line::ZERO; BLOCK]; MOST_WAITING];
        for (k, total) in self.total.chunks_mut(BLOCK).enumerate() {
            let lines = k * BLOCK..k * BLOCK + total.len();
            let mut next = 0;
            for (leaf, &complete) in self.leaves.iter().zip(&self.tree.complete) {
                let leaf = &leaf[lines.clone()];
                if complete == 0 {
                    waiting[next][..leaf.len()].copy_from_slice(leaf);
                    next += 1;
                    continue;
                }
                add(&mut waiting[next - 1], leaf);
                for right in (next + 1 - complete..next).rev() {
                    let sum = waiting[right];
                    add(&mut waiting[right - 1], &sum);
                }
                next -= complete - 1;
            }
            for (total, sum) in total.iter_mut().zip(&waiting[0]) {
                for i in 0..WIDTH {
                    let x = f64::from(sum.0[i]);
                    squares[i] += x * x;
                }
                *total = *sum;
            }
        }
        squares.iter().sum()
    }
}

/// Adds lines to the same number of others.
#[inline(always)]
fn add(to: &mut [Line; BLOCK], from: &[Line]) {
    for (to, from) in to.iter_mut().zip(from) {
        for i in 0..WIDTH {
            to.0[i] += from.0[i];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The sum of parts as text, with its brackets.
    fn brackets(parts: Range<usize>) -> String {
        if parts.len() == 1 {
            return parts.start.to_string();
        }
        let [left, right] = halves(&parts).map(brackets);
        format!("({left} {right})")
    }

    #[test]
    fn leaves_are_summed_as_the_tree_has_them() {
        for count in 1..=32 {
            let sum = Tree::of_parts(count).fold((0..count).map(|i| i.to_string()), |a, b| format!("({a} {b})"));
            assert_eq!(sum, Some(brackets(0..count)));
        }
    }

    #[test]
    fn lines_are_summed_in_the_same_order() {
        for (count, lines) in [(1, 3), (2, 8), (5, 17), (12, 9), (32, 20)] {
            let number = |part: usize, i: usize| ((part * 7919 + i * 104_729) % 1000) as f32 * 0.37;
            let leaves: Vec<Vec<Line>> = (0..count)
                .map(|part| (0..lines).map(|k| Line(std::array::from_fn(|i| number(part, k * WIDTH + i)))).collect())
                .collect();
            let (tree, mut total) = (Tree::of_parts(count), vec![Line::ZERO; lines]);
            let squares =
                SumLines { tree: &tree, leaves: leaves.iter().map(Vec::as_slice).collect(), total: &mut total }.run();
            let mut expected = 0.0;
            for (i, sum) in total.iter().flat_map(|line| line.0).enumerate() {
                assert_eq!(Some(sum), tree.fold((0..count).map(|part| number(part, i)), |a, b| a + b));
                expected += f64::from(sum) * f64::from(sum);
            }
            assert!((squares - expected).abs() <= 1e-12 * expected);
        }
    }
}
