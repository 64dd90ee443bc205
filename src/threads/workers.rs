//! Threads that share out rows of work in chunks.
//!
//! Chunks only share out rows; what happens to a row does not depend on its chunk. Results are
//! therefore bitwise the same for any number of threads.

use std::sync::{Mutex, PoisonError};

use bevy_ecs::prelude::*;

use crate::bounds::MAX_THREADS;
use crate::dynamics::lanes::{self, Real, Simd, SimdDispatch, SimdToken};
use crate::thread_team::ThreadTeam;

/// Something with rows that can be cut in two.
pub trait SplitRows: Sized + Send {
    /// The first `n` rows, and the rest.
    fn split_rows(self, n: usize) -> (Self, Self);
}

impl<T: Sync> SplitRows for &[T] {
    fn split_rows(self, n: usize) -> (Self, Self) {
        self.split_at(n)
    }
}

impl<T: Send> SplitRows for &mut [T] {
    fn split_rows(self, n: usize) -> (Self, Self) {
        self.split_at_mut(n)
    }
}

impl<R: SplitRows> SplitRows for Option<R> {
    fn split_rows(self, n: usize) -> (Self, Self) {
        self.map_or((None, None), |rows| {
            let (first, rest) = rows.split_rows(n);
            (Some(first), Some(rest))
        })
    }
}

/// A row-major matrix, by rows.
pub struct MatrixRows<'a, T> {
    /// Numbers of all rows, one row after the other.
    pub data: &'a mut [T],
    /// Numbers in a row.
    pub width: usize,
}

impl<T> MatrixRows<'_, T> {
    /// Numbers of row `i`, `[width]`.
    pub fn row(&mut self, i: usize) -> &mut [T] {
        &mut self.data[i * self.width..(i + 1) * self.width]
    }
}

impl<T: Send> SplitRows for MatrixRows<'_, T> {
    fn split_rows(self, n: usize) -> (Self, Self) {
        let (a, b) = self.data.split_at_mut(n * self.width);
        (Self { data: a, width: self.width }, Self { data: b, width: self.width })
    }
}

macro_rules! split_tuple {
    ($($name:ident $a:ident $b:ident),*) => {
        impl<$($name: SplitRows),*> SplitRows for ($($name,)*) {
            #[allow(non_snake_case)]
            fn split_rows(self, n: usize) -> (Self, Self) {
                let ($($name,)*) = self;
                $(let ($a, $b) = $name.split_rows(n);)*
                (($($a,)*), ($($b,)*))
            }
        }
    };
}
split_tuple!(A a1 a2, B b1 b2);
split_tuple!(A a1 a2, B b1 b2, C c1 c2);
split_tuple!(A a1 a2, B b1 b2, C c1 c2, D d1 d2);
split_tuple!(A a1 a2, B b1 b2, C c1 c2, D d1 d2, E e1 e2);
split_tuple!(A a1 a2, B b1 b2, C c1 c2, D d1 d2, E e1 e2, F f1 f2);
split_tuple!(A a1 a2, B b1 b2, C c1 c2, D d1 d2, E e1 e2, F f1 f2, G g1 g2);
split_tuple!(A a1 a2, B b1 b2, C c1 c2, D d1 d2, E e1 e2, F f1 f2, G g1 g2, H h1 h2);
split_tuple!(A a1 a2, B b1 b2, C c1 c2, D d1 d2, E e1 e2, F f1 f2, G g1 g2, H h1 h2, I i1 i2);
split_tuple!(A a1 a2, B b1 b2, C c1 c2, D d1 d2, E e1 e2, F f1 f2, G g1 g2, H h1 h2, I i1 i2, J j1 j2);
split_tuple!(A a1 a2, B b1 b2, C c1 c2, D d1 d2, E e1 e2, F f1 f2, G g1 g2, H h1 h2, I i1 i2, J j1 j2, K k1 k2);
split_tuple!(A a1 a2, B b1 b2, C c1 c2, D d1 d2, E e1 e2, F f1 f2, G g1 g2, H h1 h2, I i1 i2, J j1 j2, K k1 k2, L l1 l2);
split_tuple!(A a1 a2, B b1 b2, C c1 c2, D d1 d2, E e1 e2, F f1 f2, G g1 g2, H h1 h2, I i1 i2, J j1 j2, K k1 k2, L l1 l2, M m1 m2);
split_tuple!(A a1 a2, B b1 b2, C c1 c2, D d1 d2, E e1 e2, F f1 f2, G g1 g2, H h1 h2, I i1 i2, J j1 j2, K k1 k2, L l1 l2, M m1 m2, N n1 n2);

