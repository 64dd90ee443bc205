//! Heights are kept in pages, looked up side by side, and are one surface.

use polypod::dynamics::HeightGrid;

/// A grid of several pages whose sizes are no multiples of a page, and its heights row by row.
fn waves(size: [usize; 2]) -> (HeightGrid, Vec<f32>) {
    let mut grid = HeightGrid::level([-1.0, 2.0], 0.05, size, 0.0);
    let mut heights = Vec::new();
    for i in 0..size[0] {
        for j in 0..size[1] {
            let height = ((7 * i + 3 * j) % 11) as f32 * 0.01 + i as f32 * 0.002;
            grid.set_height(i, j, height);
            heights.push(height);
        }
    }
    grid.note_squares();
    (grid, heights)
}

#[test]
fn pages_are_one_surface() {
    for size in [[2, 2], [3, 40], [32, 33], [34, 97], [70, 100]] {
        let (grid, heights) = waves(size);
        assert_eq!(grid.heights(), heights, "{size:?}");
        assert_eq!(grid.highest, heights.iter().copied().fold(f32::MIN, f32::max));
        // the corners of every cell, through the lookup, from both of its triangles
        for (k, &height) in heights.iter().enumerate() {
            let (i, j) = (k / size[1], k % size[1]);
            let [x, y] = [grid.origin[0] + i as f32 * grid.cell, grid.origin[1] + j as f32 * grid.cell];
            assert!((grid.sample(x, y).0 - height).abs() < 1e-4, "{size:?}: {i}, {j}");
        }
    }
}

#[test]
fn places_beyond_the_edge_and_without_a_number_have_heights() {
    let (grid, heights) = waves([70, 100]);
    let last = heights[69 * 100 + 99];
    assert_eq!(grid.sample(f32::NEG_INFINITY, -1e9).0, heights[0]);
    assert!((grid.sample(f32::INFINITY, 1e30).0 - last).abs() < 1e-5);
    assert_eq!(grid.sample(f32::NAN, f32::NAN).0, heights[0]);
}

#[test]
fn places_side_by_side_are_looked_up_as_one_by_one() {
    let (grid, _) = waves([70, 100]);
    let place = |k: usize| [-1.3 + 0.0517 * (k % 83) as f32, 1.8 + 0.0491 * (k % 127) as f32];
    for count in [1, 15, 16, 17, 64, 187] {
        let mut found = vec![0.0; count];
        grid.heights_at((0..count).map(place), &mut found);
        for (k, height) in found.iter().enumerate() {
            let [x, y] = place(k);
            assert_eq!(height.to_bits(), grid.sample(x, y).0.to_bits(), "place {k} of {count}");
        }
    }
}
