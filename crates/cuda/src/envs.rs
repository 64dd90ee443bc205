//! Envs around the robots of a block: the tables of their task, and the columns and rows in which
//! the device has them.

use std::fmt;
use std::ops::Range;
use std::sync::Arc;

use crate::device::DeviceError;
use crate::layout::*;

/// Control steps whose outcome the host may not have read yet.
pub const SLOTS: usize = 4;
/// Numbers of which a multiple lies in front of each array of [`RowSizes`]: 256 bytes.
const ALIGNMENT: usize = 64;

/// Bits of an env's flags.
pub mod flags {
    use crate::layout;

    macro_rules! bits {
        ($($(#[$doc:meta])* $name:ident,)*) => {
            $($(#[$doc])* pub const $name: u32 = layout::$name as u32;)*
        };
    }

    bits! {
        /// The episode failed in the present control step.
        TERMINATED,
        /// The episode ran out of time in the present control step.
        TRUNCATED,
        /// The env must be reset before it goes on.
        NEEDS_RESET,
        /// The state is broken.
        INVALID,
        /// The logs have counted the episode; in the flags of a control step: they count it now.
        LOGGED,
        /// The episode has just begun.
        FRESH,
        /// No action has been taken since the reset.
        FRESH_TARGETS,
        /// The yaw rate follows the heading.
        HOLDS_HEADING,
        /// The robot shall stand.
        STANDING,
        /// A caller has set the command.
        PINNED,
        /// The physics of the control step broke the state of a robot whose steps are checked.
        BROKEN,
        /// There is a last observation of an episode that ended in the control step.
        HAS_FINAL,
        /// An action of the control step is not finite or beyond the limit.
        BAD_ACTION,
    }
}

/// Sorts of terms.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum FormKind {
    /// Events that happen again and again.
    Interval,
    /// Events of a reset.
    Reset,
    /// Ends of episodes.
    End,
    /// Rewards.
    Reward,
    /// Observations.
    Observation,
    /// Curricula.
    Curriculum,
    /// Events that change the body at a reset.
    BodyEvent,
    /// Commands other than the velocity.
    Command,
}

impl FormKind {
    /// All sorts.
    pub const ALL: [Self; 8] = [
        Self::Interval,
        Self::Reset,
        Self::End,
        Self::Reward,
        Self::Observation,
        Self::Curriculum,
        Self::BodyEvent,
        Self::Command,
    ];

    /// The prefix of their names in `device/tables.h`, and the names.
    fn places(self) -> (&'static str, &'static [(&'static str, usize)]) {
        match self {
            Self::Interval => ("INTERVAL", INTERVAL_PLACES),
            Self::Reset => ("RESET", RESET_PLACES),
            Self::End => ("END", END_PLACES),
            Self::Reward => ("REWARD", REWARD_PLACES),
            Self::Observation => ("OBSERVATION", OBSERVATION_PLACES),
            Self::Curriculum => ("CURRICULUM", CURRICULUM_PLACES),
            Self::BodyEvent => ("BODY_EVENT", BODYEVENT_PLACES),
            Self::Command => ("KIND", COMMANDKIND_PLACES),
        }
    }

    /// Number of terms that have a form.
    pub fn count(self) -> usize {
        self.places().1.len()
    }
}

/// A term with its parameters in the device's form.
#[derive(Clone, Debug, PartialEq)]
pub struct Form {
    term: usize,
    numbers: Vec<f32>,
    integers: Option<Vec<i32>>,
}

impl Form {
    /// The form of a term in `device/env.h`, if there is one. The numbers and integers are those
    /// that the text reads; without integers a term is about all joints.
    pub fn new(kind: FormKind, name: &str, numbers: Vec<f32>, integers: Option<Vec<i32>>) -> Option<Self> {
        let (prefix, places) = kind.places();
        let wanted = format!("{prefix}_{}", name.to_uppercase());
        let term = places.iter().find(|(known, _)| *known == wanted)?.1;
        Some(Self { term, numbers, integers })
    }

    /// The same with more in front: numbers and integers that the task knows, and the term does
    /// not.
    #[must_use]
    pub fn after(mut self, numbers: &[f32], integers: &[i32]) -> Self {
        self.numbers.splice(0..0, numbers.iter().copied());
        self.integers.get_or_insert_default().splice(0..0, integers.iter().copied());
        self
    }
}

/// Effect of a drawn number on the value of a joint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DrawForm {
    /// It is added.
    Add,
    /// It is a factor.
    Scale,
    /// It replaces the value.
    Abs,
    /// It times the joint's largest effort is added.
    AddEffortShare,
}

impl DrawForm {
    /// The number that the text has for it.
    pub fn code(self) -> i32 {
        whole(match self {
            Self::Add => OPERATION_ADD,
            Self::Scale => OPERATION_SCALE,
            Self::Abs => OPERATION_ABS,
            Self::AddEffortShare => OPERATION_ADD_EFFORT_SHARE,
        })
    }
}

/// Rule that combines the friction of ground and robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CombineForm {
    /// Mean.
    Average,
    /// Root of the product.
    GeometricMean,
    /// Smaller one.
    Min,
    /// Product.
    Multiply,
    /// Larger one.
    Max,
}

/// A list of a body's joints that events at resets change.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BodyList {
    /// Stiffness.
    Stiffness,
    /// Damping.
    Damping,
    /// Limit of the effort.
    EffortLimit,
    /// Effort at which a motor saturates.
    SaturationEffort,
    /// Rotor inertia.
    Armature,
    /// Dry friction.
    JointFriction,
    /// Viscous friction.
    JointDamping,
}

impl BodyList {
    /// All lists, in the order in which [`Column::Body`] has them behind [`BODY_NUMBERS`] numbers.
    pub const ALL: [Self; BODY_LISTS] = [
        Self::Stiffness,
        Self::Damping,
        Self::EffortLimit,
        Self::SaturationEffort,
        Self::Armature,
        Self::JointFriction,
        Self::JointDamping,
    ];

    /// The number that the text has for it, and its column of parameters.
    fn places(self) -> [usize; 2] {
        match self {
            Self::Stiffness => [LIST_STIFFNESS, P_STIFFNESS],
            Self::Damping => [LIST_DAMPING, P_DAMPING],
            Self::EffortLimit => [LIST_EFFORT_LIMIT, P_EFFORT_LIMIT],
            Self::SaturationEffort => [LIST_SATURATION_EFFORT, P_SATURATION_EFFORT],
            Self::Armature => [LIST_ARMATURE, P_ARMATURE],
            Self::JointFriction => [LIST_JOINT_FRICTION, P_JOINT_FRICTION],
            Self::JointDamping => [LIST_JOINT_DAMPING, P_JOINT_DAMPING],
        }
    }

    /// The number that the text has for it.
    pub fn code(self) -> i32 {
        whole(self.places()[0])
    }
}

/// Numbers of a body that events at resets change, before the lists of its joints: mass, centre of
/// mass and inertia of the base, static, dynamic, torsional and rolling friction.
pub const BODY_NUMBERS: usize = BODY_JOINTS;

/// Columns of parameters that have these numbers.
const CHANGED_OF_BASE: [usize; 7] =
    [P_MASS, P_COM, P_INERTIA, P_STATIC_FRICTION, P_DYNAMIC_FRICTION, P_TORSIONAL_FRICTION, P_ROLLING_FRICTION];

/// Columns of parameters that such events change, a bit for each.
fn changed_at_resets() -> u32 {
    let of_joints = BodyList::ALL.into_iter().map(|list| list.places()[1]);
    CHANGED_OF_BASE.into_iter().chain(of_joints).fold(0, |all, name| all | 1 << (name - P_OFFSET))
}

/// Ranges of the velocity command from a control step on: forward and left velocity and yaw rate.
pub type StageForm = (u64, [[f32; 2]; 3]);

/// A reward term with its weight.
#[derive(Clone, Debug)]
pub struct RewardForm {
    /// The term.
    pub form: Form,
    /// Factor of its value.
    pub weight: f32,
    /// Later factors, each with the control step from which it holds, in the order of the steps.
    pub later: Vec<(u64, f32)>,
}

/// A command other than the velocity.
#[derive(Clone, Debug)]
pub struct CommandForm {
    /// Kind of command.
    pub form: Form,
    /// Numbers of the command among those of all such commands.
    pub numbers: Range<usize>,
    /// Time between two draws, s; absent where a reset alone draws it.
    pub resampling: Option<f32>,
}

/// An observation term in a row of observations.
#[derive(Clone, Debug)]
pub struct ObservationForm {
    /// The term.
    pub form: Form,
    /// First column of the term.
    pub column: usize,
    /// Count of the term's numbers in one control step.
    pub size: usize,
    /// Control steps that it remembers, the present one included.
    pub memory: usize,
    /// Half width of its uniform noise.
    pub noise: f32,
    /// Limits of the noisy numbers.
    pub clip: Option<[f32; 2]>,
    /// Factor of the limited numbers.
    pub scale: f32,
    /// Largest relative error, which lasts an episode.
    pub error: f32,
}

/// A slot of a robot.
#[derive(Clone, Copy, Debug)]
pub struct Slot {
    /// Physical joint.
    pub joint: usize,
    /// Column of the batch.
    pub column: usize,
    /// Sign of the joint's position.
    pub sign: f32,
}

/// Delay of a group of actuators.
#[derive(Clone, Debug)]
pub struct Delay {
    /// Fewest and most physics steps.
    pub range: [u32; 2],
    /// Joints of the group.
    pub joints: Vec<usize>,
}

/// When envs whose episode has ended are reset.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AutoresetForm {
    /// Resets in the control step that ends the episode.
    SameStep,
    /// Resets in the next control step.
    NextStep,
    /// When a caller asks.
    Never,
}

/// Tiles of generated terrain.
#[derive(Clone, Copy, Debug, Default)]
pub struct Tiles {
    /// Number along x and y.
    pub num: [u32; 2],
    /// Edge lengths of a tile, m.
    pub size: [f32; 2],
}

/// A task for the robots of a block.
#[derive(Clone, Debug)]
pub struct TaskForm {
    /// The robot's slots.
    pub slots: Vec<Slot>,
    /// Columns of a row of actions, and of a row of observations.
    pub widths: [usize; 2],
    /// Joints of the robot.
    pub joints: usize,
    /// Contact bodies that are feet.
    pub feet: Vec<usize>,
    /// First column of each foot in the batch.
    pub foot_columns: Vec<usize>,
    /// Numbers that an env keeps for its observations.
    pub kept: usize,
    /// Group of each contact body, by any numbers that terms use too.
    pub groups: Vec<i32>,
    /// See [`AutoresetForm`].
    pub autoreset: AutoresetForm,
    /// Control steps of a full episode.
    pub longest: u32,
    /// Whether the task has a velocity command, and whether it may hold a heading.
    pub commands: [bool; 2],
    /// Ranges of forward and left velocity and yaw rate, and of the heading.
    pub command_ranges: [[f32; 2]; 4],
    /// Yaw rate per heading error.
    pub stiffness: f32,
    /// Shares of commands that hold a heading, stand, turn and walk sideways.
    pub shares: [f32; 4],
    /// Time between two commands, s.
    pub resampling: f32,
    /// Length of a physics step and of a control step, s.
    pub lengths: [f32; 2],
    /// Height of the ground, m.
    pub height: f32,
    /// Direction of gravity, and its size.
    pub gravity: ([f32; 3], f32),
    /// Limits of a state's quantities, in their order.
    pub limits: [f32; 7],
    /// Least height of a shape above the ground at a reset, m.
    pub margin: f32,
    /// Share of the joints' ranges that resets stay within.
    pub soft: f32,
    /// Greatest magnitude of an action.
    pub max_action: f32,
    /// Ranges of base velocity, joint positions and joint velocities at a reset.
    pub reset_ranges: [[f32; 2]; 3],
    /// Whether joint positions are scaled at a reset, or moved.
    pub scales: bool,
    /// Delays of actuators.
    pub delays: Vec<Delay>,
    /// Interval events, each with the range of its time, s.
    pub intervals: Vec<([f32; 2], Form)>,
    /// Events of a reset.
    pub resets: Vec<Form>,
    /// Ends of episodes, each with whether it truncates.
    pub ends: Vec<(bool, Form)>,
    /// Rewards.
    pub rewards: Vec<RewardForm>,
    /// Observations.
    pub observations: Vec<ObservationForm>,
    /// Curricula, which change an env when its episode ends.
    pub curricula: Vec<Form>,
    /// Bits of an end's causes that are failures.
    pub failures: u32,
    /// Tiles of the ground, if it is generated.
    pub tiles: Option<Tiles>,
    /// Rays of the height scanner, x and y about the base, m.
    pub rays: Vec<[f32; 2]>,
    /// Later ranges of the velocity command, in the order of their control steps.
    pub stages: Vec<StageForm>,
    /// Ranges up to which a curriculum widens those of the velocity command.
    pub widest: [Option<[f32; 2]>; 3],
    /// Events that change the body at a reset.
    pub body_events: Vec<Form>,
    /// Commands other than the velocity.
    pub other_commands: Vec<CommandForm>,
    /// Friction of the ground: static, dynamic, torsional, rolling.
    pub ground_friction: [f32; 4],
    /// Rule that combines the first two with the robot's.
    pub combine: CombineForm,
}

/// Tables of a task for a block, and the sizes of its columns and rows.
#[derive(Clone, Debug, PartialEq)]
pub struct TaskTables {
    /// Table of integers.
    pub integers: Vec<i32>,
    /// Table of numbers.
    pub numbers: Vec<f32>,
    /// Columns of an env.
    pub columns: usize,
    /// Numbers of a row of actions, of observations, and of an episode that has ended.
    pub widths: [usize; 3],
    /// Columns of parameters that the task changes at resets, a bit for each.
    pub own: u32,
}

/// Lists behind the numbers of a table.
struct Lists {
    integers: Vec<i32>,
    numbers: Vec<f32>,
}

/// Places are counted in integers of 32 bits.
fn whole(x: usize) -> i32 {
    i32::try_from(x).unwrap_or(i32::MAX)
}

impl Lists {
    /// Notes where the list of a name begins, and adds it.
    fn list(&mut self, name: usize, list: &[i32]) {
        self.integers[name] = whole(self.integers.len());
        self.integers.extend(list);
    }

