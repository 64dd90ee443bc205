//! The workers of a training: processes that each have some of the parts, and sum results in the
//! order of the tree.

use std::ops::Range;

use crate::lines::{Line, WIDTH};
use crate::rollout::parts_of;
use crate::settings::LearnerError;
use crate::tree::{NUMBERS, Term, Tree, halves};

/// Bytes of a term in a message.
const BYTES: usize = size_of::<[f64; NUMBERS]>();

/// Connects the workers of a training. All of them call the same functions in the same order.
pub trait Peers: Send + Sync {
    /// Gathers the bytes of all workers, in their order: `mine` of each, all of one length.
    ///
    /// # Errors
    /// A worker is gone.
    fn gather(&self, mine: &[u8]) -> Result<Vec<u8>, LearnerError>;

    /// Cuts `mine` into a piece of one length for each worker, in their order; returns the pieces
    /// for this worker, in the order of their senders.
    ///
    /// # Errors
    /// A worker is gone.
    fn exchange(&self, mine: &[u8]) -> Result<Vec<u8>, LearnerError>;
}

/// A worker among the workers of a training.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Worker {
    /// Number of the worker, counted from 0.
    pub index: usize,
    /// Number of workers.
    pub count: usize,
}

impl Worker {
    /// A worker without peers.
    pub const ALONE: Self = Self { index: 0, count: 1 };

    /// The envs that it simulates, of `num_envs` in all: whole parts, as many as the others have or
    /// one more.
    ///
    /// # Errors
    /// There are fewer parts than workers, or no worker of this number.
    pub fn envs(self, num_envs: usize) -> Result<Range<usize>, LearnerError> {
        let parts: Vec<_> = parts_of(num_envs).collect();
        let own = self.parts(parts.len()).ok_or_else(|| {
            let (count, most) = (self.count, parts.len());
            let problem = format!("{num_envs} envs are {most} blocks, too few for {count} workers: use at most {most}");
            LearnerError::new("workers", problem)
        })?;
        Ok(parts[own.start].start..parts[own.end - 1].end)
    }

    /// The parts that it has, of `count` in all.
    pub(crate) fn parts(self, count: usize) -> Option<Range<usize>> {
        let first = |worker: usize| worker * count / self.count;
        (self.index < self.count && self.count <= count).then(|| first(self.index)..first(self.index + 1))
    }
}

/// Shares of the workers in the sums of parts, and the order of further sums.
pub(crate) struct Shares {
    pub(crate) worker: Worker,
    /// Whole subtrees of this worker's parts, counted from its first one.
    pub(crate) nodes: Vec<(Range<usize>, Tree)>,
    /// Number of subtrees of each worker.
    counts: Vec<usize>,
    /// Largest number of subtrees of a worker.
    most: usize,
    /// The tree over the subtrees of all workers.
    pub(crate) top: Tree,
}

impl Shares {
    /// Shares of `count` parts; each worker has some.
    pub(crate) fn new(worker: Worker, count: usize) -> Self {
        let all: Vec<Vec<Range<usize>>> = (0..worker.count)
            .map(|index| {
                let own = Worker { index, ..worker }.parts(count).unwrap_or_default();
                let mut nodes = Vec::new();
                subtrees(&own, 0..count, &mut nodes);
                nodes
            })
            .collect();
        let first = worker.parts(count).map_or(0, |own| own.start);
        let own = |node: &Range<usize>| (node.start - first..node.end - first, Tree::of_parts(node.len()));
        Self {
            worker,
            nodes: all.get(worker.index).into_iter().flatten().map(own).collect(),
            counts: all.iter().map(Vec::len).collect(),
            most: all.iter().map(Vec::len).max().unwrap_or(0),
            top: Tree::new(0..count, &|parts| all.iter().flatten().any(|node| node == parts)),
        }
    }

    /// Whether there are no other workers.
    pub(crate) fn is_alone(&self) -> bool {
        self.worker.count == 1
    }

    /// The sum of some lists over the parts of all workers, term by term; `parts` has a list for
    /// each part of this worker.
    pub(crate) fn sum<T: Term>(&self, peers: &dyn Peers, parts: &[Vec<T>]) -> Result<Vec<T>, LearnerError> {
        let length = parts.first().map_or(0, Vec::len);
        let add = |mut left: Vec<T>, right: Vec<T>| {
            left.iter_mut().zip(right).for_each(|(left, right)| *left = left.add(right));
            left
        };
        let node = |(node, tree): &(Range<usize>, Tree)| tree.fold(parts[node.clone()].iter().cloned(), add);
        let own: Vec<Vec<T>> = self.nodes.iter().filter_map(node).collect();
        let leaves = if self.is_alone() {
            own
        } else {
            let mut message = Message::default();
            own.iter().flatten().for_each(|term| message.numbers(&term.numbers()));
            let size = BYTES * length;
            let nodes = self.gather(peers, message, size)?;
            nodes.iter().map(|node| node.chunks_exact(BYTES).map(term).collect()).collect()
        };
        Ok(self.top.fold(leaves, add).unwrap_or_default())
    }

