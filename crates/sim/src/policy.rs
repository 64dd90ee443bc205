//! Policies as ONNX files, run by tract: no Python is needed.
//!
//! `polypod export` writes such a file and its manifest, `policy.onnx` and `policy.json`. The
//! network takes observations `[batch, num_obs]` and gives actions `[batch, num_actions]`, both in
//! the order of the task that it was trained on. A recurrent one also takes and gives states, which
//! are kept here.

use std::cell::Cell;
use std::collections::BTreeMap;
use std::fmt;
use std::panic::{self, AssertUnwindSafe};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Once};

use polypod::Sim;
use polypod::robot::Slot;
use serde::Deserialize;
use sha2::{Digest, Sha256};
use tract_onnx::prelude::*;

/// Largest network that is read, bytes: twice what `polypod export` writes for the largest one that
/// it accepts.
const MAX_NETWORK: u64 = 1 << 30;

/// Largest observation or action of a policy, equal to `polypod.runs.manifest.MAX_LAYER`.
const MAX_LAYER: usize = 65536;

/// Largest number of states of a network; an LSTM has two.
const MAX_STATES: usize = 8;

/// A policy could not be read, or does not fit a simulation.
#[derive(Debug, thiserror::Error)]
#[error("{}: {element}: {problem}; {remedy}", file.display())]
pub struct PolicyError {
    /// The policy or its manifest.
    pub file: PathBuf,
    /// Part of the file.
    pub element: String,
    /// Problem of the part.
    pub problem: String,
    /// Remedy.
    pub remedy: String,
}

/// Description of a policy by `polypod export`; the manifest holds more.
#[derive(Clone, Debug, Deserialize)]
pub struct PolicyManifest {
    /// Version of the manifest's layout; 1.
    pub format: u32,
    /// Kind of the exported graph: `policy`, or `robot` for one that is folded for a robot.
    pub kind: String,
    /// Name of the task that the policy was trained on.
    pub task: String,
    /// Changes of the policy to the task, `key=value`.
    #[serde(default)]
    pub overrides: Vec<String>,
    /// Robots that it was trained on: names, or paths of configs.
    pub robots: Vec<String>,
    /// Seconds between control steps.
    pub step_dt: f64,
    /// The action's slots.
    pub canonical_joint_names: Vec<String>,
    /// Terms of the observation, in order.
    pub observation_layout: Vec<TermLayout>,
    /// Length of an action.
    pub num_actions: usize,
    /// States of the network from one control step to the next.
    #[serde(default)]
    pub states: Vec<StateLayout>,
    /// SHA-256 of the export's graphs by their file names, hexadecimal.
    pub files: BTreeMap<String, String>,
}

/// A term of an observation.
#[derive(Clone, Debug, Deserialize, PartialEq, Eq)]
pub struct TermLayout {
    /// Name of the term in the task's config.
    pub term: String,
    /// Number of values of the term.
    pub size: usize,
}

/// A tensor that a recurrent network takes and gives back, zero when an episode begins.
#[derive(Clone, Debug, Deserialize, PartialEq, Eq)]
pub struct StateLayout {
    /// Name of the input.
    pub input: String,
    /// Name of the output that is fed back.
    pub output: String,
    /// Layers, envs (here 0) and units.
    pub shape: [usize; 3],
}

/// A network for a fixed number of envs.
pub struct Policy {
    /// Manifest of the graph.
    pub manifest: PolicyManifest,
    file: PathBuf,
    network: Arc<TypedRunnableModel>,
    num_envs: usize,
    /// States of the network, in the order of the manifest.
    memory: Vec<Tensor>,
}

impl fmt::Debug for Policy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Policy").field("file", &self.file).field("num_envs", &self.num_envs).finish_non_exhaustive()
    }
}

