//! Cache of mesh hulls in this process: a robot is read several times on its way into a simulation.

use std::collections::HashMap;
use std::hash::{BuildHasher, RandomState};
use std::sync::{LazyLock, Mutex};

use glam::DVec3;

use super::hull;
use super::mesh;

/// Largest number of hulls that are kept. A hull has at most [`hull::MAX_POINTS`] points, so that
/// all together take a few MB.
const MOST: usize = 4096;

/// Hull that stands for a mesh.
#[derive(Clone, Debug)]
pub(super) struct Taken {
    /// See [`hull::Hull`].
    pub points: Vec<DVec3>,
    pub deviation: f64,
    pub boxed: bool,
    /// Number of vertices in the file.
    pub count: usize,
    /// Assumption about the file, for a warning.
    pub assumed: Option<String>,
}

/// A mesh by its contents. The keys of the hashes are drawn when the process starts, so that nobody
/// can make two files with one hash.
type Key = ([u64; 2], String, [u64; 3]);

#[derive(Default)]
struct Cache {
    hashers: [RandomState; 2],
    hulls: HashMap<Key, Taken>,
}

static CACHE: LazyLock<Mutex<Cache>> = LazyLock::new(Mutex::default);

/// The hull of the mesh file with these bytes. `ending` is the file's format, and nothing in the
/// mesh reaches farther than `most` m from its origin.
///
/// # Errors
/// Reason why the mesh cannot be read, as a clause.
pub(super) fn hull_of(bytes: Vec<u8>, ending: &str, scale: DVec3, most: f64) -> Result<Taken, String> {
    // the cache is intact even if a holder of the lock panicked
    let lock = || CACHE.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    let key: Key = {
        let hashers = lock().hashers.clone();
        (hashers.map(|hasher| hasher.hash_one(&bytes)), ending.to_string(), scale.to_array().map(f64::to_bits))
    };
    if let Some(known) = lock().hulls.get(&key) {
        return Ok(known.clone());
    }
    let mut vertices = mesh::read(bytes, ending)?;
    vertices.points.iter_mut().for_each(|point| *point *= scale);
    let farthest = vertices.points.iter().map(|point| point.abs().max_element()).fold(0.0, f64::max);
    if farthest.is_nan() || farthest > most {
        return Err(format!(
            "it reaches {farthest:.0} m from its origin; the <mesh> may lack scale=\"0.001 0.001 0.001\""
        ));
    }
    let hull::Hull { points, deviation, boxed } = hull::hull(&vertices.points);
    let taken = Taken { points, deviation, boxed, count: vertices.points.len(), assumed: vertices.assumed };
    let mut cache = lock();
    if cache.hulls.len() < MOST {
        cache.hulls.insert(key, taken.clone());
    }
    Ok(taken)
}
