//! Finds the fastest way to share robots between the CPU and a device, which have the same bits:
//! the ways take turns until it is known.

use std::time::{Duration, Instant};

/// Control steps of a turn.
const TURN: usize = 12;
/// Steps at the beginning of a turn that are not timed: caches hold the memory of the way before.
const NOT_TIMED: usize = 2;
/// Turns of each way.
const TURNS: usize = 3;
/// Least ratio of the CPU's time to that of a way with the device, for which the device is used: it
/// takes memory.
const LEAST_GAIN: f64 = 1.05;

/// The ways' times so far.
#[derive(Debug)]
pub(super) struct Trial {
    /// Numbers of morphologies on the device; the first is none.
    ways: Vec<usize>,
    steps: usize,
    begun: Option<Instant>,
    /// Times from one step's beginning to the next one's: the rows' memory costs the rest of a step
    /// too.
    times: Vec<Vec<Duration>>,
}

/// Outcome of a trial.
#[derive(Debug)]
pub(super) struct Verdict {
    /// Number of morphologies on the device.
    pub(super) best: usize,
    /// Median time of a step with each number.
    pub(super) times: Vec<(usize, Duration)>,
}

impl Trial {
    /// A trial of some numbers of morphologies on the device, the first of them 0.
    pub(super) fn new(ways: Vec<usize>) -> Self {
        let times = vec![Vec::new(); ways.len()];
        Self { ways, steps: 0, begun: None, times }
    }

    /// The number whose turn it is. A trial begins once the device is ready; each call is a step.
    pub(super) fn next(&mut self, now: Instant) -> usize {
        let way = |step: usize| step / TURN % self.ways.len();
        if let (Some(begun), Some(last)) = (self.begun, self.steps.checked_sub(1))
            && last % TURN >= NOT_TIMED
        {
            self.times[way(last)].push(now - begun);
        }
        self.begun = Some(now);
        self.steps += 1;
        self.ways[way(self.steps - 1)]
    }

    /// Median times, and the number that is to go on; none yet before all turns.
    pub(super) fn verdict(&mut self) -> Option<Verdict> {
        if self.steps <= self.ways.len() * TURN * TURNS {
            return None;
        }
        let median = |times: &mut Vec<Duration>| {
            times.sort_unstable();
            times[times.len() / 2]
        };
        let times: Vec<_> = self.ways.iter().copied().zip(self.times.iter_mut().map(median)).collect();
        let (_, alone) = *times.first()?;
        let gains =
            |&&(number, time): &&(usize, Duration)| number > 0 && alone.as_secs_f64() > LEAST_GAIN * time.as_secs_f64();
        let best = times.iter().filter(gains).min_by_key(|(_, time)| *time).map_or(0, |&(number, _)| number);
        Some(Verdict { best, times })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The number that wins if steps take these ms, one of each turn a slow one.
    fn winner(ms: &[(usize, u64)]) -> usize {
        let mut trial = Trial::new(ms.iter().map(|&(number, _)| number).collect());
        let (mut now, mut turns) = (Instant::now(), Vec::new());
        loop {
            let turn = trial.next(now);
            if let Some(verdict) = trial.verdict() {
                for &(number, _) in ms {
                    assert_eq!(turns.iter().filter(|&&turn| turn == number).count(), TURN * TURNS);
                }
                return verdict.best;
            }
            let time = ms.iter().find(|(number, _)| *number == turn).map_or(0, |&(_, ms)| ms);
            now += Duration::from_millis(if turns.len() % TURN == 5 { 100 * time } else { time });
            turns.push(turn);
        }
    }

    #[test]
    fn the_fastest_share_goes_on_and_the_cpu_where_there_is_no_difference() {
        assert_eq!(winner(&[(0, 30), (8, 20)]), 8);
        assert_eq!(winner(&[(0, 20), (8, 30)]), 0);
        assert_eq!(winner(&[(0, 20), (8, 20)]), 0);
        assert_eq!(winner(&[(0, 30), (3, 20), (5, 18), (8, 25)]), 5);
        assert_eq!(winner(&[(0, 200), (3, 195), (5, 300), (8, 400)]), 0);
    }
}