    /// Adds numbers, and says where they begin.
    fn place(&mut self, numbers: &[f32]) -> i32 {
        let at = whole(self.numbers.len());
        self.numbers.extend(numbers);
        at
    }

    /// Adds stages, each with the control step from which it holds, and says where they begin.
    fn stages<'a>(&mut self, stages: impl Iterator<Item = (u64, &'a [f32])>) -> i32 {
        let mut all = Vec::new();
        for (step, numbers) in stages {
            let [low, high] = [step as u32, (step >> 32) as u32].map(u32::cast_signed);
            all.extend([low, high, self.place(numbers)]);
        }
        let first = whole(self.integers.len());
        self.integers.extend(all);
        first
    }

    /// Adds a term's own lists. Its entry has `before` in front of its numbers, and ends with
    /// `more`.
    fn entry(&mut self, form: &Form, before: &[f32], more: [i32; 3]) -> [i32; FORM_SIZE] {
        let at = self.place(before);
        self.place(&form.numbers);
        let list = whole(self.integers.len());
        self.integers.extend(form.integers.iter().flatten());
        let count = form.integers.as_ref().map_or(-1, |list| whole(list.len()));
        [whole(form.term), at, list, count, more[0], more[1], more[2]]
    }
}

impl TaskTables {
    /// The tables of a task.
    pub fn new(task: &TaskForm) -> Self {
        let mut lists = Lists { integers: vec![0; NUM_TASK], numbers: vec![0.0; NUM_TASK_NUMBERS] };
        let autoreset = match task.autoreset {
            AutoresetForm::SameStep => AT_SAME_STEP,
            AutoresetForm::NextStep => AT_NEXT_STEP,
            AutoresetForm::Never => NEVER,
        };
        let combine = match task.combine {
            CombineForm::Average => COMBINE_AVERAGE,
            CombineForm::GeometricMean => COMBINE_GEOMETRIC_MEAN,
            CombineForm::Min => COMBINE_MIN,
            CombineForm::Multiply => COMBINE_MULTIPLY,
            CombineForm::Max => COMBINE_MAX,
        };
        for (name, number) in [
            (K_SLOTS, task.slots.len()),
            (K_ACTIONS, task.widths[0]),
            (K_OBSERVED, task.widths[1]),
            (K_FEET, task.feet.len()),
            (K_AUTORESET, autoreset),
            (K_HAS_COMMAND, usize::from(task.commands[0])),
            (K_HEADING_COMMAND, usize::from(task.commands[1])),
            (K_LONGEST, task.longest as usize),
            (K_SCALES, usize::from(task.scales)),
            (K_REMEMBERS, usize::from(task.observations.iter().any(|term| term.memory > 1 || term.error > 0.0))),
            (K_NUM_DELAYS, task.delays.len()),
            (K_NUM_INTERVALS, task.intervals.len()),
            (K_NUM_RESETS, task.resets.len()),
            (K_NUM_ENDS, task.ends.len()),
            (K_NUM_REWARDS, task.rewards.len()),
            (K_NUM_TERMS, task.observations.len()),
            (K_NUM_CURRICULA, task.curricula.len()),
            (K_RAYS, task.rays.len()),
            (K_NUM_BODY_EVENTS, task.body_events.len()),
            (K_NUM_STAGES, task.stages.len()),
            (K_NUM_COMMANDS, task.other_commands.len()),
            (K_COMBINE, combine),
        ] {
            lists.integers[name] = whole(number);
        }
        let body = if task.body_events.is_empty() { 0 } else { BODY_NUMBERS + BODY_LISTS * task.joints };
        let mut next = 0;
        for (name, size) in [
            (X_ACTION, task.slots.len()),
            (X_PREVIOUS, task.slots.len()),
            (X_COMMAND, COMMAND_SIZE),
            (X_TIMER, task.intervals.len()),
            (X_SUM, task.rewards.len()),
            (X_TOTAL, TOTALS),
            (X_TIME, TIMES * task.feet.len()),
            (X_DEFAULT, task.joints),
            (X_SCALE, 1),
            (X_SPAWN, 1),
            (X_MASS, 1),
            (X_ORIGIN, 2),
            (X_KEPT, task.kept),
            (X_SCAN, task.rays.len()),
            (X_WIDENING, 1),
            (X_TRACKING, 1),
            (X_STARTUP, body),
            (X_BODY, body),
            (X_NUMBERS, task.other_commands.last().map_or(0, |command| command.numbers.end)),
            (X_WAIT, task.other_commands.len()),
        ] {
            lists.integers[name] = whole(next);
            next += size;
        }
        let tiles = task.tiles.unwrap_or_default();
        lists.integers[K_TILES..K_TILES + 2].copy_from_slice(&tiles.num.map(|number| whole(number as usize)));
        lists.integers[K_FAILURES] = task.failures.cast_signed();
        let widened = task.widest.iter().enumerate().filter(|(_, widest)| widest.is_some());
        lists.integers[K_WIDENS] = widened.fold(0, |bits, (place, _)| bits | 1 << place);
        let widest = task.widest.map(Option::unwrap_or_default);
        lists.integers[K_RAY] = lists.place(task.rays.as_flattened());
        let ([down, fall], [heading, standing, turning, sideways]) =
            ([task.gravity.0, [task.gravity.1; 3]], task.shares);
        for (name, numbers) in [
            (F_DT, &task.lengths[..1]),
            (F_STEP, &task.lengths[1..]),
            (F_HEIGHT, &[task.height]),
            (F_DOWN, &down),
            (F_FREE_FALL, &fall[..1]),
            (F_LIMIT, &task.limits),
            (F_RANGE, task.command_ranges[..3].as_flattened()),
            (F_HEADING, &task.command_ranges[3]),
            (F_STIFFNESS, &[task.stiffness]),
            (F_HEADING_SHARE, &[heading, standing, turning, sideways]),
            (F_RESAMPLING, &[task.resampling]),
            (F_MARGIN, &[task.margin]),
            (F_SOFT, &[task.soft]),
            (F_BASE_VELOCITY, task.reset_ranges.as_flattened()),
            (F_MAX_ACTION, &[task.max_action]),
            (F_TILE, &tiles.size),
            (F_WIDEST, widest.as_flattened()),
            (F_GROUND_FRICTION, &task.ground_friction),
        ] {
            lists.numbers[name..name + numbers.len()].copy_from_slice(numbers);
        }
        let signs = task.slots.iter().map(|slot| slot.sign).collect::<Vec<_>>();
        let first_sign = lists.place(&signs);
        let slots = task.slots.iter().zip(first_sign..);
        let slots = slots.flat_map(|(slot, sign)| [whole(slot.joint), whole(slot.column), sign]);
        lists.list(K_SLOT, &slots.collect::<Vec<_>>());
        lists.list(K_FOOT, &task.feet.iter().map(|&body| whole(body)).collect::<Vec<_>>());
        lists.list(K_FOOT_COLUMN, &task.foot_columns.iter().map(|&column| whole(column)).collect::<Vec<_>>());
        lists.list(K_GROUP, &task.groups);
        let mut delays = Vec::new();
        for Delay { range, joints } in &task.delays {
            let at = whole(lists.integers.len());
            lists.integers.extend(joints.iter().map(|&joint| whole(joint)));
            delays.extend([whole(range[0] as usize), whole(range[1] as usize), whole(joints.len()), at]);
        }
        lists.list(K_DELAY, &delays);
        let intervals: Vec<_> = task.intervals.iter().map(|(time, form)| lists.entry(form, time, [0; 3])).collect();
        lists.list(K_INTERVAL, intervals.as_flattened());
        let resets: Vec<_> = task.resets.iter().map(|form| lists.entry(form, &[], [0; 3])).collect();
        lists.list(K_RESET, resets.as_flattened());
        let ends = task.ends.iter().map(|(truncates, form)| lists.entry(form, &[], [i32::from(*truncates), 0, 0]));
        let ends: Vec<_> = ends.collect();
        lists.list(K_END, ends.as_flattened());
        let mut rewards = Vec::new();
        for RewardForm { form, weight, later } in &task.rewards {
            let weight = lists.place(&[*weight]);
            let first = lists.stages(later.iter().map(|(step, weight)| (*step, std::slice::from_ref(weight))));
            rewards.push(lists.entry(form, &[], [weight, whole(later.len()), first]));
        }
        lists.list(K_REWARD, rewards.as_flattened());
        let mut terms = Vec::new();
        for term in &task.observations {
            let [low, high] = term.clip.unwrap_or([1.0, 0.0]);
            let filter = [term.noise, low, high, term.scale, term.error];
            terms.push(lists.entry(&term.form, &filter, [term.column, term.size, term.memory].map(whole)));
        }
        lists.list(K_TERM, terms.as_flattened());
        let curricula: Vec<_> = task.curricula.iter().map(|form| lists.entry(form, &[], [0; 3])).collect();
        lists.list(K_CURRICULUM, curricula.as_flattened());
        let events: Vec<_> = task.body_events.iter().map(|form| lists.entry(form, &[], [0; 3])).collect();
        lists.list(K_BODY_EVENT, events.as_flattened());
        let mut commands = Vec::new();
        for CommandForm { form, numbers, resampling } in &task.other_commands {
            let more = [whole(numbers.start), whole(numbers.len()), i32::from(resampling.is_some())];
            lists.integers[K_PLACE + form.term] = more[0];
            commands.push(lists.entry(form, &[resampling.unwrap_or_default()], more));
        }
        lists.list(K_COMMANDS, commands.as_flattened());
        lists.integers[K_STAGE] = lists.stages(task.stages.iter().map(|(step, ranges)| (*step, ranges.as_flattened())));
        let own = if body > 0 { changed_at_resets() } else { 0 };
        let ended = ENDED_SIZE + TOTALS + task.rewards.len();
        let widths = [task.widths[0], task.widths[1], ended];
        Self { integers: lists.integers, numbers: lists.numbers, columns: next, widths, own }
    }