impl PolicyManifest {
    /// Reads the manifest next to a policy: the same name, ending in `.json`.
    ///
    /// # Errors
    /// It is missing or broken, or describes another kind of graph.
    pub fn beside(policy: &Path) -> Result<Self, PolicyError> {
        let file = policy.with_extension("json");
        let failure = |element: &str, problem: String, remedy: &str| PolicyError {
            file: file.clone(),
            element: element.into(),
            problem,
            remedy: remedy.into(),
        };
        let text = polypod::files::read_text(&file).map_err(|error| {
            failure("manifest", format!("cannot be read: {error}"), "keep a policy beside the manifest of its export")
        })?;
        Self::parse(&text, &file)
    }

    /// Reads the text of a manifest. Errors name `file`.
    ///
    /// # Errors
    /// It is broken, or describes another kind of graph.
    pub fn parse(text: &str, file: &Path) -> Result<Self, PolicyError> {
        let failure = |element: &str, problem: String, remedy: &str| PolicyError {
            file: file.to_path_buf(),
            element: element.into(),
            problem,
            remedy: remedy.into(),
        };
        let manifest: Self = serde_json::from_str(text).map_err(|error| {
            failure("manifest", format!("is not one of an export: {error}"), "export the policy again: polypod export")
        })?;
        if manifest.format != 1 {
            let problem = format!("is {}, not 1", manifest.format);
            return Err(failure("format", problem, "export the policy again with this version of polypod"));
        }
        if manifest.kind != "policy" {
            let problem = format!("is `{}`: the graph is folded for one robot and takes its sensors", manifest.kind);
            return Err(failure("kind", problem, "pass policy.onnx of the same export, which takes observations"));
        }
        for (element, size) in [("observation_layout", manifest.num_obs()), ("num_actions", manifest.num_actions)] {
            if !(1..=MAX_LAYER).contains(&size) {
                let problem = format!("{size} numbers, not 1 to {MAX_LAYER}");
                return Err(failure(element, problem, "copy the manifest again from its export"));
            }
        }
        let sizes = manifest.states.iter().flat_map(|state| [state.shape[0], state.shape[2]]);
        if manifest.states.len() > MAX_STATES || sizes.into_iter().any(|size| !(1..=MAX_LAYER).contains(&size)) {
            let problem = format!("{:?} are no states of a recurrent network", manifest.states);
            return Err(failure("states", problem, "copy the manifest again from its export"));
        }
        let slots: Option<Vec<Slot>> = manifest.canonical_joint_names.iter().map(|name| Slot::parse(name)).collect();
        let is_in_order = slots.is_some_and(|slots| slots.is_sorted_by(|a, b| a < b));
        if !is_in_order {
            let problem = "are in another order than this version's".to_string();
            return Err(failure("canonical_joint_names", problem, "export the policy again with this version"));
        }
        Ok(manifest)
    }

    /// Length of an observation.
    pub fn num_obs(&self) -> usize {
        self.observation_layout.iter().fold(0, |sum, term| sum.saturating_add(term.size))
    }
}

impl Policy {
    /// Reads `policy.onnx` and the manifest next to it, for batches of `num_envs`.
    ///
    /// # Errors
    /// A file is missing or broken, the graph is not the one that was exported with the manifest,
    /// or its inputs and outputs are not those of the manifest.
    pub fn load(file: &Path, num_envs: usize) -> Result<Self, PolicyError> {
        let manifest = PolicyManifest::beside(file)?;
        let graph = polypod::files::read_up_to(file, MAX_NETWORK).map_err(|error| PolicyError {
            file: file.to_path_buf(),
            element: "graph".into(),
            problem: format!("cannot be read: {error}"),
            remedy: "pass policy.onnx of an export".into(),
        })?;
        Self::from_bytes(manifest, &graph, file, num_envs)
    }

