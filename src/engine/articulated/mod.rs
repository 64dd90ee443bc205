//! The articulated engine: robots of a morphology are gathered into packs, stepped side by side, and scattered back to their components.
//!
//! Between step and scatter the pack holds the new states and the components still the old ones: that is where a state
//! that broke is noticed together with what it came from, see [`DivergenceRecord`].

mod ordering;
mod parameter_deltas;
mod workspace;

use std::cmp::Reverse;
use std::sync::{Arc, Mutex, PoisonError};

use super::{DivergenceRecord, Engine, PhysicsRows, StateLimits};
use crate::dynamics::{ControlStep, HeightGrid, Kernels, Parameters, StepSettings, Terrain};
use crate::morphology::{Morphologies, MorphologyModel};
use crate::workers::{Pool, SplitRows, Workers};
use ordering::{DemandBits, PackOrder};
use parameter_deltas::ParameterDeltas;
use workspace::PackWorkspace;

/// Neighbouring rows of one morphology, which a thread steps pack by pack.
struct Task<'a> {
    morphology: usize,
    /// The first one, among those of the morphology.
    first: usize,
    rows: PhysicsRows<'a>,
    /// See [`Packs::keys`].
    keys: &'a mut [u32],
}

/// What the robots of a morphology keep from one control step to the next beyond their components.
struct Bodies<L> {
    first_env: usize,
    count: usize,
    nominal: Parameters<L>,
    /// Whether all bodies are [alike](Parameters::is_alike) the morphology's.
    alike: bool,
    own: ParameterDeltas<L>,
    bits: DemandBits,
}

/// Where a thread steps packs.
struct Scratch<L: Kernels> {
    /// Of each morphology.
    benches: Vec<PackWorkspace<L>>,
    pack_ordering: PackOrder,
}

/// All robots.
pub(crate) struct Packs<L: Kernels> {
    settings: StepSettings,
    terrain: Option<Arc<HeightGrid>>,
    /// Of each morphology.
    bodies: Vec<Bodies<L>>,
    /// Morphologies in the order in which their robots are stepped, see [`Packs::share_out`].
    order: Vec<usize>,
    /// Of each env, see [`DemandBits`]. They decide how fast a step is and nothing else.
    keys: Vec<u32>,
    scratch: Pool<Scratch<L>>,
}

impl<L: Kernels> Packs<L> {
    /// Robots of some morphologies, `counts[m]` of kind `m` in contiguous blocks.
    pub(crate) fn new(
        settings: StepSettings,
        terrain: Option<Arc<HeightGrid>>,
        morphologies: &Morphologies,
        counts: &[usize],
        threads: usize,
    ) -> Self {
        let (mut bodies, mut first_env) = (Vec::new(), 0);
        for (model, &count) in morphologies.0.iter().zip(counts) {
            let nominal = Parameters::from_scalars(&model.topology, &model.nominal);
            let (own, bits) =
                (ParameterDeltas::none(), DemandBits::new(&model.body_groups, model.topology.blocks().len()));
            bodies.push(Bodies { first_env, count, nominal, alike: true, own, bits });
            first_env += count;
        }
        let bench =
            |(model, of): (&MorphologyModel, &Bodies<L>)| PackWorkspace::new(model, &of.nominal, settings.decimation);
        let scratch = Pool::new(threads, || Scratch {
            benches: morphologies.0.iter().zip(&bodies).map(bench).collect(),
            pack_ordering: PackOrder::default(),
        });
        let mut order: Vec<usize> = (0..bodies.len()).collect();
        order.sort_by_key(|&morphology| Reverse(morphologies.0[morphology].topology.num_impulses()));
        Self { settings, terrain, bodies, order, keys: vec![0; first_env], scratch }
    }

