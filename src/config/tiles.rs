//! Shapes of the tiles of generated terrain: `[[scene.terrain.sub_terrains]]` of a task.

use serde::{Deserialize, Serialize};

use super::quantities::{Extent, Factor, Gain, Height, LeanDegrees, Length, Rise, Slope, Spacing};
use super::terrain::TerrainConfig;
use super::values;

/// Objects, beams, bars or waves of a tile.
const MOST_OBJECTS: u32 = 10_000;

/// Shape of a tile. Ranges go from difficulty 0 to difficulty 1, lengths are in m.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum SubTerrainShape {
    /// A plane at height 0.
    Flat {},
    /// Square rings of steps that rise towards the middle.
    PyramidStairs(StairsConfig),
    /// Square rings of steps that go down towards the middle.
    PyramidStairsInv(StairsConfig),
    /// Square rings that rise towards the middle, each of them a step and a ramp.
    PyramidRamps(RampsConfig),
    /// Square rings that go down towards the middle, each of them a step and a ramp.
    PyramidRampsInv(RampsConfig),
    /// Square blocks of random heights about 0.
    Boxes(BoxesConfig),
    /// A platform above the ground.
    Box(BoxConfig),
    /// A platform below the ground.
    Pit(PitConfig),
    /// A ditch around a platform.
    Gap(GapConfig),
    /// Two square walls around a platform.
    Rails(RailsConfig),
    /// A square wall around a platform. The ground has one height at each place, so that the ring
    /// stands on the ground.
    FloatingRing(RingConfig),
    /// Bars over a hole that cross in a platform.
    Star(StarConfig),
    /// Parallel beams over a hole, on the four sides of a platform.
    Beams(BeamsConfig),
    /// Boxes that stand about at random places, turned by random angles.
    RepeatedBoxes(RepeatedObjectsConfig<BoxObjectConfig>),
    /// Square pyramids at random places, turned by random angles.
    RepeatedPyramids(RepeatedObjectsConfig<RoundObjectConfig>),
    /// Cylinders at random places.
    RepeatedCylinders(RepeatedObjectsConfig<RoundObjectConfig>),
    /// A height field of random heights.
    RandomRough(RoughConfig),
    /// A height field that rises towards the middle.
    HfPyramidSlope(SlopeConfig),
    /// A height field that falls towards the middle.
    HfPyramidSlopeInv(SlopeConfig),
    /// A height field of blocks and holes at random places.
    HfDiscreteObstacles(ObstaclesConfig),
    /// A height field of waves along x and y.
    HfWave(WaveConfig),
    /// Square stones above a hole.
    HfSteppingStones(StonesConfig),
    /// Heights of the user's own, a table per level.
    Heightfield(HeightfieldConfig),
    /// The sum of the heights of other shapes, on the vertices of a height field.
    Mixture(MixtureConfig),
}

/// Stairs around a platform.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct StairsConfig {
    /// Height of a step.
    #[serde(deserialize_with = "values::range_of::<Rise, _, _>")]
    pub step_height_range: [f64; 2],
    /// Depth of a step.
    #[serde(deserialize_with = "values::number_of::<Length, _, _>")]
    pub step_width: f64,
    /// Edge length of the platform in the middle, at least.
    #[serde(deserialize_with = "values::number_of::<Length, _, _>")]
    pub platform_width: f64,
    /// Width of the flat edge of the tile.
    #[serde(deserialize_with = "values::number_of::<Extent, _, _>")]
    pub border_width: f64,
    /// Steps of a flight: the last of them is a landing. Default: no landings.
    #[serde(default, skip_serializing_if = "is_none")]
    pub landing_every: u32,
    /// Depth of a landing. Default: 0.
    #[serde(default, deserialize_with = "values::number_of::<Extent, _, _>", skip_serializing_if = "values::is_zero")]
    pub landing_width: f64,
    /// Width of the opening between a tread and the next riser, seen from above, which reaches down
    /// to the foot of the stairs. Default: 0, closed risers.
    #[serde(default, deserialize_with = "values::number_of::<Extent, _, _>", skip_serializing_if = "values::is_zero")]
    pub riser_gap: f64,
}

