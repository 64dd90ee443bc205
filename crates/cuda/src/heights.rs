//! Heights of the ground as a device reads them.

use std::sync::Arc;

use polypod_dynamics::HeightGrid;

/// A height grid; all morphologies share it.
#[derive(Clone, Debug)]
pub struct Heights {
    pub(crate) origin: [f32; 2],
    pub(crate) cell: f32,
    pub(crate) size: [usize; 2],
    pub(crate) highest: f32,
    /// Points along the edge of the squares of links and of those of candidates, their numbers
    /// along x and y, and where their heights begin.
    pub(crate) squares: [[usize; 4]; 2],
    /// Heights, `[x][y]`, then the largest heights of the squares.
    pub(crate) numbers: Arc<[f32]>,
}

impl Heights {
    /// The heights of a grid, whose [`squares`](HeightGrid::note_squares) must be noted.
    pub fn new(grid: &HeightGrid) -> Self {
        let &HeightGrid { origin, cell, size, highest, .. } = grid;
        let mut numbers = grid.heights();
        let squares = grid.squares().each_ref().map(|squares| {
            let begin = numbers.len();
            numbers.extend(&squares.highest);
            [squares.stride, squares.num[0], squares.num[1], begin]
        });
        Self { origin, cell, size, highest, squares, numbers: numbers.into() }
    }
}
