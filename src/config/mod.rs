#![doc = include_str!("README.md")]

mod document;
mod error;
mod layer;
mod library;
mod names;
mod overrides;
mod parse;
mod play;
pub mod quantities;
mod randomization;
mod robot;
mod scene;
mod sensors;
mod suggest;
mod surfaces;
mod task;
mod terrain;
mod tiles;
pub mod values;

pub use error::{ConfigError, ConfigErrorKind};
pub(crate) use layer::Layers;
pub use library::{Explained, Library, LoadedRobot, LoadedTask, NetworkFile, PATH_VARIABLE, TrainFile};
pub use names::{RobotEntry, TaskEntry, TrainEntry};
pub use overrides::apply as apply_override;
pub use parse::parse_params;
pub use randomization::{
    BaseComOffset, Distribution, Draw, LEAST_BASE_MASS, Operation, RandomizationConfig, VariationConfig,
};
pub use robot::{
    ActuatorConfig, ActuatorModel, BodiesConfig, CommandLimitsConfig, InputOrder, JointPositionMode,
    JointPositionReset, RangeConfig, ResetConfig, RobotConfig, VelocityLimitsConfig,
};
pub(crate) use robot::{check_pattern, matches, table_steps};
pub use scene::{FrictionCombine, GroundConfig, ObstacleConfig, Placement, SceneConfig};
pub use sensors::{CameraMountConfig, DepthClipping, DepthData, PinholeCameraPatternConfig, RayCasterCameraConfig};
pub(crate) use suggest::did_you_mean;
pub use surfaces::SurfaceConfig;
pub use task::{
    AVIAN_SUBSTEPS, ActionsConfig, CommandConfig, CommandsConfig, CurriculumConfig, EARTH_GRAVITY, EventConfig,
    EventMode, ExternalConfig, ExternalKind, HeightScannerConfig, JointPositionActionConfig, MaterialConfig,
    ObservationTerm, ObservationsConfig, POLICY_GROUP, PhysicsConfig, RewardConfig, SensorsConfig, SimConfig,
    TaskConfig, VELOCITY_COLUMNS, VELOCITY_COMMAND, VelocityCommandConfig,
};
pub use terrain::{Columns, ScaleBy, SubTerrainConfig, TerrainConfig};
pub(crate) use tiles::RepeatedObject;
pub(crate) use tiles::SECOND_STEP;
pub use tiles::{
    BeamsConfig, BoxConfig, BoxObjectConfig, BoxesConfig, GapConfig, HeightfieldConfig, MixtureConfig, ObstacleHeight,
    ObstaclesConfig, PitConfig, RailsConfig, RampsConfig, RepeatedObjectsConfig, RingConfig, RoughConfig,
    RoundObjectConfig, SlopeConfig, StairsConfig, StarConfig, StonesConfig, SubTerrainShape, WaveConfig,
};
