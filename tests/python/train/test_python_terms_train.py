"""`polypod train --terms FILE` trains with the terms of a Python file.

It resumes with the same file alone.
"""

import shutil

import numpy as np
import pytest
import torch

import polypod
from polypod import python_terms
from polypod.runs import run_dir

TERMS = """
from polypod.terms import Reward

def base_height_l2(state):
    return (state.base_pos[:, 2] - 0.3) ** 2

rewards = {"base_height_l2": Reward(base_height_l2, weight=-10.0)}
terminations = {"early": lambda state: state.episode_length >= 7}
"""
LINE = ("train", "--num-envs", "16", "--robots", "spot", "--logger", "none", "--set", "sim.episode_length_s=1.0")
LINE += ("--set", "train.run.num_steps_per_env=8", "--set", "train.actor.hidden_dims=[16]")


@pytest.fixture
def terms(tmp_path):
    path = tmp_path / "my_terms.py"
    path.write_text(TERMS)
    return path


@pytest.mark.parametrize(
    ("rewards", "terminations", "told"),
    [
        ("np.where(i == 3, np.nan, 0.0)", "i < 0", "rewards['bad'] gives nan for env 3"),
        ("np.where(i == 0, np.inf, 0.0)", "i < 0", "rewards['bad'] gives inf for env 0"),
        ("np.where(i == 0, 1e39, 0.0)", "i < 0", "rewards['bad'] gives 1e+39 for env 0"),
        ("np.zeros(7)", "i < 0", "rewards['bad'] gives shape (7,)"),
        ("0.0 * i", "np.nan * i", "terminations['bad'] gives float64; return bools"),
    ],
)
def test_a_bad_number_is_told_in_one_line(rewards, terminations, told, cli, tmp_path):
    lines = ("import numpy as np", "from polypod.terms import Reward", "i = np.arange(16)")
    lines += (f"rewards = {{'bad': Reward(lambda state: {rewards}, weight=1.0)}}",)
    lines += (f"terminations = {{'bad': lambda state: {terminations}}}",)
    (tmp_path / "bad.py").write_text("\n".join(lines))
    done = cli(*LINE, "--terms", "bad.py", "--max-iterations", "2")
    assert done.returncode == 2, done.stderr
    assert f"--terms bad.py: {told}" in done.stderr
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.rglob("model_*.pt"))


def checkpoint(folder):
    return run_dir.find_checkpoint(folder / "logs", "latest")


def test_they_are_trained_with_and_resumed(cli, tmp_path, terms):
    done = cli(*LINE, "--terms", "my_terms.py", "--max-iterations", "3", "--log-dir", "whole")
    assert done.returncode == 0, done.stderr
    assert "native learner" in done.stdout
    whole = run_dir.find_checkpoint(tmp_path / "whole", "latest")
    manifest = run_dir.read_manifest(whole)
    assert manifest["terms"]["file"] == "my_terms.py"
    assert (whole.parent / "params" / "terms.py").read_text() == TERMS
    # every episode ends after seven steps, as the file says
    lengths = run_dir.load_checkpoint(whole)["infos"]["logger"]["lengths"]
    assert len(lengths) > 16
    assert max(lengths[16:]) <= 7

    assert cli(*LINE, "--terms", "my_terms.py", "--max-iterations", "2").returncode == 0
    done = cli("train", "--resume", "--max-iterations", "1", "--logger", "none")
    assert done.returncode == 2
    assert "was begun with --terms my_terms.py; name the file again" in done.stderr
    shutil.copy(terms, tmp_path / "moved.py")
    done = cli("train", "--resume", "--max-iterations", "1", "--logger", "none", "--terms", "moved.py")
    assert done.returncode == 0, done.stderr
    parts, whole = run_dir.load_checkpoint(checkpoint(tmp_path)), run_dir.load_checkpoint(whole)
    for key, value in whole["actor_state_dict"].items():
        assert torch.equal(value, parts["actor_state_dict"][key]), key
    terms.write_text(TERMS + "\n")
    done = cli("train", "--resume", "--max-iterations", "1", "--logger", "none", "--terms", "my_terms.py")
    assert done.returncode == 2
    assert "is not the file that this run was begun with" in done.stderr


def test_nothing_runs_the_copy_in_the_run(cli, tmp_path, terms):
    assert cli(*LINE, "--terms", "my_terms.py", "--max-iterations", "1").returncode == 0
    path = checkpoint(tmp_path)
    for copy in (path.parent / "params" / "terms.py", terms):
        copy.write_text("open('PWNED', 'w')\n")
    for line in (("eval", "--num-envs", "4", "--steps", "2"), ("play", "--headless", "--seconds", "0.1")):
        assert cli(line[0], "--checkpoint", str(path), *line[1:]).returncode == 0
    assert cli("train", "--resume", "--max-iterations", "1", "--logger", "none").returncode == 2
    assert not (tmp_path / "PWNED").exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "defines no terms"),
        ("rewards = 3", "defines no terms"),
        ("rewards = {'a': lambda state: 0}", r"rewards\['a'\] is a function; write polypod.terms.Reward"),
        ("terminations = {'a': 3}", r"terminations\['a'\] is no function"),
        ("observations = {'a': lambda state: state.base_pos}", "defines observations in a dict; put a decorator"),
        ("def f(:\n", "line 1.*SyntaxError"),
        ("\n\nx = 1 / 0\n", "line 3.*ZeroDivisionError: division by zero"),
        ("import nothing_of_this_name", "ModuleNotFoundError"),
    ],
)
def test_files_that_are_no_terms(text, said, tmp_path):
    path = tmp_path / "my_terms.py"
    path.write_text(text)
    with pytest.raises(polypod.ConfigError, match=said):
        python_terms.load(path)


def test_other_files_are_refused(tmp_path, cli, terms):
    for name in ("none.py", "my_terms.txt"):
        if name.endswith("txt"):
            shutil.copy(terms, tmp_path / name)
        done = cli(*LINE, "--terms", name, "--max-iterations", "1")
        assert done.returncode == 2
        assert f"--terms {name}" in done.stderr


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("state.base_poz", "line 5: the term 'base_height_l2' failed: AttributeError"),
        ("state.base_pos", "return one row per env"),
        ("1 / 0", "ZeroDivisionError"),
    ],
)
def test_a_term_that_fails_is_named_with_its_line(cli, tmp_path, terms, body, said):
    terms.write_text(TERMS.replace("(state.base_pos[:, 2] - 0.3) ** 2", body))
    done = cli(*LINE, "--terms", "my_terms.py", "--max-iterations", "1")
    assert done.returncode == 2
    assert said in done.stderr
    assert done.stderr.count("\n") == 1


def test_rewards_in_python_are_what_the_learner_gets(terms):
    from polypod.rsl_rl import VecEnv
    from polypod.terms import CustomTerms

    loaded = python_terms.load(terms)
    env = CustomTerms(
        polypod.make("velocity_flat", 8, robots=["spot"], seed=0, autoreset="disabled"),
        loaded.rewards,
        loaded.terminations,
    )
    plain = polypod.make("velocity_flat", 8, robots=["spot"], seed=0, autoreset="disabled")
    adapter = VecEnv(env)
    actions = np.zeros((8, 12), dtype=np.float32)
    rewards = adapter.step(torch.from_numpy(actions))[1]
    theirs = plain.step(actions)[1]
    own = -10.0 * 0.02 * (plain.state.base_pos[:, 2] - 0.3) ** 2
    np.testing.assert_allclose(rewards.numpy(), theirs + own, atol=1e-6)
