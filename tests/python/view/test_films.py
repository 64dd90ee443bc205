"""Films show a walk, a training, a push, and a comparison with MuJoCo."""

import dataclasses
import shutil

import numpy as np
import pytest
from PIL import Image, ImageSequence

import polypod.cli
from common import FLAT_POLICY, ROUGH_POLICY
from polypod import _core, films
from polypod.films import Options
from polypod.play import Player
from polypod.policy import load
from polypod.render import raster

SIZE = (320, 160)
SHORT = ("--seconds", "0.4", "--warm-up", "0.4", "--fps", "10", "--size", *map(str, SIZE))


def film(tmp_path, *arguments):
    """Frames of the film that `polypod film` makes."""
    out = tmp_path / "film.webp"
    story, *others = arguments
    assert polypod.cli.main(["film", story, str(out), "--checkpoint", str(FLAT_POLICY), *SHORT, *others]) == 0
    with Image.open(out) as animation:
        return [np.asarray(frame.convert("RGB")).astype(int) for frame in ImageSequence.Iterator(animation)]


@pytest.fixture
def titles(monkeypatch):
    """Titles of the frames, in order."""
    seen = []

    def titled(image, text):
        seen.append(text)
        return raster.titled(image, text)

    monkeypatch.setattr(films, "titled", titled)
    return seen


def test_a_walk(tmp_path, titles):
    frames = film(tmp_path, "walk", "--robots", "spot")
    assert len(frames) == 4
    assert frames[0].shape == (160, 320, 3)
    assert (frames[0] != frames[-1]).any()
    assert titles == []


def test_a_robot_that_the_policy_never_saw_is_told(tmp_path, titles):
    film(tmp_path, "walk", "--robots", "spot,unitree_aliengo")
    assert set(titles) == {"unitree_aliengo: not seen in training"}


@pytest.fixture
def run(tmp_path):
    """A run with three checkpoints of one policy."""
    folder = tmp_path / "run"
    folder.mkdir()
    shutil.copy(FLAT_POLICY.parent / "manifest.json", folder)
    for number in (100, 200, 300):
        shutil.copy(FLAT_POLICY, folder / f"model_{number}.pt")
    return folder


def test_a_training_from_its_beginning_to_its_end(tmp_path, titles, run):
    """Parts start equally; an untrained network does not walk, and a trained one does."""
    options = Options(run, tmp_path / "film.webp", ["spot"], seconds=0.8, fps=10, size=SIZE, parts=3)
    films.tell("training", options)
    assert list(dict.fromkeys(titles)) == ["iteration 0 (untrained)", "iteration 100", "iteration 300"]
    with Image.open(options.out) as animation:
        frames = [np.asarray(frame.convert("RGB")).astype(int) for frame in ImageSequence.Iterator(animation)]
    assert len(frames) == len(titles) == 24
    _, first, second = np.split(np.stack(frames)[:, 30:], 3)
    # the same checkpoint under two names, in pictures that are not lossless
    assert np.abs(first - second).mean() < 1.0


def test_every_part_of_a_training_begins_alike():
    """In the same poses and under the same command, as the player itself did."""
    player = Player(FLAT_POLICY, ["spot", "unitree_a1"], command=(0.4, 0.1, 0.2), threads=1)
    first = {robot: player.sim.qpos(robot) for robot in player.sim.robots}
    observation = player.sim.observation.copy()
    for _ in range(2):
        for _ in range(10):
            player.step()
        player.use(load(FLAT_POLICY).runner())
        for robot, qpos in first.items():
            np.testing.assert_array_equal(player.sim.qpos(robot), qpos)
        np.testing.assert_array_equal(player.sim.observation, observation)
        np.testing.assert_allclose(player.sim.command, np.tile([[0.4, 0.1, 0.2]], (2, 1)), rtol=1e-6)


def test_iterations_are_spread_over_the_run(run):
    assert [number for number, _ in films._checkpoints(run, 2)] == [100, 300]
    assert [number for number, _ in films._checkpoints(run / "model_200.pt", 5)] == [100, 200, 300]
    assert [number for number, _ in films._checkpoints(run, 1)] == [300]
    with pytest.raises(_core.ConfigError, match="no checkpoint"):
        films._checkpoints(run.parent, 2)


def test_a_push_moves_the_robots_and_is_shown(tmp_path, titles, monkeypatch):
    pushes = []
    push = films.Player.push
    monkeypatch.setattr(
        films.Player, "push", lambda player, velocity: (pushes.append(velocity), push(player, velocity))
    )
    frames = film(tmp_path, "push", "--robots", "spot", "--seconds", "1.4", "--push", "0.8")
    (first,) = pushes
    np.testing.assert_allclose(first, [0.0, -0.8, 0.0])
    assert "pushed by 0.8 m/s" in titles
    assert "" in titles
    shown = titles.index("pushed by 0.8 m/s")
    red = [((frame[..., 0] > 170) & (frame[..., 1:].max(axis=2) < 110)).sum() for frame in frames]
    assert red[shown] > red[0] + 30


def test_polypod_beside_mujoco(tmp_path, titles, monkeypatch):
    """Both halves start equally and stay nearly equal."""
    shown = []
    replay = films.replay
    monkeypatch.setattr(films, "replay", lambda *args: shown.append(args[-1]) or replay(*args))
    frames = film(tmp_path, "mujoco", "--robots", "spot", "--warm-up", "0")
    assert len(frames) == 4
    assert titles[:1] == ["polypod"]
    assert titles[1].startswith("MuJoCo ")
    ours, theirs = (np.stack(states["spot"]) for states in shown)
    assert ours.shape == theirs.shape == (20, 19)
    np.testing.assert_allclose(ours[0], theirs[0], atol=0.02)
    assert np.abs(ours - theirs).max() > 0.0
    np.testing.assert_allclose(ours[-1, :3], theirs[-1, :3], atol=0.1)


def test_what_cannot_be_filmed_is_told(tmp_path):
    options = Options(ROUGH_POLICY, tmp_path / "film.gif", ["spot"])
    small = ("scene.terrain.num_rows=1", "scene.terrain.border_width=2.0")
    for story in ("push", "mujoco"):
        with pytest.raises(_core.ConfigError, match="flat"):
            films.tell(story, dataclasses.replace(options, overrides=small))
    for changes, message in (({"parts": 0}, "--parts"), ({"seconds": -1.0}, "--seconds"), ({"fps": 99}, "--fps")):
        with pytest.raises(_core.ConfigError, match=message):
            films.tell("walk", dataclasses.replace(options, **changes))
