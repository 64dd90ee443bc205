"""One definition of walking: its commands, its figures and its bounds, for every simulator."""

import dataclasses
import json
import math

import numpy as np
import pytest

from polypod.evaluation import walking
from polypod.evaluation.results import finite, succeeds
from polypod.evaluation.walking import BOX, KINDS, SIDE, STOP, TURN, Record, Schedule, Walking

BOXES = {
    "whole": {"lin_vel_x": (-1.0, 1.0), "lin_vel_y": (-1.0, 1.0), "ang_vel_z": (-1.0, 1.0)},
    "small": {"lin_vel_x": (-0.3, 0.3), "lin_vel_y": (-0.15, 0.15), "ang_vel_z": (-0.4, 0.4)},
    "one way": {"lin_vel_x": (0.0, 1.0), "lin_vel_y": (-0.5, 0.0), "ang_vel_z": (0.0, 0.7)},
    "no side-steps": {"lin_vel_x": (0.0, 1.0), "lin_vel_y": (0.0, 0.0), "ang_vel_z": (-1.0, 1.0)},
    "straight": {"lin_vel_x": (-1.0, 1.0), "lin_vel_y": (0.0, 0.0), "ang_vel_z": (0.0, 0.0)},
    "never slow": {"lin_vel_x": (0.5, 1.0), "lin_vel_y": (-1.0, 1.0), "ang_vel_z": (-1.0, 1.0)},
}
HAS = {
    "whole": KINDS,
    "small": KINDS,
    "one way": KINDS,
    "no side-steps": (BOX, TURN, STOP),
    "straight": (BOX, STOP),
    "never slow": (BOX, STOP),
}
STEPS, DT = 1000, 0.02


def drawn(box="whole", num_envs=64, steps=STEPS, seed=0):
    return Schedule.draw(BOXES[box], num_envs, steps, DT, seed)


def follows(commands, step, since):
    """A robot that does as it is told at once."""
    return commands.astype(np.float64)


def measured(motion, box="whole", num_envs=64, seed=0, falls=0):
    """Figures of robots that move as `motion(commands, step, time) -> [envs, 3]` says.

    Time counts since the command.
    """
    schedule = drawn(box, num_envs, seed=seed)
    record = Record(schedule, DT)
    falling = np.arange(num_envs) < falls
    for step in range(STEPS):
        moved = motion(schedule.at(step), step, step % schedule.steps_per_segment * DT)
        record.add(moved[:, :2], moved[:, 2], falling & (step == 700))
    return record.walking()


# the schedule


