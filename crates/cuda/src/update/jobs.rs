//! Arguments of the kernels of `device/learn.cu`: the structures there, field by field. Pointers
//! are addresses in the memory of the device.

use polypod_learner::{Line, WIDTH};

/// Threads of a block.
pub(super) const THREADS: usize = 128;
/// Rows and columns of a tile of a product.
pub(super) const TILE: usize = 64;
/// Numbers of rows are multiples of this.
pub(super) const DEPTH: usize = 8;
/// Numbers whose squares one block sums.
pub(super) const CHUNK: usize = 256 * WIDTH;
/// Figures of a part.
pub(super) const FIGURES: usize = 4;

/// Numbers that are copied to a device and back as bytes.
pub trait Plain: Copy + Default {}
impl Plain for f32 {}
impl Plain for f64 {}
impl Plain for i32 {}
impl Plain for u32 {}
impl Plain for Line {}
impl Plain for Part {}
impl<T: Plain> Plain for [T; 5] {}
impl Plain for [f64; WIDTH] {}

/// A structure of arguments, whose default is a job without blocks.
macro_rules! job {
    ($name:ident { $($field:ident: $type:ty),* $(,)? }) => {
        #[doc = concat!("`", stringify!($name), "` of `device/learn.cu`.")]
        #[derive(Clone, Copy, Debug, Default)]
        #[repr(C)]
        #[allow(missing_docs, reason = "the text of the device has them")]
        pub struct $name {
            $(pub $field: $type),*
        }
    };
}

job!(Part { first_row: i32, rows: i32, samples: i32, first_order: i32, first_sample: i32, first_env: i32, envs: i32 });
job!(Rows {
    part: u64,
    order: u64,
    robot_of: u64,
    sample: u64,
    robot: u64,
    blocks: i32,
    parts: i32,
    rows: i32,
    passes: i32,
    symmetry: i32,
    epoch: i32,
});
job!(Inputs {
    observations: u64,
    sample: u64,
    robot: u64,
    index: u64,
    sign: u64,
    columns: u64,
    mean: u64,
    inverse: u64,
    input: u64,
    blocks: i32,
    rows: i32,
    numbers: i32,
    inputs: i32,
    pitch: i32,
});
job!(Product {
    a: u64,
    weights: u64,
    y: u64,
    out: u64,
    blocks: i32,
    rows: i32,
    inner: i32,
    pitch_a: i32,
    pitch: i32,
    lines: i32,
    back: i32,
    activation: i32,
});
job!(Surrogate {
    output: u64,
    delta: u64,
    sample: u64,
    robot: u64,
    actions: u64,
    means: u64,
    log_probs: u64,
    advantages: u64,
    index: u64,
    sign: u64,
    inverse: u64,
    scalars: u64,
    terms: u64,
    loss: u64,
    divergence: u64,
    blocks: i32,
    rows: i32,
    numbers: i32,
    width: i32,
    clip: f32,
    weight: f32,
});
job!(Value {
    output: u64,
    delta: u64,
    sample: u64,
    returns: u64,
    values: u64,
    loss: u64,
    blocks: i32,
    rows: i32,
    is_clipped: i32,
    clip: f32,
    coefficient: f32,
    weight: f32,
});
job!(Chains {
    part: u64,
    robot: u64,
    terms: u64,
    surrogate: u64,
    value: u64,
    divergence: u64,
    start: u64,
    gradient: u64,
    figures: u64,
    part_numbers: i64,
    blocks: i32,
    passes: i32,
    width: i32,
});
job!(WeightGradient {
    input: u64,
    delta: u64,
    part: u64,
    gradient: u64,
    part_numbers: i64,
    blocks: i32,
    passes: i32,
    inner: i32,
    pitch_input: i32,
    pitch: i32,
});
job!(Total {
    gradients: u64,
    complete: u64,
    total: u64,
    squares: u64,
    part_numbers: i64,
    blocks: i32,
    parts: i32,
    numbers: i32,
});
job!(Step {
    weights: u64,
    first: u64,
    second: u64,
    gradient: u64,
    blocks: i32,
    numbers: i32,
    first_deviation: i32,
    end_deviation: i32,
    clip: f32,
    rate: f32,
    root: f32,
    keep: f32,
    keep_squares: f32,
    take: f32,
    take_squares: f32,
    epsilon: f32,
    lowest: f32,
    highest: f32,
});

/// A kernel with its arguments: those of the actor and the critic where both take part.
#[derive(Clone, Copy, Debug)]
pub enum Launch {
    /// Samples of the rows.
    Rows(Rows),
    /// Inputs of the networks.
    Inputs([Inputs; 2]),
    /// A layer, forward or back.
    Product([Product; 2]),
    /// The surrogate loss.
    Surrogate(Surrogate),
    /// The value loss.
    Value(Value),
    /// Sums over the samples of each part.
    Chains(Chains),
    /// The derivatives of a layer's weights.
    WeightGradient([WeightGradient; 2]),
    /// Sums over the parts.
    Total([Total; 2]),
    /// A step of Adam.
    Step([Step; 2]),
}

/// Names of the kernels, in the order of [`Launch`].
pub(super) const KERNELS: [&str; 9] = [
    "polypod_learn_rows",
    "polypod_learn_inputs",
    "polypod_learn_product",
    "polypod_learn_surrogate",
    "polypod_learn_value",
    "polypod_learn_chains",
    "polypod_learn_weights",
    "polypod_learn_total",
    "polypod_learn_step",
];

impl Launch {
    /// Number of the kernel in [`KERNELS`].
    pub(super) fn kernel(&self) -> usize {
        match self {
            Self::Rows(_) => 0,
            Self::Inputs(_) => 1,
            Self::Product(_) => 2,
            Self::Surrogate(_) => 3,
            Self::Value(_) => 4,
            Self::Chains(_) => 5,
            Self::WeightGradient(_) => 6,
            Self::Total(_) => 7,
            Self::Step(_) => 8,
        }
    }

    /// Blocks of the kernel, and the number of its jobs.
    pub(super) fn grid(&self) -> [i32; 2] {
        let of_two = |blocks: [i32; 2]| [blocks[0].max(blocks[1]), 2];
        match self {
            Self::Rows(job) => [job.blocks, 1],
            Self::Surrogate(job) => [job.blocks, 1],
            Self::Value(job) => [job.blocks, 1],
            Self::Chains(job) => [job.blocks, 1],
            Self::Inputs(jobs) => of_two(jobs.map(|job| job.blocks)),
            Self::Product(jobs) => of_two(jobs.map(|job| job.blocks)),
            Self::WeightGradient(jobs) => of_two(jobs.map(|job| job.blocks)),
            Self::Total(jobs) => of_two(jobs.map(|job| job.blocks)),
            Self::Step(jobs) => of_two(jobs.map(|job| job.blocks)),
        }
    }
}
