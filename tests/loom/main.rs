//! The thread team of `src/threads/thread_team.rs` under loom, which runs each test once for every
//! order in which the threads' steps can follow one another, weak memory included. `make test` runs
//! it; it is a program, so that the unit tests of that file stay out of it.

mod sync;
#[path = "../../src/threads/thread_team.rs"]
mod thread_team;

use loom::cell::UnsafeCell;
use loom::model::Builder;

use thread_team::ThreadTeam;

/// SharedArray that loom watches: two accesses that nothing keeps apart, one of them a write, fail
/// the test.
struct Watched(Vec<UnsafeCell<u32>>);

// SAFETY: loom checks every access
unsafe impl Sync for Watched {}

impl Watched {
    fn zeros(count: usize) -> Self {
        Self((0..count).map(|_| UnsafeCell::new(0)).collect())
    }

    fn increase(&self, index: usize) {
        // SAFETY: loom fails the test if another thread is at it
        self.0[index].with_mut(|number| unsafe { *number += 1 });
    }

    fn all(&self) -> Vec<u32> {
        // SAFETY: as above
        self.0.iter().map(|cell| cell.with(|number| unsafe { *number })).collect()
    }
}

/// Tries every order with at most `switches` switches away from a thread that could go on.
fn explore(switches: usize, test: impl Fn() + Send + Sync + 'static) {
    let mut builder = Builder::new();
    builder.preemption_bound = Some(switches);
    builder.check(test);
}

fn main() {
    let tests: [(&str, fn()); 4] = [
        ("a job has ended everywhere when the call returns", a_job_has_ended_everywhere_when_the_call_returns),
        (
            "jobs follow one another whether helpers are awake or asleep",
            jobs_follow_one_another_whether_helpers_are_awake_or_asleep,
        ),
        ("two helpers share a job", two_helpers_share_a_job),
        ("a job within a job is done", a_job_within_a_job_is_done),
    ];
    for (name, test) in tests {
        println!("{name} ...");
        test();
    }
    println!("loom: {} tests passed", tests.len());
}

fn a_job_has_ended_everywhere_when_the_call_returns() {
    explore(3, || {
        let (team, numbers) = (ThreadTeam::new(1), Watched::zeros(2));
        team.for_each(0..2, 2, |i| numbers.increase(i));
        // the caller's memory is its own again: loom would see a helper that still writes
        assert_eq!(numbers.all(), [1, 1]);
    });
}

fn jobs_follow_one_another_whether_helpers_are_awake_or_asleep() {
    explore(2, || {
        let team = ThreadTeam::new(1);
        for _ in 0..2 {
            let numbers = Watched::zeros(2);
            team.for_each(0..2, 2, |i| numbers.increase(i));
            assert_eq!(numbers.all(), [1, 1]);
        }
    });
}

fn two_helpers_share_a_job() {
    explore(2, || {
        let (team, numbers) = (ThreadTeam::new(2), Watched::zeros(3));
        team.for_each(0..3, 3, |i| numbers.increase(i));
        assert_eq!(numbers.all(), [1, 1, 1]);
    });
}

fn a_job_within_a_job_is_done() {
    explore(2, || {
        let (team, numbers) = (ThreadTeam::new(1), Watched::zeros(2));
        team.for_each(0..2, 2, |i| team.for_each(0..1, 2, |_| numbers.increase(i)));
        assert_eq!(numbers.all(), [1, 1]);
    });
}
