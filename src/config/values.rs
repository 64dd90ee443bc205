//! Checked values: functions for `#[serde(deserialize_with = "...")]`, for the types of this module
//! and for the parameters of terms. Each error message holds the problem and, after a semicolon,
//! the remedy.

use std::collections::BTreeMap;
use std::marker::PhantomData;

use serde::de::{Deserialize, Deserializer, Error};

use super::quantities::Quantity;
use crate::bounds::{MAX_COMMAND, MAX_DELAY, MAX_DT, MIN_DT, Shown};

/// A number as a term keeps it: `f32` or `f64`.
pub trait Number {
    /// Rounds to it.
    fn of(number: f64) -> Self;
}

impl Number for f32 {
    fn of(number: f64) -> Self {
        number as f32
    }
}

impl Number for f64 {
    fn of(number: f64) -> Self {
        number
    }
}

/// A number within the bounds of a quantity.
struct Of<Q>(f64, PhantomData<Q>);

impl<'de, Q: Quantity> Deserialize<'de> for Of<Q> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        within::<Q, D::Error>(f64::deserialize(deserializer)?).map(|number| Self(number, PhantomData))
    }
}

/// The number, if it lies in the quantity's range.
fn within<Q: Quantity, E: Error>(number: f64) -> Result<f64, E> {
    let (least, most, unit) = (Shown(Q::LEAST), Shown(Q::MOST), Q::UNIT);
    let shown = Shown(number);
    let (problem, remedy) = match number {
        _ if (Q::LEAST..=Q::MOST).contains(&number) => return Ok(number),
        _ if number > Q::MOST => {
            (format!("{shown} is beyond {most}{unit}"), format!("write a number from {least} to {most}{unit}"))
        }
        _ if Q::LEAST > 0.0 && number <= 0.0 => {
            (format!("{shown} is not positive"), format!("write a number above 0, from {least} to {most}{unit}"))
        }
        _ if Q::LEAST == 0.0 => {
            (format!("{shown} is negative"), format!("write a number of 0 or above, up to {most}{unit}"))
        }
        _ => (format!("{shown} is below {least}{unit}"), format!("write a number from {least} to {most}{unit}")),
    };
    Err(E::custom(format!("{problem}; {remedy}")))
}

/// A number of the quantity `Q`.
///
/// # Errors
/// Not a number, or beyond the quantity's bounds.
pub fn number_of<'de, Q: Quantity, N: Number, D: Deserializer<'de>>(deserializer: D) -> Result<N, D::Error> {
    Of::<Q>::deserialize(deserializer).map(|number| N::of(number.0))
}

/// A number of the quantity `Q` that may be left out (with `#[serde(default)]`).
///
/// # Errors
/// As [`number_of`].
pub fn optional_of<'de, Q: Quantity, N: Number, D: Deserializer<'de>>(deserializer: D) -> Result<Option<N>, D::Error> {
    number_of::<Q, N, D>(deserializer).map(Some)
}

/// A [`range`] of the quantity `Q`.
///
/// # Errors
/// As [`range`], or an end beyond the quantity's bounds.
pub fn range_of<'de, Q: Quantity, N: Number, D: Deserializer<'de>>(deserializer: D) -> Result<[N; 2], D::Error> {
    let [lower, upper] = range(deserializer)?;
    Ok([N::of(within::<Q, D::Error>(lower)?), N::of(within::<Q, D::Error>(upper)?)])
}

/// A [`range_of`] that may be left out (with `#[serde(default)]`).
///
/// # Errors
/// As [`range_of`].
pub fn optional_range_of<'de, Q: Quantity, N: Number, D: Deserializer<'de>>(
    deserializer: D,
) -> Result<Option<[N; 2]>, D::Error> {
    range_of::<Q, N, D>(deserializer).map(Some)
}

/// Whether a number is its default of 0, which resolved configs leave out.
pub fn is_zero(number: &f64) -> bool {
    *number == 0.0
}

/// A list of numbers of the quantity `Q`, of fixed length.
///
/// # Errors
/// Another length, or a number beyond the quantity's bounds.
pub fn list_of<'de, Q: Quantity, L: List<Q>, D: Deserializer<'de>>(deserializer: D) -> Result<L, D::Error> {
    L::read(deserializer)
}

/// A list of numbers of fixed length.
pub trait List<Q>: Sized {
    /// Reads it, element by element.
    ///
    /// # Errors
    /// As [`list_of`].
    fn read<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error>;
}

impl<Q: Quantity> List<Q> for [f64; 2] {
    fn read<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        <[Of<Q>; 2]>::deserialize(deserializer).map(|list| list.map(|number| number.0))
    }
}

impl<Q: Quantity> List<Q> for [f64; 3] {
    fn read<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        <[Of<Q>; 3]>::deserialize(deserializer).map(|list| list.map(|number| number.0))
    }
}

/// A quaternion w, x, y, z, brought to length 1.
///
/// # Errors
/// Not four numbers, or all of them next to zero.
pub fn quaternion<'de, D: Deserializer<'de>>(deserializer: D) -> Result<[f64; 4], D::Error> {
    let q = <[f64; 4]>::deserialize(deserializer)?;
    let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
    if !(1e-6..=1e6).contains(&length) {
        return Err(D::Error::custom("it turns nowhere; write a quaternion w, x, y, z, such as [1.0, 0.0, 0.0, 0.0]"));
    }
    // a quaternion of length 1 keeps its digits
    Ok(if (length - 1.0).abs() < 1e-12 { q } else { q.map(|x| x / length) })
}