    fn at(&self, name: usize) -> usize {
        usize::try_from(self.integers[name]).unwrap_or(0)
    }

    /// The parts of the host's numbers: columns, rows of actions, observations and last
    /// observations, rewards, commands. Columns are on the device too.
    pub fn parts(&self, robots: usize) -> EnvParts {
        let sizes = [self.columns, self.widths[0], self.widths[1], self.widths[1], 1, 3].map(|size| size * robots);
        let mut next = 0;
        let mut range = |size: usize| {
            next += size;
            next - size..next
        };
        let numbers = sizes.map(&mut range);
        let mut next = 0;
        let words = [NUM_WORDS, SLOTS, SLOTS * self.widths[2]].map(|size| {
            next += size * robots;
            next - size * robots..next
        });
        EnvParts { numbers, words }
    }
}

/// Parts of an env block's memory.
#[derive(Clone, Debug)]
pub struct EnvParts {
    /// Columns, actions, observations, last observations, rewards, commands.
    pub numbers: [Range<usize>; 6],
    /// Columns of integers; flags and ended episodes of [`SLOTS`] control steps.
    pub words: [Range<usize>; 3],
}

impl EnvParts {
    /// Numbers and words of the host's side.
    pub fn of_host(&self) -> [usize; 2] {
        [self.numbers[5].end, self.words[2].end]
    }

