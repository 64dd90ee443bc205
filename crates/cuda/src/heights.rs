//! Heights of the ground as a device reads them.

use std::sync::Arc;

use polypod_dynamics::HeightGrid;

/// Edge lengths of the squares whose largest heights are known, m, for links and for contact
/// candidates: `settings.rs` of polypod-dynamics.
const HEIGHT_SQUARES: [f32; 2] = [0.5, 0.125];

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
        let squares = HEIGHT_SQUARES.map(|edge| {
            let stride = ((edge / cell).round() as usize).max(1);
            let (begin, [x, y]) = (numbers.len(), note_squares(size, stride, &mut numbers));
            [stride, x, y, begin]
        });
        Self { origin, cell, size, highest, squares, numbers: numbers.into() }
    }
}

/// Appends the largest height of each square and its neighbours. Returns the numbers of squares
/// along x and y.
fn note_squares([rows, columns]: [usize; 2], stride: usize, heights: &mut Vec<f32>) -> [usize; 2] {
    let num = [rows.div_ceil(stride), columns.div_ceil(stride)];
    let mut own = vec![f32::MIN; num[0] * num[1]];
    for i in 0..rows {
        for j in 0..columns {
            let most = &mut own[i / stride * num[1] + j / stride];
            *most = most.max(heights[i * columns + j]);
        }
    }
    let around = |at: usize, count: usize| at.saturating_sub(1)..(at + 2).min(count);
    for i in 0..num[0] {
        for j in 0..num[1] {
            let squares = around(i, num[0]).flat_map(|i| around(j, num[1]).map(move |j| (i, j)));
            heights.push(squares.map(|(i, j)| own[i * num[1] + j]).fold(f32::MIN, f32::max));
        }
    }
    num
}