/// Numbers of the quantity `Q` by name.
///
/// # Errors
/// A number beyond the quantity's bounds.
pub fn map_of<'de, Q: Quantity, D: Deserializer<'de>>(deserializer: D) -> Result<BTreeMap<String, f64>, D::Error> {
    let map = BTreeMap::<String, Of<Q>>::deserialize(deserializer)?;
    Ok(map.into_iter().map(|(name, number)| (name, number.0)).collect())
}

/// `[lower, upper]` with `lower <= upper`.
///
/// # Errors
/// Not two numbers, or in the wrong order.
pub fn range<'de, D: Deserializer<'de>>(deserializer: D) -> Result<[f64; 2], D::Error> {
    let ends = Vec::<f64>::deserialize(deserializer)?;
    let [lower, upper] = ends[..] else {
        return Err(D::Error::custom(format!("a range has two ends, not {}; write [lower, upper]", ends.len())));
    };
    if lower <= upper {
        Ok([lower, upper])
    } else {
        Err(D::Error::custom(format!("the lower end {lower} is above the upper end {upper}; write [lower, upper]")))
    }
}

/// `[fewest, most]` steps of delay, both included, up to [`MAX_DELAY`].
///
/// # Errors
/// Not two whole numbers, negative ones, too large ones, or in the wrong order.
pub fn step_range<'de, D: Deserializer<'de>>(deserializer: D) -> Result<[u32; 2], D::Error> {
    let [fewest, most] = <[u32; 2]>::deserialize(deserializer)?;
    if most > MAX_DELAY {
        Err(D::Error::custom(format!("{most} steps are too many; write at most {MAX_DELAY}")))
    } else if fewest <= most {
        Ok([fewest, most])
    } else {
        Err(D::Error::custom(format!("the lower end {fewest} is above the upper end {most}; write [fewest, most]")))
    }
}

/// A [`step_range`] that may be left out (with `#[serde(default)]`).
///
/// # Errors
/// As [`step_range`].
pub fn optional_step_range<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<[u32; 2]>, D::Error> {
    step_range(deserializer).map(Some)
}

/// A number above 0.
///
/// # Errors
/// Zero, negative or not a number.
pub fn positive<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    let value = f64::deserialize(deserializer)?;
    if value > 0.0 {
        Ok(value)
    } else {
        Err(D::Error::custom(format!("{value} is not positive; write a number above 0")))
    }
}

/// A number of 0 or above.
///
/// # Errors
/// Negative or not a number.
pub fn non_negative<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    let value = f64::deserialize(deserializer)?;
    if value >= 0.0 {
        Ok(value)
    } else {
        Err(D::Error::custom(format!("{value} is negative; write a number of 0 or above")))
    }
}

/// A share or probability, from 0 to 1.
///
/// # Errors
/// Outside 0 to 1.
pub fn fraction<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    let value = f64::deserialize(deserializer)?;
    if (0.0..=1.0).contains(&value) {
        Ok(value)
    } else {
        Err(D::Error::custom(format!("{value} is outside 0 to 1; write a share between 0 and 1")))
    }
}

/// A count of 1 or more.
///
/// # Errors
/// Zero, negative or not whole.
pub fn at_least_one<'de, D: Deserializer<'de>>(deserializer: D) -> Result<u32, D::Error> {
    match u32::deserialize(deserializer)? {
        0 => Err(D::Error::custom("0 is too few; write a whole number of 1 or above")),
        count => Ok(count),
    }
}

/// A count from 1 to `MOST`.
///
/// # Errors
/// Outside that, or not whole.
pub fn count_up_to<'de, const MOST: u32, D: Deserializer<'de>>(deserializer: D) -> Result<u32, D::Error> {
    match u32::deserialize(deserializer)? {
        0 => Err(D::Error::custom(format!("0 is too few; write a whole number from 1 to {MOST}"))),
        count if count > MOST => {
            Err(D::Error::custom(format!("{count} is too many; write a whole number from 1 to {MOST}")))
        }
        count => Ok(count),
    }
}

/// Shares of the envs by robot: whole numbers from 1 to 1000.
///
/// # Errors
/// Outside that, or not whole.
pub fn env_shares<'de, D: Deserializer<'de>>(deserializer: D) -> Result<BTreeMap<String, u32>, D::Error> {
    let shares = BTreeMap::<String, u32>::deserialize(deserializer)?;
    match shares.iter().find(|(_, share)| !(1..=1000).contains(*share)) {
        Some((robot, share)) => {
            Err(D::Error::custom(format!("{robot} = {share}: write a whole number from 1 to 1000")))
        }
        None => Ok(shares),
    }
}

/// The length of a physics step, s: from [`MIN_DT`] to [`MAX_DT`].
///
/// # Errors
/// Not [`positive`], shorter or longer.
pub fn physics_step<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    let value = positive(deserializer)?;
    if value < MIN_DT {
        Err(D::Error::custom(format!("{value:e} s is too short; write {MIN_DT:e} or above")))
    } else if value > MAX_DT {
        Err(D::Error::custom(format!("{} s is too long; write {MAX_DT} or below", Shown(value))))
    } else {
        Ok(value)
    }
}

/// A [`command_range`] that may be missing.
///
/// # Errors
/// As [`command_range`].
pub fn optional_command_range<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<[f64; 2]>, D::Error> {
    command_range(deserializer).map(Some)
}

/// A [`range`] of commands, within [`MAX_COMMAND`].
///
/// # Errors
/// As [`range`], or an end beyond it.
pub fn command_range<'de, D: Deserializer<'de>>(deserializer: D) -> Result<[f64; 2], D::Error> {
    let ends = range(deserializer)?;
    match ends.iter().find(|end| end.abs() > MAX_COMMAND) {
        None => Ok(ends),
        Some(end) => Err(D::Error::custom(format!(
            "the end {end:e} is beyond {MAX_COMMAND}; write ends from -{MAX_COMMAND} to {MAX_COMMAND}"
        ))),
    }
}