    /// Numbers and words that are on the device too.
    pub fn of_device(&self) -> [usize; 2] {
        [self.numbers[0].end, self.words[0].end]
    }

    /// Words of the flags, and of the ended episodes, of a control step.
    pub fn of_slot(&self, slot: usize) -> [Range<usize>; 2] {
        let of = |all: &Range<usize>| {
            let size = all.len() / SLOTS;
            all.start + slot * size..all.start + (slot + 1) * size
        };
        [of(&self.words[1]), of(&self.words[2])]
    }
}

/// A column of numbers of an env.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Column {
    /// The present action, in the order of the slots.
    Action,
    /// The action before.
    Previous,
    /// Command: velocity (3), heading, time left.
    Command,
    /// Time until each interval event.
    Timer,
    /// Sum of each reward term.
    Sum,
    /// Sums of reward, errors of velocity and yaw rate, commanded ones, speed.
    Total,
    /// Contact times of the feet, then air times, last contact and last air times.
    Time,
    /// Default pose.
    Default,
    /// Action scale, spawn height and total mass.
    Stance,
    /// Place of the env's origin, x and y.
    Origin,
    /// Numbers that observations show for a whole episode.
    Kept,
    /// Widening of the command's ranges, and running mean of the tracking reward.
    Progress,
    /// Numbers of the body that resets change, as startup events left them, see [`BodyList`].
    Startup,
    /// The present ones.
    Body,
    /// Numbers of the commands other than the velocity.
    Numbers,
    /// Time until each of them is drawn again.
    Wait,
}

