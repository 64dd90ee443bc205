//! The articulated engine: robots of a morphology are stepped side by side in packs.
//!
//! Robots that live in rows are gathered into packs before a step and scattered back after it. In
//! between the pack holds the new states and the rows still hold the old ones, so a state that
//! diverges is recorded with its predecessor, see [`DivergenceRecord`]. Resident robots stay in
//! their packs.

mod ordering;
mod parameter_deltas;
mod workspace;

use std::cmp::Reverse;
use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError};

use super::{DivergenceRecord, MorphologySetup, RobotRows, RowEngine, RowFamily, Run};
use crate::blocks::BlockList;
use crate::dynamics::lanes::Real;
use crate::dynamics::{
    ActuatorNetwork, ControlStep, HeightGrid, Kernels, NetworkStep, Parameters, StepSettings, Terrain, Topology,
};
use crate::workers::{Pool, SplitRows, Workers};
use ordering::{DemandBits, PackOrder};
use parameter_deltas::ParameterDeltas;
use workspace::{Pack, PackWorkspace};

/// Neighbouring rows of one morphology, which a thread steps pack by pack.
struct Task<'a, L: Real, R> {
    morphology: usize,
    /// First row of the task among those of the morphology.
    first: usize,
    rows: R,
    /// See [`Packs::keys`].
    keys: &'a mut [u32],
    resident: Resident<'a, L>,
}

/// Packs of resident robots; absent where robots live in rows. Tasks end where packs end.
struct Resident<'a, L: Real>(&'a mut [Pack<L>]);

impl<L: Real> SplitRows for Resident<'_, L> {
    fn split_rows(self, n: usize) -> (Self, Self) {
        let (first, rest) = self.0.split_at_mut(n.div_ceil(L::LANES).min(self.0.len()));
        (Self(first), Self(rest))
    }
}

/// The robots of a morphology, with the data that they keep between control steps beyond their
/// rows.
struct Bodies<L, T> {
    first_env: usize,
    /// Index of its first pack in [`Packs::resident`].
    first_pack: usize,
    count: usize,
    topology: Topology,
    networks: Vec<ActuatorNetwork>,
    nominal: Parameters<L>,
    /// The morphology's parameters, in one lane.
    shared: Parameters<f32>,
    /// Whether all bodies have the morphology's numbers, see [`Parameters::is_uniform_with`].
    uniform: bool,
    own: ParameterDeltas<L, T>,
    bits: DemandBits,
}

/// A thread's memory for stepping packs.
struct Scratch<L: Kernels> {
    /// Workspace of each morphology.
    workspaces: Vec<PackWorkspace<L>>,
    pack_ordering: PackOrder,
}

/// All robots, in rows of numbers `T`.
pub(crate) struct Packs<L: Kernels, T> {
    settings: StepSettings,
    terrain: Option<Arc<HeightGrid>>,
    /// Bodies of each morphology.
    bodies: Vec<Bodies<L, T>>,
    /// Morphologies in the order in which their robots are stepped, see [`Packs::share_out`].
    order: Vec<usize>,
    /// Sort key of each env, see [`DemandBits`]. Keys decide the speed of a step and nothing else.
    keys: Vec<u32>,
    /// Packs of all resident robots, morphology after morphology.
    resident: Vec<Pack<L>>,
    scratch: Pool<Scratch<L>>,
}

