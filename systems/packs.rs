//! The articulated engine: robots of a morphology are gathered into packs, stepped side by side, and scattered back to their components.
//!
//! Between step and scatter the pack holds the new states and the components still the old ones: that is where a state
//! that broke is noticed together with what it came from, see [`BrokenStates`](super::broken::BrokenStates).

use std::sync::{Arc, Mutex, PoisonError};

use super::bench::Bench;
use super::broken::Evidence;
use super::line_up::{BodyBits, LineUp};
use super::own_numbers::OwnNumbers;
use super::physics::{Engine, PhysicsRows};
use super::terminate::StateLimits;
use crate::dynamics::lanes::Lanes;
use crate::dynamics::{ControlStep, HeightGrid, Parameters, StepSettings, Terrain};
use crate::morphology::{Morphologies, MorphologyModel};
use crate::rows::{Pool, SplitRows, Workers};

/// Rows of one morphology, as many as a pack holds.
#[derive(Clone, Copy)]
struct PackRows {
    morphology: usize,
    /// The first one, among those of the morphology.
    first: usize,
    count: usize,
}

/// What the robots of a morphology keep from one control step to the next beyond their components.
struct Bodies<L> {
    first_env: usize,
    count: usize,
    nominal: Parameters<L>,
    own: OwnNumbers<L>,
    bits: BodyBits,
}

/// Where a thread steps packs.
struct Scratch<L> {
    /// Of each morphology.
    benches: Vec<Bench<L>>,
    line_up: LineUp,
}

/// All robots.
pub(super) struct Packs<L: Lanes> {
    settings: StepSettings,
    terrain: Option<Arc<HeightGrid>>,
    packs: Vec<PackRows>,
    /// Of each morphology.
    bodies: Vec<Bodies<L>>,
    /// Of each env, see [`BodyBits`]. They decide how fast a step is and nothing else.
    keys: Vec<u32>,
    scratch: Pool<Scratch<L>>,
}

impl<L: Lanes> Packs<L> {
    /// Robots of some morphologies, `counts[m]` of kind `m` in contiguous blocks.
    pub(super) fn new(
        settings: StepSettings,
        terrain: Option<Arc<HeightGrid>>,
        morphologies: &Morphologies,
        counts: &[usize],
        threads: usize,
    ) -> Self {
        let (mut packs, mut bodies) = (Vec::new(), Vec::new());
        let mut first_env = 0;
        for (morphology, (model, &count)) in morphologies.0.iter().zip(counts).enumerate() {
            let pack = |first| PackRows { morphology, first, count: L::LANES.min(count - first) };
            packs.extend((0..count).step_by(L::LANES).map(pack));
            let nominal = Parameters::from_scalars(&model.topology, &model.nominal);
            let (own, bits) = (OwnNumbers::none(), BodyBits::new(&model.body_groups));
            bodies.push(Bodies { first_env, count, nominal, own, bits });
            first_env += count;
        }
        let bench = |(model, of): (&MorphologyModel, &Bodies<L>)| Bench::new(model, &of.nominal, settings.decimation);
        let scratch = Pool::new(threads, || Scratch {
            benches: morphologies.0.iter().zip(&bodies).map(bench).collect(),
            line_up: LineUp::default(),
        });
        Self { settings, terrain, packs, bodies, keys: vec![0; first_env], scratch }
    }
}

impl<L: Lanes> Engine for Packs<L> {
    fn upload(&mut self, env: usize, parameters: &Parameters<f32>) {
        let morphology = self.bodies.partition_point(|of| of.first_env + of.count <= env);
        if let Some(Bodies { first_env, count, nominal, own, .. }) = self.bodies.get_mut(morphology) {
            own.set_row(env - *first_env, *count, parameters, nominal);
        }
    }

    fn step(
        &mut self,
        morphologies: &Morphologies,
        workers: &Workers,
        rows: PhysicsRows,
        limits: &StateLimits,
        watched: &[bool],
    ) -> Vec<Evidence> {
        let Self { settings, terrain, packs, bodies, keys, scratch } = self;
        let terrain = terrain.as_deref();
        let found = Mutex::new(Vec::new());
        let mut rest = Some((&packs[..], (rows, &mut keys[..])));
        let tasks = std::iter::from_fn(|| {
            let (packs, rows) = rest.take().filter(|(packs, _)| !packs.is_empty())?;
            let (packs, more_packs) = packs.split_at(workers.share(packs.len(), 1));
            let (rows, more) = rows.split_rows(packs.iter().map(|pack| pack.count).sum());
            rest = Some((more_packs, more));
            Some((packs, rows))
        });
        workers.for_each(tasks, |(packs, mut rows)| {
            scratch.with(|Scratch { benches, line_up }| {
                for packs in packs.chunk_by(|a, b| a.morphology == b.morphology) {
                    let (mine, more) = rows.split_rows(packs.iter().map(|pack| pack.count).sum());
                    rows = more;
                    let ((mut mine, keys), PackRows { morphology, first, .. }) = (mine, packs[0]);
                    let Bodies { first_env, own, bits, .. } = &bodies[morphology];
                    let bench = &mut benches[morphology];
                    // robots find their like among those of this task
                    let order = if own.may_mix() { line_up.sort(keys) } else { line_up.keep(keys.len()) };
                    for (pack, lanes) in order.chunks(L::LANES).enumerate() {
                        bench.gather(&mine, lanes);
                        // the next ones: where rows are not in the order of memory, the machine does not see them come
                        for &row in order.iter().skip((pack + 1) * L::LANES).take(L::LANES) {
                            mine.prefetch(row);
                        }
                        L::vectorize(ControlStep {
                            topology: &morphologies.0[morphology].topology,
                            settings,
                            terrain: terrain.map(|grid| Terrain { grid, origin: &bench.origin }),
                            parameters: own.of_pack(first, pack, lanes, &mut bench.nominal),
                            drive: &bench.drive,
                            state: &mut bench.state,
                            report: &mut bench.report,
                            work: &mut bench.work,
                        });
                        let broken = if watched[morphology] { bench.first_broken(limits, lanes) } else { None };
                        let first_env = first_env + first;
                        let evidence = Evidence::of_writing(broken, morphology, first_env, &mut mine, |rows| {
                            bench.scatter(rows, lanes);
                        });
                        for (lane, &row) in lanes.iter().enumerate() {
                            keys[row] = bits.key(&bench.report.near, lane);
                        }
                        if let Some(evidence) = evidence {
                            found.lock().unwrap_or_else(PoisonError::into_inner).push(evidence);
                        }
                    }
                }
            });
        });
        // of each morphology the first env, whatever the threads did first
        let mut found: Vec<Evidence> = found.into_inner().unwrap_or_else(PoisonError::into_inner);
        found.sort_unstable_by_key(|evidence| evidence.env);
        found.dedup_by_key(|evidence| evidence.morphology);
        found
    }
}