/// Ramps and steps around a platform.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct RampsConfig {
    /// Slope of a ramp, rise over run.
    #[serde(deserialize_with = "values::range_of::<Slope, _, _>")]
    pub slope_range: [f64; 2],
    /// Length of a ramp, seen from above.
    #[serde(deserialize_with = "values::number_of::<Length, _, _>")]
    pub ramp_width: f64,
    /// Height of the step before each ramp.
    #[serde(deserialize_with = "values::range_of::<Rise, _, _>")]
    pub step_height_range: [f64; 2],
    /// Edge length of the platform in the middle, at least.
    #[serde(deserialize_with = "values::number_of::<Length, _, _>")]
    pub platform_width: f64,
    /// Width of the flat edge of the tile.
    #[serde(deserialize_with = "values::number_of::<Extent, _, _>")]
    pub border_width: f64,
}

/// Blocks around a platform.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct BoxesConfig {
    /// Edge length of a block.
    #[serde(deserialize_with = "values::number_of::<Length, _, _>")]
    pub grid_width: f64,
    /// Largest height and depth of a block.
    #[serde(deserialize_with = "values::range_of::<Rise, _, _>")]
    pub grid_height_range: [f64; 2],
    /// Edge length of the platform in the middle; it is as high as the highest block may be.
    #[serde(deserialize_with = "values::number_of::<Length, _, _>")]
    pub platform_width: f64,
}

/// A platform to step down from.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct BoxConfig {
    /// Height of the platform, or of each of two steps.
    #[serde(deserialize_with = "values::range_of::<Rise, _, _>")]
    pub box_height_range: [f64; 2],
    /// Edge length of the platform.
    #[serde(deserialize_with = "values::number_of::<Length, _, _>")]
    pub platform_width: f64,
    /// Whether a second step, half a metre deep, lies below the platform. Default: no.
    #[serde(default)]
    pub double_box: bool,
}

/// A platform to step up from.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct PitConfig {
    /// Depth of the pit, or of each of two steps.
    #[serde(deserialize_with = "values::range_of::<Rise, _, _>")]
    pub pit_depth_range: [f64; 2],
    /// Edge length of the platform at its bottom.
    #[serde(deserialize_with = "values::number_of::<Length, _, _>")]
    pub platform_width: f64,
    /// Whether a second step, half a metre deep, lies above the platform. Default: no.
    #[serde(default)]
    pub double_pit: bool,
}

/// A ditch around a platform.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct GapConfig {
    /// Width of the gap.
    #[serde(deserialize_with = "values::range_of::<Extent, _, _>")]
    pub gap_width_range: [f64; 2],
    /// Edge length of the platform in the middle.
    #[serde(deserialize_with = "values::number_of::<Length, _, _>")]
    pub platform_width: f64,
    /// Depth of the gap. Default: 1.
    #[serde(default = "one", deserialize_with = "values::number_of::<Rise, _, _>")]
    pub gap_depth: f64,
}

/// Two walls around a platform: one at its edge, one at 0.6 of the way to the tile's edge.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct RailsConfig {
    /// Thickness of the inner and of the outer rail.
    #[serde(deserialize_with = "values::list_of::<Length, _, _>")]
    pub rail_thickness_range: [f64; 2],
    /// Height of the rails.
    #[serde(deserialize_with = "values::range_of::<Rise, _, _>")]
    pub rail_height_range: [f64; 2],
    /// Edge length of the platform in the middle.
    #[serde(deserialize_with = "values::number_of::<Length, _, _>")]
    pub platform_width: f64,
}

/// A wall around a platform.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct RingConfig {
    /// Width of the ring.
    #[serde(deserialize_with = "values::range_of::<Length, _, _>")]
    pub ring_width_range: [f64; 2],
    /// Height of the ring's underside.
    #[serde(deserialize_with = "values::range_of::<Rise, _, _>")]
    pub ring_height_range: [f64; 2],
    /// Height of the ring above its underside.
    #[serde(deserialize_with = "values::number_of::<Length, _, _>")]
    pub ring_thickness: f64,
    /// Edge length of the platform in the middle.
    #[serde(deserialize_with = "values::number_of::<Length, _, _>")]
    pub platform_width: f64,
}