impl<L: Kernels, T: Real> Packs<L, T> {
    /// Robots of some morphologies, in contiguous blocks.
    pub(crate) fn new(
        settings: StepSettings,
        terrain: Option<Arc<HeightGrid>>,
        setups: &[MorphologySetup<T>],
        resident: bool,
        threads: usize,
    ) -> Self {
        let (mut bodies, mut first_env, mut packs) = (Vec::new(), 0, Vec::new());
        for setup in setups {
            let MorphologySetup { topology, nominal, body_groups, count, .. } = setup;
            bodies.push(Bodies {
                first_env,
                first_pack: packs.len(),
                count: *count,
                topology: (*topology).clone(),
                networks: setup.networks.to_vec(),
                nominal: Parameters::from_scalars(topology, nominal),
                shared: Parameters::from_scalars(topology, nominal),
                uniform: true,
                own: ParameterDeltas::none(),
                bits: DemandBits::new(body_groups, topology.blocks().len()),
            });
            first_env += count;
            if resident {
                packs.resize(packs.len() + count.div_ceil(L::LANES), Pack::new(setup, 1));
            }
        }
        let workspace = |(setup, of): (&MorphologySetup<T>, &Bodies<L, T>)| {
            PackWorkspace::new(setup, &of.nominal, settings.decimation)
        };
        let scratch = Pool::new(threads, || Scratch {
            workspaces: setups.iter().zip(&bodies).map(workspace).collect(),
            pack_ordering: PackOrder::default(),
        });
        let mut order: Vec<usize> = (0..bodies.len()).collect();
        order.sort_by_key(|&morphology| Reverse(bodies[morphology].topology.num_impulses()));
        Self { settings, terrain, bodies, order, keys: vec![0; first_env], resident: packs, scratch }
    }

    /// The pack of a resident robot, and its lanes: idle lanes shadow the last robot of a
    /// morphology.
    fn place(&self, env: usize) -> (usize, Range<usize>) {
        let morphology = self.bodies.partition_point(|of| of.first_env + of.count <= env);
        let Bodies { first_env, first_pack, count, .. } = &self.bodies[morphology];
        let (row, lane) = (env - first_env, (env - first_env) % L::LANES);
        (first_pack + row / L::LANES, lane..if row + 1 == *count { L::LANES } else { lane + 1 })
    }

    /// The tasks of a control step. The last ones are small, so that threads end together. Robots
    /// are sorted within a task: morphologies with many contact candidates are scheduled first.
    fn share_out<'a, R: RobotRows>(
        bodies: &[Bodies<L, T>],
        order: &[usize],
        workers: &Workers,
        blocks: BlockList<R>,
        keys: &'a mut [u32],
        resident: &'a mut [Pack<L>],
    ) -> Vec<Task<'a, L, R>> {
        let mut rest = (keys, Resident(resident));
        let mut kept = Vec::with_capacity(bodies.len());
        for of in bodies {
            let (mine, more) = rest.split_rows(of.count);
            kept.push(Some(mine));
            rest = more;
        }
        let mut of_blocks: Vec<_> = bodies.iter().map(|_| None).collect();
        for block in blocks {
            let morphology = usize::from(block.morphology.0);
            of_blocks[morphology] = kept[morphology].take().map(|(keys, resident)| (block.rows, keys, resident));
        }
        let stepped = bodies.iter().zip(&of_blocks).filter(|(_, block)| block.is_some());
        let mut left: usize = stepped.map(|(of, _)| of.count.div_ceil(L::LANES)).sum();
        let mut tasks = Vec::new();
        for &morphology in order {
            let (count, mut first) = (bodies[morphology].count, 0);
            let mut rest = of_blocks[morphology].take().filter(|_| count > 0);
            while let Some(robots) = rest {
                let packs = workers.share(left, 1).min((count - first).div_ceil(L::LANES));
                let n = (packs * L::LANES).min(count - first);
                let ((rows, keys, resident), more) = robots.split_rows(n);
                tasks.push(Task { morphology, first, rows, keys, resident });
                (left, first) = (left - packs, first + n);
                rest = Some(more).filter(|_| first < count);
            }
        }
        tasks
    }
}

impl<L: Kernels, F: RowFamily> RowEngine<F> for Packs<L, F::Number> {
    fn upload(&mut self, env: usize, parameters: &Parameters<F::Number>) {
        let morphology = self.bodies.partition_point(|of| of.first_env + of.count <= env);
        if let Some(Bodies { first_env, count, nominal, uniform, own, .. }) = self.bodies.get_mut(morphology) {
            *uniform = *uniform && parameters.is_uniform_with(nominal);
            own.set_row(env - *first_env, *count, parameters, nominal);
        }
    }

    fn set_explicit(&mut self, morphology: usize, explicit: &[bool]) {
        for (joint, &explicit) in self.bodies[morphology].topology.joints.iter_mut().zip(explicit) {
            joint.explicit = explicit;
        }
    }