    /// The tasks of a control step. The last ones are small, so that threads end together. Robots find their like among those of their
    /// task: the kinds that have the most places to touch something with come first.
    fn share_out<'a>(
        bodies: &[Bodies<L>],
        order: &[usize],
        workers: &Workers,
        rows: PhysicsRows<'a>,
        keys: &'a mut [u32],
    ) -> Vec<Task<'a>> {
        let mut rest = (rows, keys);
        let mut kinds = Vec::with_capacity(bodies.len());
        for of in bodies {
            let (mine, more) = rest.split_rows(of.count);
            kinds.push(Some(mine));
            rest = more;
        }
        let mut left: usize = bodies.iter().map(|of| of.count.div_ceil(L::LANES)).sum();
        let mut tasks = Vec::new();
        for &morphology in order {
            let (count, mut first) = (bodies[morphology].count, 0);
            let mut rest = kinds[morphology].take().filter(|_| count > 0);
            while let Some(kind) = rest {
                let packs = workers.share(left, 1).min((count - first).div_ceil(L::LANES));
                let n = (packs * L::LANES).min(count - first);
                let ((rows, keys), more) = kind.split_rows(n);
                tasks.push(Task { morphology, first, rows, keys });
                (left, first) = (left - packs, first + n);
                rest = Some(more).filter(|_| first < count);
            }
        }
        tasks
    }
}

impl<L: Kernels> Engine for Packs<L> {
    fn upload(&mut self, env: usize, parameters: &Parameters<f32>) {
        let morphology = self.bodies.partition_point(|of| of.first_env + of.count <= env);
        if let Some(Bodies { first_env, count, nominal, alike, own, .. }) = self.bodies.get_mut(morphology) {
            *alike &= parameters.is_alike(nominal);
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
    ) -> Vec<DivergenceRecord> {
        let Self { settings, terrain, bodies, order, keys, scratch } = self;
        let terrain = terrain.as_deref();
        let found = Mutex::new(Vec::new());
        let tasks = Self::share_out(bodies, order, workers, rows, keys);
        workers.for_each(tasks.into_iter(), |Task { morphology, first, mut rows, keys }| {
            scratch.with(|Scratch { benches, pack_ordering }| {
                let Bodies { first_env, alike, own, bits, .. } = &bodies[morphology];
                let MorphologyModel { topology, nominal, .. } = &morphologies.0[morphology];
                let bench = &mut benches[morphology];
                let order = if own.may_mix() { pack_ordering.sort(keys) } else { pack_ordering.keep(keys.len()) };
                for (pack, lanes) in order.chunks(L::LANES).enumerate() {
                    bench.gather(&rows, lanes);
                    // the next ones: where rows are not in the order of memory, the machine does not see them come
                    for &row in order.iter().skip((pack + 1) * L::LANES).take(L::LANES) {
                        rows.prefetch(row);
                    }
                    let step = ControlStep {
                        topology,
                        settings,
                        terrain: terrain.map(|grid| Terrain { grid, origin: &bench.origin }),
                        parameters: own.of_pack(first, pack, lanes, &mut bench.nominal),
                        kind: alike.then_some(nominal),
                        drive: &bench.drive,
                        state: &mut bench.state,
                        report: &mut bench.report,
                        work: &mut bench.work,
                    };
                    step.run();
                    let broken = if watched[morphology] { bench.first_broken(limits, lanes) } else { None };
                    let evidence =
                        DivergenceRecord::of_writing(broken, morphology, first_env + first, &mut rows, |rows| {
                            bench.scatter(rows, lanes);
                        });
                    for (lane, &row) in lanes.iter().enumerate() {
                        keys[row] = bits.key(&bench.report.demands, lane);
                    }
                    if let Some(evidence) = evidence {
                        found.lock().unwrap_or_else(PoisonError::into_inner).push(evidence);
                    }
                }
            });
        });
        // of each morphology the first env, whatever the threads did first
        let mut found: Vec<DivergenceRecord> = found.into_inner().unwrap_or_else(PoisonError::into_inner);
        found.sort_unstable_by_key(|evidence| evidence.env);
        found.dedup_by_key(|evidence| evidence.morphology);
        found
    }
}
