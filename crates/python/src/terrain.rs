//! A task's ground, for pictures and viewers.

use numpy::{PyArray1, PyArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use super::exceptions::{guarded, to_python};
use polypod::components::{EnvId, EnvOrigin};
use polypod::config::{Library, TaskConfig};
use polypod::morphology::MorphologyModel;
use polypod::terrain::{Mesh, border, generate_in};
use polypod::world::{self, Ground};
use polypod::{Error, Sim};

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

/// The origin of each env on the ground, m, `[num_envs, 3]`.
pub(super) fn origins(sim: &mut Sim) -> Vec<f64> {
    let ground = sim.world().resource::<Ground>().clone();
    let mut rows = vec![0.0; 3 * sim.num_envs()];
    let world = sim.world_mut();
    for (env, origin) in world.query::<(&EnvId, &EnvOrigin)>().iter(world) {
        let mut height = [0.0];
        ground.heights_at(origin, std::iter::once([0.0, 0.0]), &mut height);
        let [x, y] = origin.position;
        let first = 3 * env.0 as usize;
        rows[first..first + 3].copy_from_slice(&[x, y, height[0]].map(f64::from));
    }
    rows
}

/// Level and type of each env's tile; no types on ground without tiles.
pub(super) fn tiles(sim: &mut Sim) -> (Vec<i64>, Vec<String>) {
    let (mut levels, mut names) = (vec![0; sim.num_envs()], Vec::new());
    let layout = sim.world().resource::<Ground>().layout.clone();
    if let Some(layout) = layout {
        names = vec![String::new(); sim.num_envs()];
        let world = sim.world_mut();
        for (env, origin) in world.query::<(&EnvId, &EnvOrigin)>().iter(world) {
            levels[env.0 as usize] = i64::from(origin.terrain_level);
            let kind = layout.column_types[origin.terrain_column as usize];
            names[env.0 as usize].clone_from(&layout.type_names[kind]);
        }
    }
    (levels, names)
}
