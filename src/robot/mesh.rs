//! Mesh files: vertices of STL (binary and ASCII), OBJ and COLLADA, triangles of STL and OBJ.

use std::collections::HashMap;
use std::io::{BufReader, Cursor};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::rc::Rc;

use glam::{DMat4, DVec3, DVec4};
use roxmltree::{Document, Node, NodeId};

use super::xml;
use crate::files;

/// Largest mesh file, bytes; larger files are no collision meshes.
const MAX_BYTES: u64 = 256 << 20;
/// Largest number of vertices of a mesh, instances included. A file of [`MAX_BYTES`] would hold
/// more, and a scene of instances any number.
const MAX_POINTS: usize = 4 << 20;
/// Largest number of elements of a COLLADA scene, instances of instances included; only a scene
/// that contains itself has more.
const MAX_ELEMENTS: usize = 1 << 20;
/// Header and triangle count of a binary STL, and each of its triangles, bytes.
const STL_HEADER: usize = 84;
const STL_TRIANGLE: usize = 50;

/// The vertices of a mesh in its file's own axes, m.
pub(super) struct Vertices {
    pub points: Vec<DVec3>,
    /// Assumption about the file, for a warning.
    pub assumed: Option<String>,
}

impl From<Vec<DVec3>> for Vertices {
    fn from(points: Vec<DVec3>) -> Self {
        Self { points, assumed: None }
    }
}

/// Reads the vertices of a mesh file with these bytes; `ending` is its format.
///
/// # Errors
/// Reason why the mesh cannot be read, as a clause.
pub(super) fn read(bytes: Vec<u8>, ending: &str) -> Result<Vertices, String> {
    // The readers are other projects' code: their panics must not end the simulator.
    let vertices = catch_unwind(AssertUnwindSafe(|| match ending {
        "stl" => stl(bytes).map(Vertices::from),
        "obj" => obj(&bytes).map(Vertices::from),
        "dae" => String::from_utf8(bytes).map_err(|error| error.to_string()).and_then(|text| collada(&text)),
        _ => Err(format!("\".{ending}\" is not read, only .stl, .obj and .dae")),
    }))
    .unwrap_or_else(|_| Err("its reader failed".to_string()))?;
    if vertices.points.is_empty() {
        return Err("it has no vertices".to_string());
    }
    check_finite(&vertices.points)?;
    Ok(vertices)
}

/// The triangles of a mesh in its file's own axes.
#[derive(Debug, Default)]
pub(crate) struct Surface {
    /// Corners, each once, m.
    pub(crate) vertices: Vec<[f64; 3]>,
    /// Places of their corners among the vertices.
    pub(crate) triangles: Vec<[u32; 3]>,
}

/// Reads the surface in the file at `path`, whose ending is its format.
///
/// # Errors
/// Reason why the mesh cannot be read, as a clause.
pub(crate) fn read_surface(path: &Path) -> Result<Surface, String> {
    let (bytes, ending) = contents(path)?;
    let corners = catch_unwind(AssertUnwindSafe(|| match ending.as_str() {
        "stl" => stl(bytes),
        "obj" => obj_triangles(&bytes),
        _ => Err(format!("triangles of \".{ending}\" are not read, only of .stl and .obj")),
    }))
    .unwrap_or_else(|_| Err("its reader failed".to_string()))?;
    check_finite(&corners)?;
    let mut surface = Surface::default();
    let mut places: HashMap<[u64; 3], u32> = HashMap::new();
    for triangle in corners.chunks_exact(3) {
        surface.triangles.push([0, 1, 2].map(|i| {
            // zero has two signs
            let corner = triangle[i].to_array().map(|x| x + 0.0);
            *places.entry(corner.map(f64::to_bits)).or_insert_with(|| {
                surface.vertices.push(corner);
                (surface.vertices.len() - 1) as u32
            })
        }));
    }
    if surface.triangles.is_empty() { Err("it has no triangles".to_string()) } else { Ok(surface) }
}

/// Content of a file, and its ending in small letters.
///
/// # Errors
/// Reason why the mesh cannot be read, as a clause.
pub(super) fn contents(path: &Path) -> Result<(Vec<u8>, String), String> {
    let bytes = files::read_up_to(path, MAX_BYTES).map_err(|error| error.to_string())?;
    let ending = path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_lowercase();
    Ok((bytes, ending))
}