/// Bars that cross in a platform, up to a flat edge that is as wide as the widest bar.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct StarConfig {
    /// Number of bars; each of them crosses the whole tile.
    #[serde(deserialize_with = "values::count_up_to::<MOST_OBJECTS, _>")]
    pub num_bars: u32,
    /// Width of a bar; the widest at difficulty 0.
    #[serde(deserialize_with = "values::range_of::<Length, _, _>")]
    pub bar_width_range: [f64; 2],
    /// Height of a bar above the hole.
    #[serde(deserialize_with = "values::range_of::<Rise, _, _>")]
    pub bar_height_range: [f64; 2],
    /// Edge length of the platform in the middle.
    #[serde(deserialize_with = "values::number_of::<Length, _, _>")]
    pub platform_width: f64,
}

/// Beams between a platform and the flat edge.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct BeamsConfig {
    /// Number of beams on each of the four sides.
    #[serde(deserialize_with = "values::count_up_to::<MOST_OBJECTS, _>")]
    pub num_beams: u32,
    /// Width of a beam; the widest at difficulty 0.
    #[serde(deserialize_with = "values::range_of::<Length, _, _>")]
    pub beam_width_range: [f64; 2],
    /// Height of a beam above the hole.
    #[serde(deserialize_with = "values::range_of::<Rise, _, _>")]
    pub beam_height_range: [f64; 2],
    /// Edge length of the platform in the middle.
    #[serde(deserialize_with = "values::number_of::<Length, _, _>")]
    pub platform_width: f64,
    /// Width of the flat edge of the tile.
    #[serde(deserialize_with = "values::number_of::<Extent, _, _>")]
    pub border_width: f64,
}

/// Objects at the easiest and the hardest level.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct RepeatedObjectsConfig<T> {
    /// The objects at difficulty 0.
    pub object_params_start: T,
    /// The objects at difficulty 1.
    pub object_params_end: T,
    /// Number that is added to each height, drawn from this range. Default: 0.
    #[serde(default, deserialize_with = "values::range_of::<Height, _, _>")]
    pub abs_height_noise: [f64; 2],
    /// Factor of each height, drawn from this range. Default: 1.
    #[serde(default = "ones", deserialize_with = "values::range_of::<Gain, _, _>")]
    pub rel_height_noise: [f64; 2],
    /// Edge length of the platform in the middle, on which no object stands.
    #[serde(deserialize_with = "values::number_of::<Length, _, _>")]
    pub platform_width: f64,
    /// Height of the platform; that of the objects if it is negative. Default: -1.
    #[serde(default = "minus_one", deserialize_with = "values::number_of::<Height, _, _>")]
    pub platform_height: f64,
}

/// Boxes that stand about.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct BoxObjectConfig {
    /// Number of boxes.
    #[serde(deserialize_with = "values::count_up_to::<MOST_OBJECTS, _>")]
    pub num_objects: u32,
    /// Height of a box.
    #[serde(deserialize_with = "values::number_of::<Rise, _, _>")]
    pub height: f64,
    /// Edge lengths of a box.
    #[serde(deserialize_with = "values::list_of::<Length, _, _>")]
    pub size: [f64; 2],
    /// Largest angle by which a box is tilted about x and about y, degrees. Default: 0.
    #[serde(default, deserialize_with = "values::number_of::<LeanDegrees, _, _>")]
    pub max_yx_angle: f64,
}