impl Column {
    fn name(self) -> usize {
        match self {
            Self::Action => X_ACTION,
            Self::Previous => X_PREVIOUS,
            Self::Command => X_COMMAND,
            Self::Timer => X_TIMER,
            Self::Sum => X_SUM,
            Self::Total => X_TOTAL,
            Self::Time => X_TIME,
            Self::Default => X_DEFAULT,
            Self::Stance => X_SCALE,
            Self::Origin => X_ORIGIN,
            Self::Kept => X_KEPT,
            Self::Progress => X_WIDENING,
            Self::Startup => X_STARTUP,
            Self::Body => X_BODY,
            Self::Numbers => X_NUMBERS,
            Self::Wait => X_WAIT,
        }
    }
}

/// A column of integers of an env.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Word {
    /// State of the random numbers, low and high half.
    State,
    /// Increment of the random numbers, low and high half.
    Increment,
    /// Length of the episode.
    Length,
    /// Control steps since the reset.
    Lived,
    /// Causes of the end.
    Causes,
    /// Control steps that were summed.
    Steps,
    /// See [`flags`].
    Flags,
    /// Row of the env's tile.
    TileRow,
    /// Column of its tile.
    TileColumn,
    /// Control steps since the simulation began, low and high half.
    Clock,
    /// Commands other than the velocity that a caller has set, a bit for each.
    Pinned,
}

