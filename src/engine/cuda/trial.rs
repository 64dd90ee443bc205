//! Finds the faster of two engines with the same bits: they take turns until it is known.

use std::time::{Duration, Instant};

/// Control steps of a turn.
const TURN: usize = 12;
/// Steps at the beginning of a turn that are not timed: caches hold the other engine's memory.
const NOT_TIMED: usize = 2;
/// Turns of each engine.
const TURNS: usize = 3;
/// How much faster the device must be: it takes memory, and a core waits for it.
const LEAST_GAIN: f64 = 1.05;

/// Maker of the steps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Turn {
    Cpu,
    Device,
}

/// The engines' times so far.
#[derive(Default)]
pub(super) struct Trial {
    steps: usize,
    begun: Option<Instant>,
    /// From one step's beginning to the next one's: the rows' memory costs the rest of a step too.
    cpu: Vec<Duration>,
    device: Vec<Duration>,
}

impl Trial {
    /// The engine whose turn it is. A trial begins once the device is ready; each call is a step.
    pub(super) fn next(&mut self, now: Instant) -> Turn {
        let turn = |step: usize| if (step / TURN).is_multiple_of(2) { Turn::Cpu } else { Turn::Device };
        if let (Some(begun), Some(last)) = (self.begun, self.steps.checked_sub(1))
            && last % TURN >= NOT_TIMED
        {
            let times = if turn(last) == Turn::Cpu { &mut self.cpu } else { &mut self.device };
            times.push(now - begun);
        }
        self.begun = Some(now);
        self.steps += 1;
        turn(self.steps - 1)
    }

    /// Median times of a step with the CPU and with the device, and the one that is to go on; none
    /// yet before all turns.
    pub(super) fn verdict(&mut self) -> Option<(Turn, [Duration; 2])> {
        if self.steps <= 2 * TURN * TURNS {
            return None;
        }
        let [cpu, device] = [&mut self.cpu, &mut self.device].map(|times| {
            times.sort_unstable();
            times[times.len() / 2]
        });
        let gains = cpu.as_secs_f64() > LEAST_GAIN * device.as_secs_f64();
        Some((if gains { Turn::Device } else { Turn::Cpu }, [cpu, device]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Steps of `cpu` and `device` ms, one of each turn a slow one.
    fn winner(cpu: u64, device: u64) -> Turn {
        let (mut trial, mut now) = (Trial::default(), Instant::now());
        let mut turns = Vec::new();
        loop {
            let turn = trial.next(now);
            if let Some((turn, _)) = trial.verdict() {
                assert_eq!(turns.len(), 2 * TURN * TURNS);
                assert_eq!(turns.iter().filter(|&&turn| turn == Turn::Device).count(), TURN * TURNS);
                return turn;
            }
            let ms = if turn == Turn::Cpu { cpu } else { device };
            now += Duration::from_millis(if turns.len() % TURN == 5 { 100 * ms } else { ms });
            turns.push(turn);
        }
    }

    #[test]
    fn the_faster_engine_goes_on_and_the_cpu_where_there_is_no_difference() {
        assert_eq!(winner(30, 20), Turn::Device);
        assert_eq!(winner(20, 30), Turn::Cpu);
        assert_eq!(winner(20, 20), Turn::Cpu);
    }
}