/// The threads of a simulation: the caller's and `threads - 1` workers; and the instruction set of
/// its rows.
#[derive(Resource)]
pub struct Workers {
    team: Option<ThreadTeam>,
    threads: usize,
    dispatch: SimdDispatch,
    simd: SimdToken,
}

/// Least number of rows of a task; below it, starting a task costs more than it saves.
const MIN_CHUNK: usize = 64;
/// Rows per thread that justify another thread: each costs the others some time when they take
/// their tasks.
const ROWS_PER_THREAD: usize = 256;
/// Chunks per thread, so that a thread that falls behind does not hold up the rest.
const CHUNKS_PER_THREAD: usize = 4;

impl Workers {
    /// Workers with `threads` threads, at least one.
    pub fn new(threads: usize, simd: Simd) -> Self {
        let threads = threads.max(1);
        let team = (threads > 1).then(|| ThreadTeam::new(threads - 1));
        Self { team, threads, dispatch: simd.dispatch(), simd: simd.token().unwrap_or(SimdToken::Portable) }
    }

    /// Workers with `threads` threads, all cores when absent. There are no more threads than pieces
    /// of work, since the others would only take memory, nor than [`MAX_THREADS`].
    pub fn for_pieces(threads: Option<usize>, pieces: usize, simd: Simd) -> Self {
        let threads = threads.unwrap_or_else(|| std::thread::available_parallelism().map_or(1, Into::into));
        Self::new(threads.min(pieces).min(MAX_THREADS), simd)
    }

    /// Dispatcher into code compiled for the instruction set.
    pub fn dispatch(&self) -> SimdDispatch {
        self.dispatch
    }

    /// The instruction set, for kernels in lanes; plain code if this machine lacks it.
    pub fn simd(&self) -> SimdToken {
        self.simd
    }

    /// Threads at work, the caller's included.
    pub fn threads(&self) -> usize {
        self.threads
    }

    /// Best number of chunks for work on many rows.
    pub fn num_chunks(&self) -> usize {
        if self.threads == 1 { 1 } else { self.threads * CHUNKS_PER_THREAD }
    }

    /// Number of the `left` pieces of work that the next task takes: the first tasks are large and
    /// the last ones small, so that the threads end together and few tasks are started. It is at
    /// least `min` while `left` allows; one thread takes all.
    pub fn share(&self, left: usize, min: usize) -> usize {
        share(left, min, self.threads)
    }

    /// Calls `f(first row, rows)` on chunks that together are all `len` rows.
    pub fn for_each_chunk<R: SplitRows>(&self, rows: R, len: usize, f: impl Fn(usize, usize, R) + Sync) {
        self.for_each_chunk_of(std::iter::once(((), len, rows)), len, |(), first, n, rows| f(first, n, rows));
    }

    /// Calls `f(piece, first row, number of rows, rows)` on chunks of pieces, each given with its
    /// number of rows; these add up to at most `len`. No chunk has rows of two pieces.
    pub fn for_each_chunk_of<P: Copy + Send, R: SplitRows>(
        &self,
        pieces: impl Iterator<Item = (P, usize, R)>,
        len: usize,
        f: impl Fn(P, usize, usize, R) + Sync,
    ) {
        let threads = self.threads.min(len.div_ceil(ROWS_PER_THREAD).max(2));
        let Some(team) = self.team.as_ref().filter(|_| len > MIN_CHUNK) else {
            return pieces.for_each(|(piece, n, rows)| f(piece, 0, n, rows));
        };
        let chunks = Chunks { pieces, rest: None, left: len, threads };
        team.for_each(chunks, threads, |(piece, first, n, part)| f(piece, first, n, part));
    }