impl Word {
    fn place(self) -> usize {
        match self {
            Self::State => U_STATE,
            Self::Increment => U_INCREMENT,
            Self::Length => U_LENGTH,
            Self::Lived => U_LIVED,
            Self::Causes => U_CAUSES,
            Self::Steps => U_STEPS,
            Self::Flags => U_FLAGS,
            Self::TileRow => U_LEVEL,
            Self::TileColumn => U_COLUMN,
            Self::Clock => U_CLOCK,
            Self::Pinned => U_PINNED,
        }
    }
}

/// Columns of envs on the host's side.
pub struct EnvRows<'a> {
    task: &'a TaskTables,
    robots: usize,
    numbers: &'a mut [f32],
    words: &'a mut [u32],
}

impl EnvRows<'_> {
    /// Writes numbers of an env, from the beginning of a column on.
    pub fn write<'b>(&mut self, env: usize, column: Column, numbers: impl IntoIterator<Item = &'b f32>) {
        // the last column may have no numbers
        let first = self.task.at(column.name()) * self.robots + env;
        let places = self.numbers.iter_mut().skip(first).step_by(self.robots);
        places.zip(numbers).for_each(|(place, number)| *place = *number);
    }

    /// Reads numbers of an env, from the beginning of a column on.
    pub fn read<'b>(&self, env: usize, column: Column, numbers: impl IntoIterator<Item = &'b mut f32>) {
        let first = self.task.at(column.name()) * self.robots + env;
        let places = self.numbers.iter().skip(first).step_by(self.robots);
        numbers.into_iter().zip(places).for_each(|(number, place)| *number = *place);
    }

    /// Writes an integer.
    pub fn write_word(&mut self, env: usize, word: Word, value: u32) {
        self.words[word.place() * self.robots + env] = value;
    }

    /// Reads an integer.
    pub fn word(&self, env: usize, word: Word) -> u32 {
        self.words[word.place() * self.robots + env]
    }

    /// Writes both halves.
    pub fn write_wide(&mut self, env: usize, word: Word, value: u64) {
        self.words[word.place() * self.robots + env] = value as u32;
        self.words[(word.place() + 1) * self.robots + env] = (value >> 32) as u32;
    }

    /// Reads both halves.
    pub fn wide(&self, env: usize, word: Word) -> u64 {
        let [low, high] = [0, 1].map(|half| u64::from(self.words[(word.place() + half) * self.robots + env]));
        high << 32 | low
    }
}