@pytest.mark.parametrize("box", BOXES)
@pytest.mark.parametrize("num_envs", [1, 2, 3, 16, 64])
def test_every_robot_turns_sidesteps_and_stops_with_any_number_of_envs(box, num_envs):
    schedule = drawn(box, num_envs)
    assert schedule.kinds.shape == (4, num_envs)
    assert walking.kinds_of(BOXES[box]) == HAS[box]
    counts = {kind: int((schedule.kinds == kind).sum()) for kind in KINDS}
    assert counts[TURN] == num_envs * (TURN in HAS[box])
    assert counts[SIDE] == num_envs * (SIDE in HAS[box])
    assert counts[STOP] == -(-num_envs // 2)
    # a stop follows a motion
    assert (schedule.kinds[0] != STOP).all()


@pytest.mark.parametrize("box", BOXES)
def test_commands_are_what_their_kind_says_and_lie_in_the_box(box):
    schedule = drawn(box, 200)
    low, high = np.float32(list(BOXES[box].values())).T
    for kind, ours in ((kind, schedule.commands[schedule.kinds == kind]) for kind in KINDS):
        if kind in (TURN, SIDE) and len(ours):
            axis = {SIDE: 1, TURN: 2}[kind]
            assert (np.delete(ours, axis, axis=1) == 0.0).all()
            assert ((low[axis] <= ours[:, axis]) & (ours[:, axis] <= high[axis])).all()
            ends = np.where(ours[:, axis] > 0.0, high[axis], -low[axis])
            assert (np.abs(ours[:, axis]) >= 0.5 * ends - 1e-6).all()
            left = (ours[:, axis] > 0.0).mean()
            assert left == {True: 0.5, False: float(high[axis] > 0.0)}[low[axis] == -high[axis]]
        elif kind == STOP:
            assert (ours == 0.0).all()
        elif kind == BOX:
            assert (low <= ours).all()
            assert (ours <= high).all()
            np.testing.assert_allclose(ours.min(axis=0), low, atol=0.05)
            np.testing.assert_allclose(ours.max(axis=0), high, atol=0.05)


def test_an_envs_commands_depend_on_seed_index_and_box_alone():
    many, few = drawn(num_envs=64), drawn(num_envs=5)
    np.testing.assert_array_equal(many.commands[:, :5], few.commands)
    np.testing.assert_array_equal(many.kinds[:, :5], few.kinds)
    np.testing.assert_array_equal(drawn(steps=500).commands, many.commands[:2])
    assert not (drawn(seed=1).commands == many.commands).all()
    # other robots in the batch change nothing
    both = Schedule.joined([drawn("small", 7), many])
    np.testing.assert_array_equal(both.of_envs(slice(7, 71)).commands, many.commands)


def test_the_command_changes_every_five_seconds():
    schedule = drawn()
    assert [step for step in range(STEPS) if schedule.changes_at(step)] == [0, 250, 500, 750]
    assert (schedule.at(249) == schedule.commands[0]).all()
    assert (schedule.at(250) == schedule.commands[1]).all()
    # for any length of a control step
    assert Schedule.draw(BOXES["whole"], 1, 200, 0.1, 0).steps_per_segment == 50


def test_one_command_has_the_kind_that_it_reads_as():
    for command, kind in (((0, 0, 0), STOP), ((0, 0, 0.6), TURN), ((0, -0.3, 0), SIDE), ((0.5, 0, 0), BOX)):
        assert (Schedule.constant(command, 3, 100).kinds == kind).all()


# the clauses


def faults(motion, **arguments):
    return set(walking.faults(measured(motion, **arguments)))


@pytest.mark.parametrize("box", BOXES)
def test_a_robot_that_does_as_it_is_told_walks(box):
    found = measured(follows, box)
    assert walking.walks(found)
    assert walking.why_not(found) == []
    assert (found.error_vel_xy, found.error_vel_yaw, found.fall_rate) == (0.0, 0.0, 0.0)
    assert found.still_error_vel_xy > 0.0
    assert found.turn_reached == pytest.approx(1.0) if TURN in HAS[box] else math.isnan(found.turn_reached)
    assert found.side_reached == pytest.approx(1.0) if SIDE in HAS[box] else math.isnan(found.side_reached)


def test_a_robot_that_stands_still_fails_on_everything_but_drift_and_falls():
    found = measured(lambda commands, step, since: np.zeros(commands.shape))
    assert set(walking.faults(found)) == {"planar error", "share of still", "yaw error", "turn"}
    assert found.error_vel_xy == found.still_error_vel_xy
    assert found.error_vel_yaw == found.still_error_vel_yaw
    # in the box [-1, 1]: 3/8 from the whole of it, 1/4 side-steps of 0.75 m/s, as many turns, 1/8
    # stops
    assert found.still_error_vel_xy == pytest.approx(0.375 * 0.7652 + 0.25 * 0.75, abs=0.03)
    assert found.still_error_vel_yaw == pytest.approx(0.375 * 0.5 + 0.25 * 0.75, abs=0.03)
    assert any("pure turns reach 0% of what is asked, 60% wanted" in text for text in walking.why_not(found))


def test_a_robot_that_ignores_its_yaw_rate_fails_on_turning():
    def straight(commands, step, since):
        return commands * [1.0, 1.0, 0.0]

    assert faults(straight) == {"yaw error", "turn"}
    # where yaw rates are small the error does not tell
    assert faults(straight, box="small") == {"turn"}
    assert faults(straight, box="straight") == set()


@pytest.mark.parametrize(("share", "expected"), [(0.61, set()), (0.59, {"turn"})])
def test_a_pure_turn_reaches_sixty_per_cent(share, expected):
    def slow(commands, step, since):
        is_turn = (commands[:, :2] == 0.0).all(axis=1)
        return commands * np.where(is_turn[:, None], [1.0, 1.0, share], 1.0)

    assert faults(slow) == expected
    assert measured(slow).turn_reached == pytest.approx(share)

    def slow_to_the_right(commands, step, since):
        return np.where(commands[:, 2:] < 0.0, slow(commands, step, since), commands)

    assert faults(slow_to_the_right) == expected


def test_the_first_second_of_a_turn_does_not_count_for_what_it_reaches():
    found = measured(lambda commands, step, since: commands * (since >= 1.0))
    assert found.turn_reached == pytest.approx(1.0)
    assert found.side_reached == pytest.approx(1.0)
    late = measured(lambda commands, step, since: commands * (since >= 2.0))
    assert late.turn_reached == pytest.approx(0.75)


@pytest.mark.parametrize(("error", "expected"), [(0.12, set()), (0.24, {"share of still"}), (0.26, {"planar error"})])
def test_the_planar_error_is_bounded_and_half_of_standing_still(error, expected):
    """Robots that move as told plus `error`, except where they are told to stop."""

    def off(commands, step, since):
        return commands + np.where((commands == 0.0).all(axis=1)[:, None], 0.0, [error * 8 / 7, 0.0, 0.0])

    found = faults(off)
    assert expected <= found
    assert found <= {"planar error", "share of still"}
    assert measured(off).error_vel_xy == pytest.approx(error)


@pytest.mark.parametrize(("error", "expected"), [(0.24, set()), (0.26, {"yaw error"})])
def test_the_yaw_error_is_bounded(error, expected):
    def off(commands, step, since):
        """Turns too fast, in either direction, except where it is told to stop."""
        is_told = (commands != 0.0).any(axis=1)
        return commands + np.column_stack([0.0 * is_told, 0.0 * is_told, is_told * error * 8 / 7])

    # the other direction turns too slowly by as much
    assert faults(off) - {"turn"} == expected


@pytest.mark.parametrize(
    ("drift", "expected"),
    [
        ((0.03, 0.04, 0.0), {"drift"}),
        ((0.029, 0.039, 0.0), set()),
        ((0.0, 0.0, -0.051), {"yaw drift"}),
        ((0.0, 0.0, -0.049), set()),
    ],
)
def test_a_robot_that_is_told_to_stop_does_not_drift(drift, expected):
    def drifts(commands, step, since):
        return commands + 1.001 * (commands == 0.0).all(axis=1)[:, None] * drift

    assert faults(drifts) == expected


def test_swaying_in_place_is_no_drift_and_braking_takes_two_seconds():
    def sways(commands, step, since):
        stops = (commands == 0.0).all(axis=1)[:, None]
        return commands + stops * np.array([0.2, 0.1, 0.3]) * math.sin(2.0 * math.pi * since)

    found = measured(sways)
    assert found.drift_xy < 1e-9
    assert found.drift_yaw < 1e-9
    assert walking.walks(found)
    brakes = measured(
        lambda commands, step, since: commands + 0.5 * (since < 2.0) * (commands == 0.0).all(axis=1)[:, None]
    )
    assert (brakes.drift_xy, brakes.drift_yaw) == (0.0, 0.0)


@pytest.mark.parametrize(("falls", "expected"), [(5, set()), (6, {"falls"})])
def test_five_falls_in_a_hundred_episodes_are_allowed(falls, expected):
    found = measured(follows, num_envs=100, falls=falls)
    assert set(walking.faults(found)) == expected
    assert found.fall_rate == falls / 100
    assert sum(entry.fall_rate * entry.count for entry in found.by_kind.values()) == pytest.approx(falls)


def test_a_fall_ends_an_episode_and_its_segment_tells_no_mean_motion():
    schedule = drawn(num_envs=2)
    record = Record(schedule, DT)
    for step in range(STEPS):
        # the first env falls in its second segment and flies off
        wild = np.array([[50.0, 50.0, 50.0], [0.0, 0.0, 0.0]]) * (step > 300)
        moved = schedule.at(step) + wild
        record.add(moved[:, :2], moved[:, 2], np.array([step == 300, False]))
    assert record.steps.tolist() == [301, 1000]
    assert record.active.tolist() == [False, True]
    found = record.walking()
    assert (found.error_vel_xy, found.error_vel_yaw, found.fall_rate) == (0.0, 0.0, 0.5)
    # the first env's turn is the segment of the fall
    assert schedule.kinds[1].tolist() == [TURN, BOX]
    assert found.by_kind[TURN].count == 2
    assert found.turn_reached == pytest.approx(1.0)
    assert math.isnan(found.drift_xy)


def test_a_record_tells_who_succeeds():
    """One follows, one stands still, one follows and falls; told 0.5 m/s ahead."""
    record = Record(Schedule.constant((0.5, 0.0, 0.0), 3, 10), 0.02)
    for step in range(10):
        velocity = [[0.45, 0.0], [0.0, 0.0], [0.5, 0.0]]
        record.add(velocity, np.zeros(3), np.array([False, False, step == 4]))
    sums = record.sums()
    np.testing.assert_array_equal(sums["steps"], [10.0, 10.0, 5.0])
    np.testing.assert_allclose(sums["xy"], [0.5, 5.0, 0.0])
    np.testing.assert_array_equal(succeeds(sums), [True, False, False])
    np.testing.assert_array_equal(succeeds(record.sums(slice(1, 2))), [False])


def test_a_state_that_is_not_finite_is_a_fall():
    schedule = drawn(num_envs=2)
    record = Record(schedule, DT)
    for step in range(STEPS):
        moved = schedule.at(step).astype(np.float64)
        moved[0] = np.nan if step >= 10 else moved[0]
        record.add(moved[:, :2], moved[:, 2], np.zeros(2, dtype=np.bool_))
    assert record.fell.tolist() == [True, False]
    assert (record.walking().fall_rate, record.walking().error_vel_xy) == (0.5, 0.0)


def test_what_was_not_measured_is_no_walk():
    schedule = drawn(num_envs=8, steps=250)
    record = Record(schedule, DT)
    for step in range(250):
        record.add(schedule.at(step)[:, :2], schedule.at(step)[:, 2], np.zeros(8, dtype=np.bool_))
    found = record.walking(kinds=walking.kinds_of(BOXES["whole"]))
    assert not walking.walks(found)
    assert set(walking.faults(found)) == {"drift", "yaw drift", "length"}
    assert walking.faults(found, whole=False) == {}
    assert "episodes of 5 s, 20 s wanted" in walking.why_not(found)


# bookkeeping


def test_robots_of_a_batch_have_the_figures_that_they_have_alone():
    random = np.random.default_rng(0)
    noise = random.normal(scale=0.1, size=(STEPS, 40, 3))
    schedules = [drawn("small", 16), drawn("whole", 24)]
    batch = Record(Schedule.joined(schedules), DT)
    alone = [Record(each, DT) for each in schedules]
    blocks = [slice(0, 16), slice(16, 40)]
    for step in range(STEPS):
        moved = batch.schedule.at(step) + noise[step]
        fell = noise[step, :, 0] > 0.37
        batch.add(moved[:, :2], moved[:, 2], fell)
        for record, envs in zip(alone, blocks, strict=True):
            record.add(moved[envs, :2], moved[envs, 2], fell[envs])
    for record, envs in zip(alone, blocks, strict=True):
        assert record.walking() == batch.walking(envs)
        assert 0.0 < record.walking().fall_rate < 1.0


def test_episodes_add_up():
    def of(seed):
        schedule = drawn(num_envs=8, seed=seed)
        record = Record(schedule, DT)
        for step in range(STEPS):
            moved = schedule.at(step) * (1.0 - 0.1 * seed)
            record.add(moved[:, :2], moved[:, 2], np.zeros(8, dtype=np.bool_))
        return record

    records = [of(0), of(1)]
    both, each = walking.figures(records), [record.walking() for record in records]
    assert both.episodes == 16
    assert both.error_vel_xy == pytest.approx(np.mean([one.error_vel_xy for one in each]))
    assert both.turn_reached == pytest.approx(0.95)
    assert both.by_kind[STOP].count == 8


def test_figures_survive_their_file():
    found = dataclasses.replace(measured(follows, "straight", 4), drift_xy=math.nan)
    content = finite(dataclasses.asdict(found))
    again = Walking.from_dict(json.loads(json.dumps(content, allow_nan=False)))
    assert math.isnan(again.turn_reached)
    assert math.isnan(again.drift_xy)
    assert repr(again) == repr(found)
    with pytest.raises(TypeError):
        Walking.from_dict({**content, "unknown": 1})
