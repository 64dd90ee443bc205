//! The depth camera of a task: `[sensors.ray_caster_camera]`, and where a robot carries it.

use serde::{Deserialize, Serialize};

use super::quantities::{CameraRange, Coordinate, Extent, Gain, Latency, Noise, Time, ViewAngle};
use super::values;

/// Pixels along a side of a camera.
const MOST_PIXELS: u32 = 1000;

/// A depth camera: rays of its pixels that meet the ground. Names are those of Isaac Lab's
/// `RayCasterCameraCfg`.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct RayCasterCameraConfig {
    /// Mount on robots whose own config has no `camera`. Default: these have no camera.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mount: Option<CameraMountConfig>,
    /// Pixels of the image.
    pub pattern_cfg: PinholeCameraPatternConfig,
    /// Quantity of each pixel. Default: `distance_to_image_plane`.
    #[serde(default)]
    pub data_type: DepthData,
    /// Least distance that it measures, m. Default: 0.
    #[serde(default, deserialize_with = "values::number_of::<Extent, _, _>")]
    pub min_distance: f64,
    /// Largest distance that it measures, m.
    #[serde(deserialize_with = "values::number_of::<CameraRange, _, _>")]
    pub max_distance: f64,
    /// Number of a pixel that sees nothing between the two. Default: max.
    #[serde(default)]
    pub depth_clipping_behavior: DepthClipping,
    /// Time between two frames, s; a frame is held until the next. Envs take theirs at different
    /// times. Default: 0, a frame in each control step.
    #[serde(default, deserialize_with = "values::number_of::<Time, _, _>")]
    pub update_period: f64,
    /// Least and largest time by which an env's frames are late, s; drawn for each episode.
    /// Default: 0.
    #[serde(default, deserialize_with = "values::range_of::<Latency, _, _>")]
    pub delay: [f64; 2],
    /// Share of the frames that are lost. Default: 0.
    #[serde(default, deserialize_with = "values::fraction")]
    pub drop_probability: f64,
    /// Half width of the uniform noise of each pixel of a frame, m. Default: 0.
    #[serde(default, deserialize_with = "values::number_of::<Noise, _, _>")]
    pub noise: f64,
    /// Half width of this noise per m of distance. Default: 0.
    #[serde(default, deserialize_with = "values::number_of::<Gain, _, _>")]
    pub relative_noise: f64,
}

/// Pixels of a pinhole camera.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct PinholeCameraPatternConfig {
    /// Pixels in a row.
    #[serde(deserialize_with = "values::count_up_to::<MOST_PIXELS, _>")]
    pub width: u32,
    /// Rows of pixels.
    #[serde(deserialize_with = "values::count_up_to::<MOST_PIXELS, _>")]
    pub height: u32,
    /// Horizontal angle of view, rad: twice the arc tangent of half the aperture over the focal
    /// length.
    #[serde(deserialize_with = "values::number_of::<ViewAngle, _, _>")]
    pub horizontal_fov: f64,
    /// Vertical angle of view, rad. Default: that of square pixels.
    #[serde(
        default,
        deserialize_with = "values::optional_of::<ViewAngle, _, _>",
        skip_serializing_if = "Option::is_none"
    )]
    pub vertical_fov: Option<f64>,
}

impl PinholeCameraPatternConfig {
    /// Number of pixels.
    #[must_use]
    pub fn num_pixels(&self) -> usize {
        self.width as usize * self.height as usize
    }
}

/// Mount of a robot's camera. The camera looks along its x axis; its y axis points to the left of
/// the image and its z axis to the top.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct CameraMountConfig {
    /// Link of the URDF that a joint moves. Default: the base.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub body: Option<String>,
    /// Position in the link's frame, m.
    #[serde(deserialize_with = "values::list_of::<Coordinate, _, _>")]
    pub pos: [f64; 3],
    /// Quaternion w, x, y, z from the camera's axes to the link's; of any length above 0. Default:
    /// no turn.
    #[serde(default = "upright", deserialize_with = "values::quaternion")]
    pub rot: [f64; 4],
}

fn upright() -> [f64; 4] {
    [1.0, 0.0, 0.0, 0.0]
}

/// Quantity of a camera's pixel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum DepthData {
    /// Distance along the camera's axis.
    #[default]
    DistanceToImagePlane,
    /// Distance along the ray.
    DistanceToCamera,
}

/// Number of a pixel that sees nothing in the camera's range.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum DepthClipping {
    /// The nearer end of the range.
    #[default]
    Max,
    /// Zero, as stereo cameras have it.
    Zero,
}