fn check_finite(points: &[DVec3]) -> Result<(), String> {
    match points.iter().find(|point| !point.is_finite()) {
        Some(point) => Err(format!("it has a vertex at {point}")),
        None => Ok(()),
    }
}

fn stl(mut bytes: Vec<u8>) -> Result<Vec<DVec3>, String> {
    let triangles = match bytes.get(STL_HEADER - 4..STL_HEADER) {
        Some(&[a, b, c, d]) => u32::from_le_bytes([a, b, c, d]) as usize,
        _ => 0,
    };
    let binary = triangles > 0 && bytes.len() >= STL_HEADER + STL_TRIANGLE * triangles;
    if binary {
        check_count(3 * triangles)?;
        // The free text of a binary header may begin like an ASCII file.
        bytes[..5].fill(0);
        return stl_triangles(&bytes);
    }
    let text = std::str::from_utf8(&bytes).map_err(|_| "it is cut short, or no STL file")?;
    let mut points = Vec::new();
    let mut solid = String::new();
    for line in text.lines() {
        // The reader wants a space there, also without a name, and reads one solid only.
        let line = line.trim();
        solid.push_str(if line == "solid" { "solid " } else { line });
        solid.push('\n');
        if line.starts_with("endsolid") {
            points.extend(stl_triangles(std::mem::take(&mut solid).as_bytes())?);
            check_count(points.len())?;
        }
    }
    if solid.trim().is_empty() { Ok(points) } else { Err("it is cut short, or no STL file".to_string()) }
}

fn stl_triangles(bytes: &[u8]) -> Result<Vec<DVec3>, String> {
    let mut points = Vec::new();
    for triangle in stl_io::create_stl_reader(&mut Cursor::new(bytes)).map_err(|error| error.to_string())? {
        let corners = triangle.map_err(|error| error.to_string())?.vertices;
        points.extend(corners.map(|corner| DVec3::from_array(corner.0.map(f64::from))));
    }
    Ok(points)
}

/// Refuses a mesh with too many vertices.
fn check_count(points: usize) -> Result<(), String> {
    if points <= MAX_POINTS {
        return Ok(());
    }
    Err(format!("it has more than {MAX_POINTS} vertices, faces and instances counted with theirs"))
}

/// Refuses a file before its reader takes memory: a corner of a face takes two bytes in the file
/// and a hundred when read.
fn check_obj(bytes: &[u8]) -> Result<(), String> {
    let (mut vertices, mut corners) = (0, 0);
    for line in bytes.split(|byte| *byte == b'\n') {
        let mut words = line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        match words.next() {
            Some(b"v") => vertices += 1,
            // a fan of triangles
            Some(b"f" | b"l" | b"p") => corners += 3 * words.count().saturating_sub(2).max(1),
            _ => {}
        }
        check_count(vertices)?;
        check_count(corners)?;
    }
    Ok(())
}

fn obj_models(bytes: &[u8], options: &tobj::LoadOptions) -> Result<Vec<tobj::Model>, String> {
    check_obj(bytes)?;
    let no_materials = |_: &Path| Ok(Default::default());
    let (models, _) =
        tobj::load_obj_buf(&mut BufReader::new(bytes), options, no_materials).map_err(|error| error.to_string())?;
    Ok(models)
}

/// The corners of all triangles, three by three.
fn obj_triangles(bytes: &[u8]) -> Result<Vec<DVec3>, String> {
    let options =
        tobj::LoadOptions { triangulate: true, ignore_points: true, ignore_lines: true, ..Default::default() };
    let mut corners = Vec::new();
    for model in obj_models(bytes, &options)? {
        let mesh = model.mesh;
        let corner = |i: u32| {
            let at = mesh.positions.get(3 * i as usize..3 * i as usize + 3);
            at.map(|p| DVec3::new(p[0].into(), p[1].into(), p[2].into()))
        };
        let all: Option<Vec<DVec3>> = mesh.indices.iter().map(|&i| corner(i)).collect();
        corners.extend(all.ok_or("a face of it names a vertex that is not there")?);
    }
    Ok(corners)
}