/// Pyramids or cylinders that stand about.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct RoundObjectConfig {
    /// Number of objects.
    #[serde(deserialize_with = "values::count_up_to::<MOST_OBJECTS, _>")]
    pub num_objects: u32,
    /// Height of an object.
    #[serde(deserialize_with = "values::number_of::<Rise, _, _>")]
    pub height: f64,
    /// Radius of an object; of a pyramid, to its corners.
    #[serde(deserialize_with = "values::number_of::<Length, _, _>")]
    pub radius: f64,
    /// Largest angle by which an object is tilted about x and about y, degrees. Default: 0.
    #[serde(default, deserialize_with = "values::number_of::<LeanDegrees, _, _>")]
    pub max_yx_angle: f64,
}

/// An object that stands about.
pub trait RepeatedObject {
    /// Number of such objects.
    fn count(&self) -> u32;
    /// Height of an object.
    fn height(&self) -> f64;
    /// Largest angle by which an object is tilted, degrees.
    fn tilt(&self) -> f64;
    /// Largest width of an upright object, seen from above.
    fn width(&self) -> f64;
}

/// Implements [`RepeatedObject`] for a table of an object; `width` follows from it.
macro_rules! repeated_object {
    ($table:ty, $object:ident => $width:expr) => {
        impl RepeatedObject for $table {
            fn count(&self) -> u32 {
                self.num_objects
            }

            fn height(&self) -> f64 {
                self.height
            }

            fn tilt(&self) -> f64 {
                self.max_yx_angle
            }

            fn width(&self) -> f64 {
                let $object = self;
                $width
            }
        }
    };
}
repeated_object!(BoxObjectConfig, object => object.size[0].hypot(object.size[1]));
repeated_object!(RoundObjectConfig, object => 2.0 * object.radius);

impl<T: RepeatedObject> RepeatedObjectsConfig<T> {
    /// Largest number of objects.
    fn most_objects(&self) -> f64 {
        f64::from(self.object_params_start.count().max(self.object_params_end.count()))
    }

    /// Largest width of an object, tilted or not, seen from above.
    fn widest(&self) -> f64 {
        let width = |object: &T| object.width() + leaning(object.height(), object.tilt());
        width(&self.object_params_start).max(width(&self.object_params_end))
    }
}

/// Random heights. The difficulty changes nothing.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct RoughConfig {
    /// Smallest and largest height.
    #[serde(deserialize_with = "values::range_of::<Height, _, _>")]
    pub noise_range: [f64; 2],
    /// Heights are the smallest one plus multiples of this.
    #[serde(deserialize_with = "values::number_of::<Spacing, _, _>")]
    pub noise_step: f64,
    /// Width of the flat edge of the tile.
    #[serde(deserialize_with = "values::number_of::<Extent, _, _>")]
    pub border_width: f64,
}

/// A slope around a platform.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct SlopeConfig {
    /// Slope along the middle of a side, rise over run.
    #[serde(deserialize_with = "values::range_of::<Slope, _, _>")]
    pub slope_range: [f64; 2],
    /// Edge length of the platform in the middle.
    #[serde(deserialize_with = "values::number_of::<Length, _, _>")]
    pub platform_width: f64,
    /// Width of the flat edge of the tile.
    #[serde(deserialize_with = "values::number_of::<Extent, _, _>")]
    pub border_width: f64,
}

/// Rectangular blocks and holes; a later one covers an earlier one.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct ObstaclesConfig {
    /// Heights of the obstacles. Default: choice.
    #[serde(default)]
    pub obstacle_height_mode: ObstacleHeight,
    /// Edge lengths of an obstacle.
    #[serde(deserialize_with = "values::range_of::<Length, _, _>")]
    pub obstacle_width_range: [f64; 2],
    /// Height of an obstacle.
    #[serde(deserialize_with = "values::range_of::<Rise, _, _>")]
    pub obstacle_height_range: [f64; 2],
    /// Number of obstacles.
    #[serde(deserialize_with = "values::count_up_to::<MOST_OBJECTS, _>")]
    pub num_obstacles: u32,
    /// Edge length of the platform in the middle.
    #[serde(deserialize_with = "values::number_of::<Length, _, _>")]
    pub platform_width: f64,
    /// Width of the flat edge of the tile. Default: 0.
    #[serde(default, deserialize_with = "values::number_of::<Extent, _, _>")]
    pub border_width: f64,
}