/// The host's side of a block of envs.
pub struct EnvHost<'a> {
    /// Columns, as the last upload or download has them.
    pub rows: EnvRows<'a>,
    /// Rows of actions, which a control step reads that the host waits for.
    pub actions: &'a mut [f32],
    /// Rows of observations that such a control step has written.
    pub observations: &'a [f32],
    /// Last observations of the episodes that ended in it.
    pub finals: &'a [f32],
    /// Its rewards.
    pub rewards: &'a [f32],
    /// Velocity commands after it, `[robots, 3]`.
    pub commands: &'a [f32],
}

/// Flags and ended episodes of a control step of a block.
pub struct Told<'a> {
    /// Flags of the envs, before resets.
    pub flags: &'a [u32],
    /// Episodes that ended, see [`Told::ended`].
    ended: &'a [u32],
}

/// An episode that has ended.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Ended {
    /// Flags of the ended episode.
    pub flags: u32,
    /// Causes of its end.
    pub causes: u32,
    /// Control steps that were summed.
    pub steps: u32,
    /// Row of the tile on which it was, if the ground has tiles.
    pub level: u32,
    /// Widening of its commands' ranges.
    pub widening: f32,
    /// Sums as in [`Column::Total`].
    pub totals: [f32; TOTALS],
    /// Sum of each reward term.
    pub terms: Vec<f32>,
}