    fn fetch(&self, env: usize, mut rows: F::Rows<'_>) {
        let (pack, lanes) = self.place(env);
        self.resident[pack].write_row(&mut rows, 0, lanes.start);
    }

    fn restart(&mut self, env: usize, rows: F::Rows<'_>) {
        let (pack, lanes) = self.place(env);
        self.resident[pack].restart(&rows, 0, lanes);
    }

    fn step(&mut self, workers: &Workers, blocks: BlockList<F::Rows<'_>>, run: Run) -> Vec<DivergenceRecord> {
        let Self { settings, terrain, bodies, order, keys, resident, scratch } = self;
        let terrain = terrain.as_deref();
        let found = Mutex::new(Vec::new());
        let tasks = Self::share_out(bodies, order, workers, blocks, keys, resident);
        workers.for_each(tasks.into_iter(), |Task { morphology, first, mut rows, keys, resident }| {
            scratch.with(|Scratch { workspaces, pack_ordering }| {
                let Bodies { first_env, topology, networks, shared, uniform, own, bits, .. } = &bodies[morphology];
                let PackWorkspace { nominal, without_gains, work, features, pack: gathered } =
                    &mut workspaces[morphology];
                let mix = !F::RESIDENT && own.may_mix();
                let order = if mix { pack_ordering.sort(keys) } else { pack_ordering.keep(keys.len()) };
                for (index, lanes) in order.chunks(L::LANES).enumerate() {
                    let pack = match resident.0.get_mut(index) {
                        Some(pack) => {
                            pack.gather_drive(&rows, lanes);
                            pack.make_room(run.steps.min(settings.decimation));
                            pack
                        }
                        None => {
                            gathered.gather(&rows, lanes);
                            // prefetch the next rows: the processor cannot guess them where rows
                            // are not in the order of memory
                            for &row in order.iter().skip((index + 1) * L::LANES).take(L::LANES) {
                                rows.prefetch(row);
                            }
                            &mut *gathered
                        }
                    };
                    let parameters = if run.gains {
                        own.of_pack(first, index, lanes, nominal)
                    } else {
                        own.of_pack_without_gains(first, index, lanes, without_gains)
                    };
                    let mut left = run.steps;
                    while left > 0 {
                        let decimation = left.min(settings.decimation);
                        let settings = &StepSettings { decimation, ..*settings };
                        // networks are evaluated before every physics step
                        let asks = !networks.is_empty() && run.gains;
                        let at_once = if asks { 1 } else { decimation };
                        for substep in (0..decimation).step_by(at_once) {
                            if asks {
                                let step = NetworkStep {
                                    topology,
                                    settings,
                                    networks,
                                    substep,
                                    state: &pack.state,
                                    drive: &mut pack.drive,
                                    memory: &mut pack.memory,
                                    features,
                                    work,
                                };
                                step.run();
                            }
                            let step = ControlStep {
                                topology,
                                settings,
                                terrain: terrain.map(|grid| Terrain { grid, origin: &pack.origin }),
                                parameters,
                                nominal: Some(shared).filter(|_| *uniform && run.gains),
                                drive: &pack.drive,
                                substeps: substep..substep + at_once,
                                state: &mut pack.state,
                                report: &mut pack.report,
                                work: &mut *work,
                            };
                            step.run();
                        }
                        left -= decimation;
                    }
                    pack.find_touching();
                    if F::RESIDENT {
                        continue;
                    }
                    let broken = if run.watched[morphology] { pack.first_broken(run.limits, lanes) } else { None };
                    let record = rows.record(broken, morphology, first_env + first, |rows| pack.scatter(rows, lanes));
                    for (&row, key) in lanes.iter().zip(bits.keys(&pack.report.demands)) {
                        keys[row] = key;
                    }
                    if let Some(record) = record {
                        found.lock().unwrap_or_else(PoisonError::into_inner).push(record);
                    }
                }
            });
        });
        // the first env of each morphology, in whatever order the threads found them
        let mut found: Vec<DivergenceRecord> = found.into_inner().unwrap_or_else(PoisonError::into_inner);
        found.sort_unstable_by_key(|record| record.env);
        found.dedup_by_key(|record| record.morphology);
        found
    }
}