/// Heights of obstacles.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ObstacleHeight {
    /// The height, half of it, or one of these below the ground.
    #[default]
    Choice,
    /// The height.
    Fixed,
}

/// The sum of a cosine along x and a sine along y.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct WaveConfig {
    /// Largest height above and below 0.
    #[serde(deserialize_with = "values::range_of::<Rise, _, _>")]
    pub amplitude_range: [f64; 2],
    /// Number of waves along each side. Default: 1.
    #[serde(default = "single", deserialize_with = "values::count_up_to::<MOST_OBJECTS, _>")]
    pub num_waves: u32,
    /// Edge length of a level platform in the middle. Default: 0.
    #[serde(default, deserialize_with = "values::number_of::<Extent, _, _>")]
    pub platform_width: f64,
    /// Width of the flat edge of the tile. Default: 0.
    #[serde(default, deserialize_with = "values::number_of::<Extent, _, _>")]
    pub border_width: f64,
}

/// Stones in rows along y, each row of which begins at a random place.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct StonesConfig {
    /// Largest height of a stone above and below the platform.
    #[serde(deserialize_with = "values::number_of::<Rise, _, _>")]
    pub stone_height_max: f64,
    /// Edge length of a stone; the widest at difficulty 0.
    #[serde(deserialize_with = "values::range_of::<Length, _, _>")]
    pub stone_width_range: [f64; 2],
    /// Distance between stones.
    #[serde(deserialize_with = "values::range_of::<Extent, _, _>")]
    pub stone_distance_range: [f64; 2],
    /// Height of the ground between the stones. Default: -1.
    #[serde(default = "minus_one", deserialize_with = "values::number_of::<Height, _, _>")]
    pub holes_depth: f64,
    /// Edge length of the platform in the middle.
    #[serde(deserialize_with = "values::number_of::<Length, _, _>")]
    pub platform_width: f64,
    /// Width of the flat edge of the tile. Default: 0.
    #[serde(default, deserialize_with = "values::number_of::<Extent, _, _>")]
    pub border_width: f64,
}

/// Tables of heights, laid over the tile.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct HeightfieldConfig {
    /// Tables of heights from the easiest to the hardest, as `levels[k][i][j]`: `i` along x, `j`
    /// along y. The difficulty chooses one of them.
    pub levels: Vec<Vec<Vec<f64>>>,
    /// Factor of the heights. Default: 1.
    #[serde(default = "ones", deserialize_with = "values::range_of::<Factor, _, _>")]
    pub height_scale_range: [f64; 2],
    /// Edge length of a level platform in the middle. Default: 0.
    #[serde(default, deserialize_with = "values::number_of::<Extent, _, _>")]
    pub platform_width: f64,
    /// Width of the flat edge of the tile. Default: 0.
    #[serde(default, deserialize_with = "values::number_of::<Extent, _, _>")]
    pub border_width: f64,
}

/// Shapes on top of each other.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct MixtureConfig {
    /// Shapes whose heights are added.
    pub of: Vec<SubTerrainShape>,
    /// Edge length of a level platform in the middle. Default: 0.
    #[serde(default, deserialize_with = "values::number_of::<Extent, _, _>")]
    pub platform_width: f64,
}

fn is_none(count: &u32) -> bool {
    *count == 0
}

fn single() -> u32 {
    1
}

fn one() -> f64 {
    1.0
}

fn minus_one() -> f64 {
    -1.0
}

fn ones() -> [f64; 2] {
    [1.0; 2]
}

/// Heights that a table of a tile may have along a side.
const MOST_HEIGHTS: usize = 2000;
/// Depth of the second step of a double pit or box, m.
pub(crate) const SECOND_STEP: f64 = 0.5;
/// Shapes that a mixture may hold within each other.
const DEEPEST: u32 = 3;

/// Twice the way by which the top of a leaning object may lie off its foot, m.
fn leaning(height: f64, degrees: f64) -> f64 {
    2.0 * height * degrees.to_radians()
}