fn obj(bytes: &[u8]) -> Result<Vec<DVec3>, String> {
    let models = obj_models(bytes, &tobj::LoadOptions::default())?;
    let positions = models.iter().flat_map(|model| model.mesh.positions.chunks_exact(3));
    Ok(positions.map(|p| DVec3::new(p[0].into(), p[1].into(), p[2].into())).collect())
}

fn collada(text: &str) -> Result<Vertices, String> {
    let document = xml::parse(text).map_err(|fault| format!("line {}: {}", fault.line, fault.problem))?;
    let root = document.root_element();
    if root.tag_name().name() != "COLLADA" {
        return Err("its root element is not <COLLADA>".to_string());
    }
    let asset = child(root, "asset");
    let unit = match asset.and_then(|asset| child(asset, "unit")?.attribute("meter")) {
        None => 1.0,
        Some(text) => match text.trim().parse::<f64>() {
            Ok(unit) if unit.is_finite() && unit > 0.0 => unit,
            _ => return Err(format!("its <unit meter=\"{text}\"> is no length")),
        },
    };
    let up = asset.and_then(|asset| child(asset, "up_axis")?.text()).map(str::trim);
    let by_id = document.descendants().filter_map(|node| Some((node.attribute("id")?, node))).collect();
    let mut scene = Scene { by_id, geometries: HashMap::new(), sources: HashMap::new(), count: 0 };
    let mut points = scene.points(&document)?;
    points.iter_mut().for_each(|point| *point *= unit);
    Ok(Vertices {
        points,
        assumed: up.filter(|up| *up != "Z_UP").map(|up| format!("its up_axis {up} is not applied, as in ROS")),
    })
}

fn child<'a, 'd>(node: Node<'a, 'd>, tag: &str) -> Option<Node<'a, 'd>> {
    node.children().find(|child| child.tag_name().name() == tag)
}

/// The numbers in an element, of which there may be `most`.
fn numbers(node: Node<'_, '_>, most: usize) -> Result<Vec<f64>, String> {
    let name = || node.tag_name().name();
    let mut numbers = Vec::new();
    for word in node.text().unwrap_or_default().split_whitespace() {
        if numbers.len() == most {
            return Err(format!("<{}> holds more than {most} numbers", name()));
        }
        numbers.push(word.parse().map_err(|_| format!("<{}> holds something that is no number", name()))?);
    }
    Ok(numbers)
}

struct Scene<'a, 'd> {
    by_id: HashMap<&'a str, Node<'a, 'd>>,
    /// Vertices of the geometries and controllers that were read, and of their sources.
    geometries: HashMap<NodeId, Rc<Vec<DVec3>>>,
    sources: HashMap<NodeId, Rc<Vec<DVec3>>>,
    /// Number of vertices in `sources`.
    count: usize,
}

impl<'a, 'd> Scene<'a, 'd> {
    /// All vertices where the scene puts them; where it is empty, those of all geometries.
    fn points(&mut self, document: &'a Document<'d>) -> Result<Vec<DVec3>, String> {
        let scene = document
            .descendants()
            .find(|node| node.tag_name().name() == "instance_visual_scene")
            .and_then(|instance| self.target(instance).ok())
            .or_else(|| document.descendants().find(|node| node.tag_name().name() == "visual_scene"));
        let mut points = Vec::new();
        let mut stack: Vec<(Node<'a, 'd>, DMat4)> = scene.map(|scene| (scene, DMat4::IDENTITY)).into_iter().collect();
        let mut visited = 0;
        while let Some((node, mut pose)) = stack.pop() {
            for element in node.children() {
                visited += 1;
                if visited > MAX_ELEMENTS {
                    return Err("its scene has too many nodes, or contains itself".to_string());
                }
                match element.tag_name().name() {
                    "matrix" | "translate" | "rotate" | "scale" | "lookat" | "skew" => pose *= transform(element)?,
                    "node" => stack.push((element, pose)),
                    "instance_node" => stack.push((self.target(element)?, pose)),
                    "instance_geometry" | "instance_controller" => {
                        let local = self.positions(self.target(element)?)?;
                        // checked before memory is taken for them
                        check_count(points.len() + local.len())?;
                        points.extend(local.iter().map(|point| pose.transform_point3(*point)));
                    }
                    _ => {}
                }
            }
        }
        if points.is_empty() {
            for geometry in document.descendants().filter(|node| node.tag_name().name() == "geometry") {
                let local = self.positions(geometry)?;
                check_count(points.len() + local.len())?;
                points.extend(local.iter());
            }
        }
        Ok(points)
    }