    /// Runs `f(task)` on every task, in parallel.
    pub fn for_each<T: Send>(&self, tasks: impl Iterator<Item = T>, f: impl Fn(T) + Sync) {
        match &self.team {
            Some(team) => team.for_each(tasks, self.threads, f),
            None => tasks.for_each(f),
        }
    }
}

/// Cuts pieces into chunks: their piece, first row, number of rows, and the rows.
struct Chunks<I, P, R> {
    pieces: I,
    /// Rows of a piece that are left.
    rest: Option<(P, usize, usize, R)>,
    /// Number of rows that are left, at most.
    left: usize,
    threads: usize,
}

impl<P: Copy, R: SplitRows, I: Iterator<Item = (P, usize, R)>> Iterator for Chunks<I, P, R> {
    type Item = (P, usize, usize, R);

    #[inline]
    fn next(&mut self) -> Option<Self::Item> {
        let next = || self.pieces.next().map(|(piece, n, rows)| (piece, 0, n, rows));
        let (piece, first, n, rows) = self.rest.take().or_else(next)?;
        let taken = share(self.left, MIN_CHUNK, self.threads).min(n);
        self.left -= taken;
        if taken == n {
            return Some((piece, first, n, rows));
        }
        let (part, more) = rows.split_rows(taken);
        self.rest = Some((piece, first + taken, n - taken, more));
        Some((piece, first, taken, part))
    }

    /// Each chunk ends its piece, or has [`MIN_CHUNK`] rows.
    fn size_hint(&self) -> (usize, Option<usize>) {
        let cuts = self.left / MIN_CHUNK + usize::from(self.rest.is_some());
        (0, self.pieces.size_hint().1.map(|pieces| pieces + cuts))
    }
}

/// Packs that `count` envs of a kind make on the narrowest instruction set.
pub(crate) fn packs_of(count: usize) -> usize {
    count.div_ceil(lanes::Portable::LANES)
}

/// See [`Workers::share`].
fn share(left: usize, min: usize, threads: usize) -> usize {
    if threads == 1 { left } else { (left / (2 * threads)).max(min).min(left) }
}

/// Scratch memory of the threads. The result of a task must not depend on the piece that it gets.
pub struct Pool<T> {
    first: Mutex<T>,
    others: Vec<Mutex<T>>,
}

impl<T> Pool<T> {
    /// A pool with a piece for each of `threads` threads, at least one.
    pub fn new(threads: usize, make: impl Fn() -> T) -> Self {
        let others = (1..threads).map(|_| Mutex::new(make())).collect();
        Self { first: Mutex::new(make()), others }
    }

    /// Borrows a piece of scratch memory that no other thread uses; blocks if all are in use.
    #[inline]
    pub fn with<R>(&self, f: impl FnOnce(&mut T) -> R) -> R {
        let free = self.others.iter().find_map(|piece| piece.try_lock().ok());
        // a panic in a task ends the simulation, whatever is left in the scratch memory
        let mut piece = free.unwrap_or_else(|| self.first.lock().unwrap_or_else(PoisonError::into_inner));
        f(&mut piece)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chunks_are_all_rows_and_shrink() {
        for threads in [1, 2, 3, 8] {
            let workers = Workers::new(threads, Simd::Portable);
            for len in [0, 1, 63, 64, 65, 1000, 4097] {
                let mut rows = vec![0; len];
                let sizes = Mutex::new(vec![0; len]);
                workers.for_each_chunk(&mut rows[..], len, |first, n, rows: &mut [usize]| {
                    assert_eq!(rows.len(), n);
                    if n > 0 {
                        sizes.lock().unwrap()[first] = n;
                    }
                    rows.iter_mut().enumerate().for_each(|(i, row)| *row += first + i + 1);
                });
                assert!(rows.iter().enumerate().all(|(i, &row)| row == i + 1), "{threads} threads, {len} rows");
                let sizes: Vec<usize> = sizes.into_inner().unwrap().into_iter().filter(|&n| n > 0).collect();
                assert_eq!(sizes.iter().sum::<usize>(), len);
                assert!(sizes.is_sorted_by(|a, b| a >= b), "{threads} threads, {len} rows: {sizes:?}");
            }
        }
    }
}