impl SubTerrainShape {
    /// Largest number of vertices of a tile, about.
    pub(super) fn num_vertices(&self, terrain: &TerrainConfig) -> f64 {
        // four corners of a rectangle; a frame is four of them, and so are walls
        const RECTANGLE: f64 = 4.0;
        let [x, y] = terrain.size;
        let rings = |depth: f64| 8.0 * RECTANGLE * (0.5 * x.min(y) / depth + 3.0);
        let blocks = |count: f64| 5.0 * RECTANGLE * (count + 3.0);
        // a cylinder of 16 sides: its top and its walls
        let objects = |count: f64| 80.0 * count + blocks(3.0);
        let field = (x / terrain.horizontal_scale + 2.0) * (y / terrain.horizontal_scale + 2.0);
        match self {
            Self::Flat {} => RECTANGLE,
            Self::PyramidStairs(c) | Self::PyramidStairsInv(c) if c.riser_gap > 0.0 => 2.0 * rings(c.step_width),
            Self::PyramidStairs(c) | Self::PyramidStairsInv(c) => rings(c.step_width),
            Self::PyramidRamps(c) | Self::PyramidRampsInv(c) => rings(c.ramp_width),
            Self::Boxes(c) => blocks((x / c.grid_width) * (y / c.grid_width)),
            Self::Box(_) | Self::Pit(_) | Self::Gap(_) | Self::Rails(_) | Self::FloatingRing(_) => blocks(6.0),
            Self::Star(c) => blocks(f64::from(c.num_bars) + 3.0),
            Self::Beams(c) => blocks(4.0 * f64::from(c.num_beams) + 3.0),
            Self::RepeatedBoxes(c) => objects(c.most_objects()),
            Self::RepeatedPyramids(c) | Self::RepeatedCylinders(c) => objects(c.most_objects()),
            Self::HfSteppingStones(c) => {
                let pitch = c.stone_width_range[0] + c.stone_distance_range[0];
                blocks((x / pitch + 2.0) * (y / pitch + 2.0))
            }
            Self::RandomRough(_)
            | Self::HfPyramidSlope(_)
            | Self::HfPyramidSlopeInv(_)
            | Self::HfDiscreteObstacles(_)
            | Self::HfWave(_) => field,
            Self::Heightfield(c) => {
                let largest = c.levels.iter().map(|rows| (rows.len() + 4) * (rows.first().map_or(0, Vec::len) + 4));
                largest.max().unwrap_or(0) as f64
            }
            Self::Mixture(c) => field + c.of.iter().map(|shape| shape.num_vertices(terrain)).fold(0.0, f64::max),
        }
    }

    /// Whether the terrain's `edge_step` says where its edges may be.
    pub(super) fn has_edges(&self) -> bool {
        match self {
            Self::Box(_)
            | Self::Pit(_)
            | Self::Gap(_)
            | Self::Rails(_)
            | Self::FloatingRing(_)
            | Self::Star(_)
            | Self::Beams(_)
            | Self::HfSteppingStones(_)
            | Self::RepeatedBoxes(_)
            | Self::RepeatedPyramids(_)
            | Self::RepeatedCylinders(_) => true,
            Self::Mixture(c) => c.of.iter().any(Self::has_edges),
            _ => false,
        }
    }

    /// Problem of the shape on a tile of this edge length, and the remedy.
    pub(super) fn problem(&self, size: f64) -> Option<(&'static str, &'static str)> {
        self.problem_at(size, 0)
    }

