//! Triangles, put together from rectangles and height fields, and their heights on a grid.

use avian3d::prelude::Collider;

use crate::dynamics::HeightGrid;

/// A surface of triangles.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// Corners of the triangles, m.
    pub vertices: Vec<[f32; 3]>,
    /// Vertices of each triangle; triangles that can be stood on are counterclockwise from above.
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// The triangles of a collider that consists of triangles.
    pub fn of_collider(collider: &Collider) -> Option<Self> {
        let surface = collider.shape().as_trimesh()?;
        Some(Self {
            vertices: surface.vertices().iter().map(|v| [v.x, v.y, v.z]).collect(),
            triangles: surface.indices().to_vec(),
        })
    }

    /// Four corners, counterclockwise from the front.
    fn quad(&mut self, corners: [[f64; 3]; 4]) {
        let first = self.vertices.len() as u32;
        self.vertices.extend(corners.map(|corner| corner.map(|x| x as f32)));
        self.triangles.extend([[first, first + 1, first + 2], [first, first + 2, first + 3]]);
    }

    /// A level rectangle.
    pub(crate) fn top(&mut self, [x0, x1]: [f64; 2], [y0, y1]: [f64; 2], z: f64) {
        self.quad([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]]);
    }

    /// The four walls of a rectangle, between two heights.
    pub(super) fn walls(&mut self, [x0, x1]: [f64; 2], [y0, y1]: [f64; 2], [low, high]: [f64; 2]) {
        for [[ax, ay], [bx, by]] in
            [[[x0, y0], [x1, y0]], [[x1, y0], [x1, y1]], [[x1, y1], [x0, y1]], [[x0, y1], [x0, y0]]]
        {
            self.quad([[ax, ay, low], [bx, by, low], [bx, by, high], [ax, ay, high]]);
        }
    }

    /// A level frame about the middle, between two rectangles of these half edge lengths.
    pub(super) fn frame(&mut self, outer: [f64; 2], inner: [f64; 2], z: f64) {
        let ([ox, oy], [ix, iy]) = (outer, inner);
        self.top([-ox, ox], [-oy, -iy], z);
        self.top([-ox, ox], [iy, oy], z);
        self.top([-ox, -ix], [-iy, iy], z);
        self.top([ix, ox], [-iy, iy], z);
    }

    /// Concentric level rectangles from the outermost to the platform in the middle, with the walls
    /// between them: half edge lengths, and the height within.
    pub(super) fn terraces(rings: &[([f64; 2], f64)]) -> Self {
        let mut mesh = Self::default();
        for pair in rings.windows(2) {
            let ((outer, here), (inner, next)) = (pair[0], pair[1]);
            if outer != inner {
                mesh.frame(outer, inner, here);
            }
            if here != next {
                mesh.walls([-inner[0], inner[0]], [-inner[1], inner[1]], [here.min(next), here.max(next)]);
            }
        }
        if let Some(([x, y], height)) = rings.last() {
            mesh.top([-x, *x], [-y, *y], *height);
        }
        mesh
    }

    /// A frame that rises evenly from its outer rectangle to its inner one.
    pub(super) fn slanted_frame(&mut self, outer: [f64; 2], inner: [f64; 2], [low, high]: [f64; 2]) {
        let corner = |[x, y]: [f64; 2], k: usize, z: f64| {
            let [sx, sy] = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]][k % 4];
            [sx * x, sy * y, z]
        };
        for k in 0..4 {
            self.quad([
                corner(outer, k, low),
                corner(outer, k + 1, low),
                corner(inner, k + 1, high),
                corner(inner, k, high),
            ]);
        }
    }

    /// A wall from an edge to height 0.
    pub(super) fn skirt(&mut self, [a, b]: [[f64; 3]; 2]) {
        self.quad([[a[0], a[1], 0.0], [b[0], b[1], 0.0], b, a]);
    }

    /// A level rectangle above a lower one: its top and its walls.
    pub(super) fn pillar(&mut self, x: [f64; 2], y: [f64; 2], [low, high]: [f64; 2]) {
        self.top(x, y, high);
        if low < high {
            self.walls(x, y, [low, high]);
        }
    }

    /// The faces of a convex body between two polygons of as many corners, counterclockwise from
    /// above, the upper one of which is a lid.
    pub(super) fn body(&mut self, lower: &[[f64; 3]], upper: &[[f64; 3]]) {
        let count = upper.len();
        for k in 0..count {
            let next = (k + 1) % count;
            self.quad([lower[k], lower[next], upper[next], upper[k]]);
        }
        let first = self.vertices.len() as u32;
        self.vertices.extend(upper.iter().map(|corner| corner.map(|x| x as f32)));
        self.triangles.extend((1..count as u32 - 1).map(|k| [first, first + k, first + k + 1]));
    }

    /// The sides of a pyramid above a polygon, counterclockwise from above.
    pub(super) fn pyramid(&mut self, lower: &[[f64; 3]], peak: [f64; 3]) {
        let (first, count) = (self.vertices.len() as u32, lower.len() as u32);
        self.vertices.extend(lower.iter().chain([&peak]).map(|corner| corner.map(|x| x as f32)));
        self.triangles.extend((0..count).map(|k| [first + k, first + (k + 1) % count, first + count]));
    }

    /// A height field: `vertices[i * columns + j]`, two triangles between four of them, cut from
    /// the first to the last corner as [`HeightGrid`] cuts its cells.
    pub(super) fn field(vertices: Vec<[f32; 3]>, columns: usize) -> Self {
        let rows = vertices.len() / columns;
        let corner = |i: usize, j: usize| (i * columns + j) as u32;
        let cells = (0..rows - 1).flat_map(|i| (0..columns - 1).map(move |j| (i, j)));
        let triangles = cells
            .flat_map(|(i, j)| {
                let [a, b, c, d] = [corner(i, j), corner(i + 1, j), corner(i + 1, j + 1), corner(i, j + 1)];
                [[a, b, c], [a, c, d]]
            })
            .collect();
        Self { vertices, triangles }
    }

    /// Adds a surface, moved by x and y.
    pub fn append(&mut self, other: &Self, [x, y]: [f32; 2]) {
        let first = self.vertices.len() as u32;
        self.vertices.extend(other.vertices.iter().map(|v| [v[0] + x, v[1] + y, v[2]]));
        self.triangles.extend(other.triangles.iter().map(|t| t.map(|v| first + v)));
    }

    /// Raises the points of a grid to this surface where it lies above them; `origin` is where the
    /// mesh is in the grid's world, m. Vertical faces raise nothing: the points at their foot
    /// belong to the upper edge.
    pub fn rasterise(&self, origin: [f32; 2], grid: &mut HeightGrid) {
        // points that lie on an edge but for rounding are inside, in cells
        const EDGE: f32 = 1e-3;
        let (first, cell) = (grid.origin, grid.cell);
        let cells = |v: u32| {
            let [x, y, z] = self.vertices[v as usize];
            [(origin[0] + x - first[0]) / cell, (origin[1] + y - first[1]) / cell, z]
        };
        for triangle in &self.triangles {
            let [a, b, c] = triangle.map(cells);
            let (ab, ac) = ([b[0] - a[0], b[1] - a[1]], [c[0] - a[0], c[1] - a[1]]);
            let area = ab[0] * ac[1] - ab[1] * ac[0];
            // a triangle thinner than an edge is a vertical face
            let longest = ab[0].hypot(ab[1]).max(ac[0].hypot(ac[1])).max((c[0] - b[0]).hypot(c[1] - b[1]));
            if area.abs() <= EDGE * longest {
                continue;
            }
            let span = |axis: usize| {
                let low = a[axis].min(b[axis]).min(c[axis]);
                let high = a[axis].max(b[axis]).max(c[axis]);
                let last = grid.size[axis] as f32 - 1.0;
                ((low - EDGE).ceil().max(0.0) as usize, (high + EDGE).floor().min(last))
            };
            let ((i0, i1), (j0, j1)) = (span(0), span(1));
            if i1 < 0.0 || j1 < 0.0 {
                continue;
            }
            // tolerance for points outside, as a share of the triangle
            let slack = EDGE * longest / area.abs();
            for i in i0..=i1 as usize {
                for j in j0..=j1 as usize {
                    let (x, y) = (i as f32 - a[0], j as f32 - a[1]);
                    let u = (x * ac[1] - y * ac[0]) / area;
                    let v = (ab[0] * y - ab[1] * x) / area;
                    if u < -slack || v < -slack || u + v > 1.0 + slack {
                        continue;
                    }
                    let (u, v) = (u.clamp(0.0, 1.0), v.clamp(0.0, 1.0));
                    let z = a[2] + u * (b[2] - a[2]) + v * (c[2] - a[2]);
                    if z > grid.height(i, j) {
                        grid.set_height(i, j, z);
                    }
                }
            }
        }
    }
}