    /// Messages of all workers about their subtrees, `size` bytes each; in the order of the
    /// subtrees.
    pub(crate) fn gather(&self, peers: &dyn Peers, mine: Message, size: usize) -> Result<Vec<Vec<u8>>, LearnerError> {
        let mut mine = mine.0;
        mine.resize(self.most * size, 0);
        self.cut(&peers.gather(&mine)?, size)
    }

    /// Exchanges a piece of each message; `piece` writes this worker's part about its subtrees for
    /// another worker.
    pub(crate) fn exchange(
        &self,
        peers: &dyn Peers,
        piece: impl Fn(usize, &mut Message),
        size: usize,
    ) -> Result<Vec<Vec<u8>>, LearnerError> {
        let mut mine = Message::default();
        for worker in 0..self.worker.count {
            piece(worker, &mut mine);
            mine.0.resize((worker + 1) * self.most * size, 0);
        }
        self.cut(&peers.exchange(&mine.0)?, size)
    }

    fn cut(&self, all: &[u8], size: usize) -> Result<Vec<Vec<u8>>, LearnerError> {
        if all.len() != self.worker.count * self.most * size {
            let problem = format!("{} bytes came of {} workers", all.len(), self.worker.count);
            return Err(LearnerError::new("workers", problem));
        }
        let of_worker = all.chunks_exact((self.most * size).max(1)).zip(&self.counts);
        Ok(of_worker.flat_map(|(of, &count)| of.chunks_exact(size.max(1)).take(count).map(<[u8]>::to_vec)).collect())
    }
}

/// The largest subtrees that lie within `own`, in order.
fn subtrees(own: &Range<usize>, parts: Range<usize>, nodes: &mut Vec<Range<usize>>) {
    if own.start <= parts.start && parts.end <= own.end {
        nodes.push(parts);
    } else if own.start < parts.end && parts.start < own.end {
        for half in halves(&parts) {
            subtrees(own, half, nodes);
        }
    }
}

/// Bytes that workers send: numbers, little endian.
#[derive(Default)]
pub(crate) struct Message(Vec<u8>);

impl Message {
    pub(crate) fn numbers(&mut self, numbers: &[f64]) {
        self.0.extend(numbers.iter().flat_map(|x| x.to_le_bytes()));
    }

    pub(crate) fn into_bytes(self) -> Vec<u8> {
        self.0
    }

    pub(crate) fn lines(&mut self, lines: &[Line]) {
        self.0.reserve(size_of_val(lines));
        for line in lines {
            let mut bytes = [0; 4 * WIDTH];
            for (to, x) in bytes.as_chunks_mut::<4>().0.iter_mut().zip(line.0) {
                *to = x.to_le_bytes();
            }
            self.0.extend_from_slice(&bytes);
        }
    }
}

/// A term of a message.
pub(crate) fn term<T: Term>(bytes: &[u8]) -> T {
    let mut numbers = [0.0; NUMBERS];
    for (x, bytes) in numbers.iter_mut().zip(bytes.as_chunks::<8>().0) {
        *x = f64::from_le_bytes(*bytes);
    }
    T::from_numbers(numbers)
}

/// Lines of a message.
pub(crate) fn lines(bytes: &[u8]) -> Vec<Line> {
    let line = |bytes: &[u8; 4 * WIDTH]| {
        let mut line = Line::ZERO;
        for (x, bytes) in line.0.iter_mut().zip(bytes.as_chunks::<4>().0) {
            *x = f32::from_le_bytes(*bytes);
        }
        line
    };
    bytes.as_chunks::<{ 4 * WIDTH }>().0.iter().map(line).collect()
}

/// No other worker.
pub(crate) struct Alone;

impl Peers for Alone {
    fn gather(&self, mine: &[u8]) -> Result<Vec<u8>, LearnerError> {
        Ok(mine.to_vec())
    }
    fn exchange(&self, mine: &[u8]) -> Result<Vec<u8>, LearnerError> {
        Ok(mine.to_vec())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn workers_share_out_whole_blocks() {
        assert_eq!(Worker { index: 1, count: 2 }.envs(4096).unwrap(), 2048..4096);
        assert_eq!(Worker { index: 0, count: 3 }.envs(72).unwrap(), 0..18);
        assert_eq!(Worker { index: 2, count: 3 }.envs(72).unwrap(), 36..72);
        let refused = Worker { index: 0, count: 5 }.envs(72).unwrap_err();
        assert!(refused.to_string().contains("at most 4"), "{refused}");
        assert!(Worker { index: 2, count: 2 }.envs(72).is_err());
    }

    #[test]
    fn subtrees_are_all_parts_once() {
        for count in [1, 4, 12, 32] {
            for workers in 1..=count {
                let shares: Vec<_> =
                    (0..workers).map(|index| Shares::new(Worker { index, count: workers }, count)).collect();
                let nodes: Vec<usize> =
                    shares.iter().flat_map(|of| of.nodes.iter().map(|(node, _)| node.len())).collect();
                assert_eq!(nodes.iter().sum::<usize>(), count);
                assert_eq!(shares[0].top.fold(nodes, |a, b| a + b), Some(count));
                if count % workers == 0 && workers.is_power_of_two() {
                    assert!(shares.iter().all(|of| of.most == 1), "{workers} workers with {count} parts");
                }
            }
        }
    }
}
