"""The tutorials run as they are written, from top to bottom.

Sizes are smaller than those of a real training.
"""

import contextlib
import io
import itertools
import json
import re
import shlex
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

import polypod.cli
from test_docs_run import ROOT, TUTORIALS, blocks_of, commands

PAGES = sorted(page.stem for page in (ROOT / TUTORIALS).glob("*.md"))
SMALL = {"--max-iterations": "1", "--num-envs": "16", "--steps": "20", "--seconds": "0.1"}
"""Numbers that tests put in the place of a tutorial's."""
ADDED = {
    "train": ["--num-envs", "16", "--set", "sim.episode_length_s=0.4", "--logger", "none"],
    "eval": ["--num-envs", "16", "--steps", "20"],
    "play": ["--headless", "--seconds", "0.1"],
    "sim2sim": ["--num-envs", "1"],
}
"""Options that tests add where a tutorial leaves the default."""
SMALL_SWEEP = {"seeds": "[1]", "num_envs": "16", "max_iterations": "1"}
ELSEWHERE = ("torchrun", "--ray")
"""Commands with these words start several processes: `test_workers.py` and `test_ray.py` have
them."""


def small(words):
    """A command with small sizes, its patterns of files expanded."""
    command, *rest = words
    for flag, value in SMALL.items():
        if flag in rest:
            rest[rest.index(flag) + 1] = value
    added = ADDED.get(command, []) if "--resume" not in rest else []
    for flag, value in zip(added[::2], added[1::2], strict=True) if command != "play" else []:
        rest += [] if flag in rest and flag != "--set" else [flag, value]
    if command == "play":
        rest += added
    # each training and each resumed part is one iteration here
    rest = [re.sub(r"model_\d+\.pt", "model_2.pt", word) for word in rest]
    return [command, *(path for word in rest for path in (map(str, Path().glob(word)) if "*" in word else [word]))]


def run(block):
    """Does what a reader would do with a block."""
    if block.language == "python":
        exec(compile("\n" * block.line + block.text, str(ROOT / block.page), "exec"), {"__name__": "__main__"})
    elif block.language == "toml" and (name := re.match(r"# (\w+\.toml)\n", block.text)):
        text = block.text
        for key, value in SMALL_SWEEP.items():
            text = re.sub(rf"^{key} = .*$", f"{key} = {value}", text, flags=re.MULTILINE)
        Path(name[1]).write_text(text)
    elif block.language == "bash":
        for words in commands(block.text):
            if not words or any(word in words for word in ELSEWHERE):
                continue
            program, *rest = words
            if program == "python":
                done = subprocess.run(
                    [sys.executable, ROOT / rest[0], *small(rest)[1:]], capture_output=True, text=True, check=False
                )
                assert done.returncode == 0, done.stderr
            else:
                assert program == "polypod", shlex.join(words)
                assert polypod.cli.main(small(rest)) == 0, shlex.join(words)


@pytest.mark.parametrize("page", PAGES)
def test_a_tutorial_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("POLYPOD_PATH", "")
    path = list(sys.path)
    try:
        for block in blocks_of(f"{TUTORIALS}{page}.md"):
            if block.is_checked:
                run(block)
    finally:
        sys.path[:] = path
        sys.modules.pop("my_terms", None)


def test_there_is_an_order():
    """Each tutorial names the next one, and the site's navigation has them in that order."""
    order = re.findall(r"tutorials/([\w-]+)\.md", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    assert sorted(order) == PAGES
    for page, following in itertools.pairwise(order):
        text = (ROOT / TUTORIALS / f"{page}.md").read_text(encoding="utf-8")
        assert f"({following}.md)" in text.rpartition("Next: ")[2]


def test_the_notebook_runs(tmp_path, monkeypatch):
    """Its cells run one after another, and print what stands in the file but for numbers."""
    pyplot = pytest.importorskip("matplotlib.pyplot")
    pytest.importorskip("av", reason="needs the extra play")
    pyplot.switch_backend("agg")
    monkeypatch.chdir(tmp_path)
    cells = json.loads((ROOT / TUTORIALS / "walk.ipynb").read_text(encoding="utf-8"))["cells"]
    names = {"__name__": "__main__"}
    printed = []
    for number, cell in enumerate(cells):
        if cell["cell_type"] != "code":
            continue
        assert cell["execution_count"], f"cell {number} was not executed; run the notebook and save it"
        shown = io.StringIO()
        with contextlib.redirect_stdout(shown), warnings.catch_warnings():
            warnings.filterwarnings("ignore", "FigureCanvasAgg is non-interactive")
            exec(compile("".join(cell["source"]), f"walk.ipynb cell {number}", "exec"), names)
        texts = ["".join(output["text"]) for output in cell["outputs"] if output["output_type"] == "stream"]
        assert {output["output_type"] for output in cell["outputs"]} <= {"stream", "display_data"}
        assert re.sub(r"[\d.]+ m/s", "", shown.getvalue()) == re.sub(r"[\d.]+ m/s", "", "".join(texts))
        printed.append(shown.getvalue())
    errors = [float(number) for number in re.findall(r"([\d.]+) m/s", "".join(printed))]
    assert len(errors) == 8
    assert max(errors) < 0.1, "all robots follow the command"
    pyplot.close("all")
