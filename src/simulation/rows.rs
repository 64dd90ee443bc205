//! Arguments that hold one value, one row, or one row per env.

use crate::error::Error;

/// Envs that an operation is about.
pub(super) enum EnvIds<'a> {
    All(usize),
    Some(&'a [usize]),
}

impl<'a> EnvIds<'a> {
    pub(super) fn new(env_ids: Option<&'a [usize]>, num_envs: usize) -> Result<Self, Error> {
        let Some(ids) = env_ids else {
            return Ok(Self::All(num_envs));
        };
        match ids.iter().find(|&&id| id >= num_envs) {
            Some(bad) => Err(Error::argument(
                "env_ids",
                format!("there is no env {bad}"),
                format!("this simulation has the envs 0 to {}", num_envs - 1),
            )),
            None => Ok(Self::Some(ids)),
        }
    }

    pub(super) fn len(&self) -> usize {
        match self {
            Self::All(n) => *n,
            Self::Some(ids) => ids.len(),
        }
    }

    /// The env of row `i`.
    pub(super) fn get(&self, i: usize) -> usize {
        match self {
            Self::All(_) => i,
            Self::Some(ids) => ids[i],
        }
    }
}

/// A row of `width` numbers for each of some envs: given once, one for each, or as one number.
#[derive(Clone, Copy)]
pub(super) struct Rows<'a> {
    values: &'a [f64],
    width: usize,
}

impl<'a> Rows<'a> {
    /// Checks the length, 1, `width` or `rows * width`, and that all are finite in single
    /// precision.
    pub(super) fn of_joints(
        element: &'static str,
        values: &'a [f64],
        width: usize,
        rows: usize,
    ) -> Result<Self, Error> {
        let rows = Self::of_limits(element, values, width, rows)?;
        check_finite(element, values, width)?;
        Ok(rows)
    }

    /// Like [`of_joints`](Self::of_joints), for numbers that may be infinite.
    pub(super) fn of_limits(
        element: &'static str,
        values: &'a [f64],
        width: usize,
        rows: usize,
    ) -> Result<Self, Error> {
        if values.len() == 1 { Ok(Self { values, width }) } else { Self::of_length(element, values, width, rows) }
    }

    /// Vectors of each env: like [`of_joints`](Self::of_joints), without the single number.
    pub(super) fn vectors(element: &'static str, values: &'a [f64], width: usize, rows: usize) -> Result<Self, Error> {
        let rows = Self::of_length(element, values, width, rows)?;
        check_finite(element, values, width)?;
        Ok(rows)
    }

    fn of_length(element: &'static str, values: &'a [f64], width: usize, rows: usize) -> Result<Self, Error> {
        if values.len() != width && values.len() != rows * width {
            return Err(Error::argument(
                element,
                format!("{} numbers", values.len()),
                format!("pass {width}, the same in every env, or {rows} x {width}"),
            ));
        }
        Ok(Self { values, width })
    }

    /// Zero everywhere.
    pub(super) fn zero() -> Self {
        Self { values: &[0.0], width: 1 }
    }

    /// One row per env, already checked.
    pub(super) fn per_env(values: &'a [f64], width: usize) -> Self {
        Self { values, width }
    }

    /// Number `k` of row `i`.
    #[inline]
    pub(super) fn get(&self, i: usize, k: usize) -> f64 {
        if self.values.len() == 1 {
            self.values[0]
        } else if self.values.len() == self.width {
            self.values[k]
        } else {
            self.values[i * self.width + k]
        }
    }

    /// Row `i`, or the single number.
    #[inline]
    pub(super) fn row(&self, i: usize) -> &'a [f64] {
        if self.values.len() <= self.width { self.values } else { &self.values[i * self.width..(i + 1) * self.width] }
    }

    /// The first three numbers of row `i`.
    pub(super) fn vector(&self, i: usize) -> [f64; 3] {
        std::array::from_fn(|k| self.get(i, k))
    }
}

fn check_finite(element: &'static str, values: &[f64], width: usize) -> Result<(), Error> {
    let Some(at) = values.iter().position(|x| !(*x as f32).is_finite()) else {
        return Ok(());
    };
    let place = if values.len() > width {
        format!("row {}, column {}", at / width.max(1), at % width.max(1))
    } else {
        format!("[{at}]")
    };
    Err(Error::argument(
        element,
        format!("{} at {place}", values[at]),
        "pass numbers that are finite in single precision",
    ))
}