impl<'a> EnvHost<'a> {
    /// The host's side in its memory, whose sizes are [`EnvParts::of_host`].
    pub fn new(task: &'a TaskTables, robots: usize, numbers: &'a mut [f32], words: &'a mut [u32]) -> Self {
        let EnvParts { numbers: parts, words: word_parts } = task.parts(robots);
        let (columns, rest) = numbers.split_at_mut(parts[0].len());
        let (actions, rest) = rest.split_at_mut(parts[1].len());
        let (observations, rest) = rest.split_at(parts[2].len());
        let (finals, rest) = rest.split_at(parts[3].len());
        let (rewards, commands) = rest.split_at(parts[4].len());
        let rows = EnvRows { task, robots, numbers: columns, words: &mut words[word_parts[0].clone()] };
        Self { rows, actions, observations, finals, rewards, commands }
    }
}

impl<'a> Told<'a> {
    /// The part of the host's words for a control step.
    pub fn new(task: &TaskTables, robots: usize, words: &'a [u32], slot: usize) -> Self {
        let [flags, ended] = task.parts(robots).of_slot(slot);
        Self { flags: &words[flags], ended: &words[ended] }
    }

    /// The episode of an env that ended in the control step, where its flags say
    /// [`flags::LOGGED`].
    pub fn ended(&self, env: usize) -> Ended {
        let size = self.ended.len() / self.flags.len().max(1);
        let words = &self.ended[env * size..(env + 1) * size];
        let mut numbers = words[ENDED_SIZE..].iter().map(|&word| f32::from_bits(word));
        let totals = std::array::from_fn(|_| numbers.next().unwrap_or_default());
        let [flags, causes, steps, level] = [1, 2, 3, 4].map(|place| words[place]);
        Ended { flags, causes, steps, level, widening: f32::from_bits(words[5]), totals, terms: numbers.collect() }
    }
}

/// An array of numbers of all envs in the device's memory, row-major.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RowsOf {
    /// Actions that a caller writes on the device: the next control step reads them.
    Given,
    /// Actions of the last control step.
    Actions,
    /// Observations.
    Observations,
    /// Last observations of episodes.
    Finals,
    /// Rewards.
    Rewards,
    /// Velocity commands, three numbers each.
    Commands,
}

/// Sizes of the arrays of all envs in the device's memory.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RowSizes {
    /// Number of envs.
    pub envs: usize,
    /// Numbers of an action.
    pub actions: usize,
    /// Numbers of an observation.
    pub observations: usize,
}

impl RowSizes {
    /// The place of an array among the numbers.
    pub fn part(&self, of: RowsOf) -> Range<usize> {
        let widths = [self.actions, self.actions, self.observations, self.observations, 1, 3];
        let before: usize =
            widths[..of as usize].iter().map(|width| (width * self.envs).next_multiple_of(ALIGNMENT)).sum();
        before..before + widths[of as usize] * self.envs
    }

    /// All numbers.
    pub fn numbers(&self) -> usize {
        self.part(RowsOf::Commands).end
    }
}

/// Memory of [`DeviceRows`], which is freed when nobody holds it any more.
pub trait RowsMemory: Send + Sync {
    /// Lets a caller's queue on the device wait for all steps that have begun, see
    /// [`Flow::stream`].
    ///
    /// # Errors
    /// A device that is lost.
    fn let_wait(&self, _stream: u64) -> Result<(), DeviceError> {
        Ok(())
    }
}

/// Arrays of all envs in the device's memory, which others may read and write there.
#[derive(Clone)]
pub struct DeviceRows {
    /// Their sizes.
    pub sizes: RowSizes,
    /// Number of the card; `None`: they are in the host's memory.
    pub card: Option<usize>,
    /// Address of the numbers.
    pub numbers: u64,
    /// Address of the flags of ended episodes, a byte each: whether they failed, then whether they
    /// ran out of time.
    pub ends: u64,
    /// Keeps the memory.
    pub memory: Arc<dyn RowsMemory>,
}

impl DeviceRows {
    /// Address of an array.
    pub fn address(&self, of: RowsOf) -> u64 {
        self.numbers + (size_of::<f32>() * self.sizes.part(of).start) as u64
    }
}

impl fmt::Debug for DeviceRows {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("DeviceRows").field("sizes", &self.sizes).field("card", &self.card).finish_non_exhaustive()
    }
}

/// A control step that the host does not wait for.
#[derive(Clone, Copy, Debug)]
pub struct Flow {
    /// Place of the control step among [`SLOTS`].
    pub slot: usize,
    /// The caller's queue on the device, whose work before the step ends first, and whose work
    /// after it begins later; of a card its `CUstream`.
    pub stream: u64,
}