    /// Takes the bytes of a graph, for batches of `num_envs`. Errors name `file`.
    ///
    /// # Errors
    /// The graph is not the one that was exported with the manifest, or its inputs and outputs are
    /// not those of the manifest.
    pub fn from_bytes(
        manifest: PolicyManifest,
        mut graph: &[u8],
        file: &Path,
        num_envs: usize,
    ) -> Result<Self, PolicyError> {
        let failure = |problem: String| PolicyError {
            file: file.to_path_buf(),
            element: "graph".into(),
            problem,
            remedy: "export the policy again: polypod export".into(),
        };
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        match manifest.files.get(&*name) {
            Some(sum) if *sum == sha256(graph) => {}
            Some(_) => {
                return Err(failure("is damaged or of another export: its SHA-256 is not the manifest's".into()));
            }
            None => return Err(failure(format!("is not of this manifest, whose files have no {name}"))),
        }
        let network = quietly(|| compile(&mut graph, num_envs, &manifest))
            .map_err(|error| failure(format!("is not the network of the manifest: {error:#}")))?;
        let memory = manifest.states.iter().map(|state| zeros(state, num_envs)).collect();
        Ok(Self { manifest, file: file.to_path_buf(), network, num_envs, memory })
    }

    /// Forgets the past of the envs of the mask, `[num_envs]`; None: of all envs.
    ///
    /// # Errors
    /// A mask of another length.
    pub fn reset(&mut self, ends: Option<&[bool]>) -> Result<(), PolicyError> {
        let Some(ends) = ends else {
            self.memory = self.manifest.states.iter().map(|state| zeros(state, self.num_envs)).collect();
            return Ok(());
        };
        self.forget(ends).map_err(|error| self.failure(&error, format!("pass {} flags", self.num_envs)))
    }

    fn forget(&mut self, ends: &[bool]) -> TractResult<()> {
        if ends.len() != self.num_envs {
            return Err(TractError::msg(format!("{} flags", ends.len())));
        }
        for (state, memory) in self.manifest.states.iter().zip(&mut self.memory) {
            let [layers, _, units] = state.shape;
            let mut values = memory.try_as_plain_ram()?.as_slice::<f32>()?.to_vec();
            for (row, values) in values.chunks_exact_mut(units).enumerate() {
                if ends[row % self.num_envs] {
                    values.fill(0.0);
                }
            }
            *memory = Tensor::from_shape(&[layers, self.num_envs, units], &values)?;
        }
        Ok(())
    }

    fn failure(&self, error: &TractError, remedy: String) -> PolicyError {
        let problem = format!("cannot be run: {error:#}");
        PolicyError { file: self.file.clone(), element: "graph".into(), problem, remedy }
    }

    /// Checks that the simulation observes the policy's inputs.
    ///
    /// # Errors
    /// Terms, sizes or the control step differ.
    pub fn check(&self, sim: &Sim) -> Result<(), PolicyError> {
        let failure = |element: &str, problem: String| PolicyError {
            file: self.file.with_extension("json"),
            element: element.into(),
            problem,
            remedy: format!("run it in its own task, {}", self.manifest.task),
        };
        let task = sim.task();
        // the policy's group is the first one
        let terms = task.groups.first().map_or(&[][..], |group| task.terms_of(group));
        let layout: Vec<TermLayout> =
            terms.iter().map(|term| TermLayout { term: term.name.clone(), size: term.size }).collect();
        if layout != self.manifest.observation_layout {
            let names = |layout: &[TermLayout]| {
                layout.iter().map(|t| format!("{} ({})", t.term, t.size)).collect::<Vec<_>>().join(", ")
            };
            let problem = format!(
                "is {}, and {} observes {}",
                names(&self.manifest.observation_layout),
                task.config.name,
                names(&layout)
            );
            return Err(failure("observation_layout", problem));
        }
        let slots = sim.slots().joint_names();
        if slots != self.manifest.canonical_joint_names || slots.len() != self.manifest.num_actions {
            let problem = format!(
                "are {}, and the robots have {}",
                self.manifest.canonical_joint_names.join(", "),
                slots.join(", ")
            );
            return Err(failure("canonical_joint_names", problem));
        }
        let step_dt = task.config.sim.step_dt();
        if (step_dt - self.manifest.step_dt).abs() > 1e-9 {
            let problem =
                format!("is {} s, and a control step of {} {step_dt} s", self.manifest.step_dt, task.config.name);
            return Err(failure("step_dt", problem));
        }
        Ok(())
    }