    /// Element that the `url` or `source` of `node` names.
    fn target(&self, node: Node<'a, 'd>) -> Result<Node<'a, 'd>, String> {
        let name = node.attribute("url").or_else(|| node.attribute("source")).unwrap_or_default();
        let target = name.strip_prefix('#').and_then(|id| self.by_id.get(id));
        target.copied().ok_or_else(|| format!("<{}> names \"{name}\", which is not there", node.tag_name().name()))
    }

    /// The vertex positions of a `<geometry>`, or of the one that a `<controller>` deforms; read
    /// once, however many instances there are.
    fn positions(&mut self, instantiated: Node<'a, 'd>) -> Result<Rc<Vec<DVec3>>, String> {
        if let Some(known) = self.geometries.get(&instantiated.id()) {
            return Ok(known.clone());
        }
        let geometry = match child(instantiated, "skin") {
            Some(skin) => self.target(skin)?,
            None => instantiated,
        };
        let read = match self.geometries.get(&geometry.id()) {
            Some(known) => known.clone(),
            None => self.of_geometry(geometry)?,
        };
        for node in [geometry, instantiated] {
            self.geometries.insert(node.id(), read.clone());
        }
        Ok(read)
    }

    fn of_geometry(&mut self, geometry: Node<'a, 'd>) -> Result<Rc<Vec<DVec3>>, String> {
        let vertices = child(geometry, "mesh").and_then(|mesh| child(mesh, "vertices"));
        let input = vertices.and_then(|v| v.children().find(|n| n.attribute("semantic") == Some("POSITION")));
        // splines and the like
        let Some(input) = input else {
            return Ok(Rc::default());
        };
        let source = self.target(input)?;
        if let Some(known) = self.sources.get(&source.id()) {
            return Ok(known.clone());
        }
        let array = child(source, "float_array").ok_or("a <source> of positions lacks <float_array>")?;
        let accessor = child(source, "technique_common").and_then(|technique| child(technique, "accessor"));
        let count = |name: &str, default: usize| match accessor.and_then(|accessor| accessor.attribute(name)) {
            None => Ok(default),
            Some(text) => text.parse().map_err(|_| format!("<accessor {name}=\"{text}\"> is no count")),
        };
        let (offset, stride) = (count("offset", 0)?, count("stride", 3)?);
        if stride < 3 {
            return Err(format!("<accessor stride=\"{stride}\"> leaves no three coordinates"));
        }
        let numbers = numbers(array, 3 * MAX_POINTS)?;
        let of_vertices = numbers.get(offset..).unwrap_or_default();
        let read: Vec<DVec3> =
            of_vertices.chunks(stride).filter_map(|c| Some(DVec3::from_slice(c.get(..3)?))).collect();
        self.count += read.len();
        check_count(self.count)?;
        let read = Rc::new(read);
        self.sources.insert(source.id(), read.clone());
        Ok(read)
    }
}

/// The matrix of a transformation element.
fn transform(element: Node<'_, '_>) -> Result<DMat4, String> {
    let values = numbers(element, 16)?;
    match (element.tag_name().name(), &values[..]) {
        // written row by row
        ("matrix", values) if values.len() == 16 => {
            let row = |i: usize| DVec4::from_slice(&values[4 * i..]);
            Ok(DMat4::from_cols(row(0), row(1), row(2), row(3)).transpose())
        }
        ("translate", &[x, y, z]) => Ok(DMat4::from_translation(DVec3::new(x, y, z))),
        ("scale", &[x, y, z]) => Ok(DMat4::from_scale(DVec3::new(x, y, z))),
        ("rotate", &[x, y, z, degrees]) => {
            let axis = DVec3::new(x, y, z).try_normalize().ok_or("<rotate> has no axis")?;
            Ok(DMat4::from_axis_angle(axis, degrees.to_radians()))
        }
        (tag, values) => Err(format!("<{tag}> with {} numbers is not read", values.len())),
    }
}