    fn problem_at(&self, size: f64, depth: u32) -> Option<(&'static str, &'static str)> {
        let (border, platform) = match self {
            Self::Flat {} => return None,
            Self::PyramidStairs(c) | Self::PyramidStairsInv(c) => (c.border_width, c.platform_width),
            Self::PyramidRamps(c) | Self::PyramidRampsInv(c) => (c.border_width, c.platform_width),
            Self::Boxes(c) if size / c.grid_width > 1000.0 => {
                return Some(("there would be more than a million blocks", "raise grid_width"));
            }
            Self::Boxes(c) => (0.0, c.platform_width),
            Self::Box(c) => (f64::from(u32::from(c.double_box)) * SECOND_STEP, c.platform_width),
            Self::Pit(c) => (f64::from(u32::from(c.double_pit)) * SECOND_STEP, c.platform_width),
            Self::Gap(c) => (c.gap_width_range[1], c.platform_width),
            // the outer rail stands at 0.6 of the way from the platform to the tile's edge
            Self::Rails(c) => {
                let [inner, outer] = c.rail_thickness_range;
                ((inner / 0.3).max(outer / 0.2), c.platform_width)
            }
            Self::FloatingRing(c) => (c.ring_width_range[1], c.platform_width),
            Self::Star(c) => (c.bar_width_range[1], c.platform_width),
            Self::Beams(c) => (c.border_width, c.platform_width),
            Self::RepeatedBoxes(c) => (c.widest(), c.platform_width),
            Self::RepeatedPyramids(c) | Self::RepeatedCylinders(c) => (c.widest(), c.platform_width),
            Self::RandomRough(c) => (c.border_width, 0.0),
            Self::HfPyramidSlope(c) | Self::HfPyramidSlopeInv(c) => (c.border_width, c.platform_width),
            Self::HfDiscreteObstacles(c) => (c.border_width, c.platform_width.max(c.obstacle_width_range[1])),
            Self::HfWave(c) => (c.border_width, c.platform_width),
            Self::HfSteppingStones(c) if c.holes_depth > 0.0 => {
                return Some(("its holes are above the ground", "write holes_depth below 0"));
            }
            Self::HfSteppingStones(c) => (c.border_width, c.platform_width),
            Self::Heightfield(c) => (c.border_width, c.platform_width),
            Self::Mixture(c) => (0.0, c.platform_width),
        };
        if size - 2.0 * border <= platform {
            return Some(("its border and platform are wider than the tile", "make them narrower"));
        }
        match self {
            Self::PyramidStairs(c) | Self::PyramidStairsInv(c) if size / c.step_width > 10_000.0 => {
                Some(("there would be too many steps", "raise step_width"))
            }
            Self::PyramidStairs(c) | Self::PyramidStairsInv(c) if c.riser_gap >= c.step_width => {
                Some(("its openings leave no treads", "write a riser_gap below step_width"))
            }
            Self::PyramidStairs(c) | Self::PyramidStairsInv(c)
                if (c.landing_every > 0) != (c.landing_width > c.riser_gap) =>
            {
                Some(("its landings have no depth or no number", "write landing_every and landing_width, or neither"))
            }
            Self::PyramidRamps(c) | Self::PyramidRampsInv(c) if size / c.ramp_width > 10_000.0 => {
                Some(("there would be too many ramps", "raise ramp_width"))
            }
            Self::Heightfield(c) => {
                let is_table = |rows: &Vec<Vec<f64>>| {
                    let columns = rows.first().map_or(0, Vec::len);
                    let lengths = [rows.len(), columns];
                    rows.iter().all(|row| row.len() == columns)
                        && lengths.iter().all(|n| (2..=MOST_HEIGHTS).contains(n))
                };
                if c.levels.is_empty() || !c.levels.iter().all(is_table) {
                    Some((
                        "its levels are not tables of two by two to 2000 by 2000 heights",
                        "write levels[k][i][j], rows of equal length",
                    ))
                } else if !c.levels.iter().flatten().flatten().all(|z| z.abs() <= 100.0) {
                    Some(("a height of it is beyond 100 m or not finite", "write heights in m"))
                } else {
                    None
                }
            }
            Self::Mixture(c) if c.of.len() < 2 => {
                Some(("it has fewer than two shapes", "write of = [{ type = \"...\", ... }, ...]"))
            }
            Self::Mixture(_) if depth >= DEEPEST => {
                Some(("its mixtures hold mixtures too deep within each other", "write one list of shapes"))
            }
            Self::Mixture(c) => c.of.iter().find_map(|shape| shape.problem_at(size, depth + 1)),
            _ => None,
        }
    }
}