    /// Actions, row-major `[num_envs, num_actions]`, for observations `[num_envs, num_obs]`. A
    /// recurrent network remembers them, see [`reset`](Self::reset).
    ///
    /// # Errors
    /// Another number of observations.
    pub fn act(&mut self, observations: &[f32]) -> Result<Vec<f32>, PolicyError> {
        self.run(observations).map_err(|error| {
            let remedy = format!("pass {} observations of {} numbers", self.num_envs, self.manifest.num_obs());
            self.failure(&error, remedy)
        })
    }

    fn run(&mut self, observations: &[f32]) -> TractResult<Vec<f32>> {
        let input = Tensor::from_shape(&[self.num_envs, self.manifest.num_obs()], observations)?;
        let inputs = std::iter::once(input).chain(self.memory.iter().cloned()).map(TValue::from).collect();
        let outputs = self.network.run(inputs)?;
        let (actions, after) = outputs.split_first().ok_or_else(|| TractError::msg("it gives nothing"))?;
        let actions = actions.try_as_plain_ram()?.as_slice::<f32>()?.to_vec();
        self.memory = after.iter().map(|state| state.clone().into_tensor()).collect();
        Ok(actions)
    }
}

/// Initial state of `num_envs` envs.
fn zeros(state: &StateLayout, num_envs: usize) -> Tensor {
    let [layers, _, units] = state.shape;
    Tensor::zero::<f32>(&[layers, num_envs, units]).unwrap_or_default()
}

/// SHA-256 in hexadecimal, as in manifests.
pub fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

thread_local! {
    /// Whether panics of this thread are silent.
    static QUIET: Cell<bool> = const { Cell::new(false) };
}

/// Turns a panic into an error and prints nothing. tract panics at graphs that lack what they name,
/// or whose tensors fit into no memory.
fn quietly<T>(f: impl FnOnce() -> TractResult<T>) -> TractResult<T> {
    static HOOK: Once = Once::new();
    HOOK.call_once(|| {
        let print = panic::take_hook();
        panic::set_hook(Box::new(move |info| {
            if !QUIET.get() {
                print(info);
            }
        }));
    });
    QUIET.set(true);
    let result = panic::catch_unwind(AssertUnwindSafe(f));
    QUIET.set(false);
    result.unwrap_or_else(|_| Err(TractError::msg("it cannot be read")))
}

fn compile(graph: &mut &[u8], num_envs: usize, manifest: &PolicyManifest) -> TractResult<Arc<TypedRunnableModel>> {
    let fact = f32::fact([num_envs, manifest.num_obs()]);
    // the graph's own shapes have a batch of any size, and are checked below
    let mut model = tract_onnx::onnx().with_ignore_output_shapes(true).model_for_read(graph)?;
    if (model.inputs.len(), model.outputs.len()) != (1 + manifest.states.len(), 1 + manifest.states.len()) {
        let (inputs, outputs) = (model.inputs.len(), model.outputs.len());
        let states = manifest.states.len();
        return Err(TractError::msg(format!("it has {inputs} inputs and {outputs} outputs for {states} states")));
    }
    model = model.with_input_fact(0, fact.into())?;
    for (i, state) in manifest.states.iter().enumerate() {
        let [layers, _, units] = state.shape;
        model = model.with_input_fact(1 + i, f32::fact([layers, num_envs, units]).into())?;
    }
    let model = model.into_optimized()?;
    if model.output_fact(0)?.shape.as_concrete() != Some(&[num_envs, manifest.num_actions][..]) {
        return Err(TractError::msg(format!("it does not give {} actions", manifest.num_actions)));
    }
    for (i, state) in manifest.states.iter().enumerate() {
        let [layers, _, units] = state.shape;
        if model.output_fact(1 + i)?.shape.as_concrete() != Some(&[layers, num_envs, units][..]) {
            return Err(TractError::msg(format!("it does not give {} back", state.input)));
        }
    }
    model.into_runnable()
}
