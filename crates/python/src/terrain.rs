//! A task's ground, for pictures and viewers.

use numpy::{PyArray1, PyArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use super::exceptions::{guarded, to_python};
use polypod::Error;
use polypod::config::{Library, TaskConfig};
use polypod::morphology::MorphologyModel;
use polypod::terrain::{Mesh, border, generate_in};
use polypod::world::{self, Ground};

#[doc = docstring!("terrain")]
#[pyfunction]
#[pyo3(signature = (task, overrides=Vec::new()))]
pub(super) fn terrain<'py>(py: Python<'py>, task: &str, overrides: Vec<String>) -> PyResult<Bound<'py, PyDict>> {
    let failed = |error: Error| to_python(py, error);
    let library = Library::new(Vec::new());
    let task = guarded(py, || library.task(task, &overrides))?;
    let config = task.map_err(|error| failed(error.into()))?.config;
    let ground = guarded(py, || world::load(&config, &legs(&library, &config)?))?.map_err(failed)?;
    entry(py, &config, &ground)?.ok_or_else(|| {
        failed(Error::Argument {
            element: "task",
            problem: format!("the ground of {} is a plane", config.name),
            remedy: "name a task with terrain or obstacles, such as velocity_rough".into(),
        })
    })
}

/// Leg lengths of a task's robots, m; empty where they scale no terrain.
fn legs(library: &Library, config: &TaskConfig) -> Result<Vec<f64>, Error> {
    if config.scene.terrain.as_ref().is_none_or(|terrain| terrain.scale_by.is_none()) {
        return Ok(Vec::new());
    }
    let robots = library.robots_in(&config.robots, config)?;
    robots.iter().map(|robot| Ok(MorphologyModel::new(robot)?.leg_length())).collect()
}

/// The heights, triangles and tiles of a task's ground; None for a plane.
pub(super) fn entry<'py>(
    py: Python<'py>,
    config: &TaskConfig,
    ground: &Ground,
) -> PyResult<Option<Bound<'py, PyDict>>> {
    let Some(grid) = &ground.terrain else {
        return Ok(None);
    };
    let dict = PyDict::new(py);
    dict.set_item("task", &config.name)?;
    dict.set_item("origin", grid.origin)?;
    dict.set_item("cell", grid.cell)?;
    dict.set_item("heights", PyArray1::from_vec(py, grid.heights()).reshape(grid.size)?)?;
    let (mut mesh, mut tiles) = (Mesh::default(), Vec::new());
    if let (Some(config), Some(layout)) = (&config.scene.terrain, &ground.layout) {
        mesh = border(config, layout);
        for tile in generate_in(config, layout) {
            mesh.append(&tile.mesh, tile.origin);
            let name = &layout.type_names[layout.column_types[tile.column as usize]];
            tiles.push((tile.row, tile.column, name.clone(), tile.origin));
        }
    }
    let rows = |count: usize| [count, 3];
    let (vertices, triangles) = (mesh.vertices.as_flattened().to_vec(), mesh.triangles.as_flattened().to_vec());
    dict.set_item("vertices", PyArray1::from_vec(py, vertices).reshape(rows(mesh.vertices.len()))?)?;
    dict.set_item("triangles", PyArray1::from_vec(py, triangles).reshape(rows(mesh.triangles.len()))?)?;
    dict.set_item("tiles", tiles)?;
    let pits = config.scene.pits().into_iter().map(|[low, high]| (low.into(), high.into()));
    dict.set_item("pits", pits.collect::<Vec<((f64, f64), (f64, f64))>>())?;
    Ok(Some(dict))
}
