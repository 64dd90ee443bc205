"""The fenced blocks of the pages run, compile or parse, and the commands in them exist.

A block of another language than those of `LANGUAGES` fails. `text` marks output and layouts; a
block that cannot be checked says so in its first line, with the reason: three backticks and `bash
no-run: needs a robot`.
"""

import contextlib
import dataclasses
import importlib.util
import io
import itertools
import json
import os
import re
import shlex
import subprocess
from collections.abc import Iterator
from functools import cache

import pytest

from common import FLAT_POLICY, ROOT
from polypod import _core, bodies, cli
from polypod.compat import tomllib
from polypod.export import export_checkpoint
from polypod.motions import key_poses
from polypod.motions.body import body_of
from polypod.runs import config
from polypod.sim2sim.mapping import Given
from polypod.training import sweep

PAGES = (
    "README.md",
    "CONTRIBUTING.md",
    *sorted(page.relative_to(ROOT).as_posix() for page in ROOT.glob("docs/**/*.md")),
)
LANGUAGES = ("bash", "json", "python", "rust", "toml")
FENCE = re.compile(r" *```")

SIMULATOR = ROOT / "target" / "release" / "polypod-sim"
FOLDERS = tuple(
    f"{folder}/" for folder in ("assets", "benches", "configs", "crates", "docs", "examples", "src", "tests")
)
"""Folders of the repository: what a command names in them exists."""

TASK_TABLES = {"commands", "curriculum", "events", "observations", "physics", "rewards", "scene", "sensors", "sim"}
TASK_TABLES |= {"actions", "terminations"}
TRAIN_TABLES = {"anneal", "run", "algorithm", "actor", "critic", "obs_groups", "rnd", "distillation"}


@dataclasses.dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    page: str
    line: int
    """Number of the line that opens it."""
    section: str
    language: str
    remark: str
    """The rest of the line that opens it."""
    text: str

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"

    @property
    def is_checked(self) -> bool:
        """Whether a test reads it."""
        return self.language != "text" and not self.remark.startswith("no-run: ")


def blocks_of(page: str) -> Iterator[Block]:
    section, opened, inside = "", None, []
    for number, line in enumerate((ROOT / page).read_text(encoding="utf-8").splitlines(), start=1):
        if opened is None and line.startswith("#"):
            section = line.lstrip("# ")
        elif not FENCE.match(line):
            inside.append(line)
        elif opened is None:
            opened, inside = (number, line.strip().removeprefix("```")), []
        else:
            language, _, remark = opened[1].partition(" ")
            text = "".join(f"{line}\n" for line in inside)
            yield Block(page, opened[0], section, language.split(",")[0], remark, text)
            opened = None
    assert opened is None, f"{page}:{opened[0]}: the block has no end"


BLOCKS = [block for page in PAGES for block in blocks_of(page)]


def of(language: str) -> list[Block]:
    return [block for block in BLOCKS if block.language == language and block.is_checked]


TUTORIALS = "docs/tutorials/"
"""`test_tutorials.py` runs these pages from top to bottom."""
SECTIONS = {
    (block.page, block.section): block for block in reversed(of("python")) if not block.page.startswith(TUTORIALS)
}
"""The first Python block of each section."""


def test_every_block_is_checked_or_says_why_not():
    """Every block has a known language or says why it is not checked."""
    for page in PAGES:
        fences = sum(bool(FENCE.match(line)) for line in (ROOT / page).read_text(encoding="utf-8").splitlines())
        blocks = [block for block in BLOCKS if block.page == page]
        assert fences == 2 * len(blocks), page
        for block in blocks:
            assert not block.is_checked or block.language in LANGUAGES, f"{block}: unknown language"
            assert block.language == "text" or not block.remark or not block.is_checked, f"{block}: {block.remark}"
    assert len([block for block in BLOCKS if block.is_checked]) > 50


LEARNERS = ("ray", "skrl", "stable_baselines3", "torchrl")
"""Packages of examples that the tests may lack: the extra `learners`."""


def missing_learners(first: Block) -> list[str]:
    text = "".join(b.text for b in of("python") if (b.page, b.section) == (first.page, first.section))
    return [name for name in LEARNERS if re.search(rf"\b{name}\b", text) and importlib.util.find_spec(name) is None]


@pytest.mark.parametrize("first", SECTIONS.values(), ids=str)
def test_python_runs(first, tmp_path, monkeypatch):
    """The blocks of one section run one after another, as a reader would paste them."""
    if missing := missing_learners(first):
        pytest.skip(f"needs {', '.join(missing)}: make test ONLY=learners")
    monkeypatch.chdir(tmp_path)
    if first.page == "docs/export.md":
        # files of the command at the head of the page, for the one robot that the block uses
        export_checkpoint(FLAT_POLICY, tmp_path / "exported", ["spot"], formats=("onnx",))
    names = {"__name__": "__main__"}
    for block in of("python"):
        if (block.page, block.section) == (first.page, first.section):
            # the empty lines let an error name the page's own line
            code = compile("\n" * block.line + block.text, str(ROOT / block.page), "exec")
            with contextlib.redirect_stdout(io.StringIO()):
                exec(code, names)


@pytest.mark.parametrize("block", of("toml"), ids=str)
def test_toml_is_accepted(block, tmp_path):
    """A snippet of a task or of a train config loads.

    It goes on top of the flat one where it names none.
    """
    tables = tomllib.loads(block.text)
    base = "" if "extends" in tables else 'extends = "{}"\n'
    file = tmp_path / "mine.toml"
    if tables.keys() & TASK_TABLES:
        name = "" if "name" in tables else 'name = "Mine-v0"\n'
        file.write_text(base.format("velocity_flat") + name + block.text)
        assert _core.VecSim(str(file), num_envs=8, threads=1).num_envs == 8
    elif "seeds" in tables:
        file.write_text(block.text)
        assert sweep.read(file, tmp_path / "out").trials
    elif tables.keys() & TRAIN_TABLES:
        file.write_text(base.format("flat") + block.text)
        loaded = config.load(str(file)).as_dict()
        for table in tables.keys() & TRAIN_TABLES:
            assert tables[table].items() <= loaded[table].items()
    elif "surfaces" in tables:
        file.write_text('extends = "unitree_go2"\nname = "mine"\ntitle = "mine"\n' + block.text)
        assert _core.VecSim("velocity_flat", num_envs=2, robots=[str(file)], threads=1).num_envs == 2
    elif "pose" in tables:
        file.write_text(block.text)
        assert key_poses.draw(str(file), body_of("unitree_g1")).frames > 1
    elif "joints" in tables:
        file.write_text(block.text)
        assert len(Given.read(file).joints) == len(tables["joints"])
    else:
        pytest.fail(f"{block} is neither of a task nor of a train config; test_docs_run.py has to learn how to load it")


@pytest.mark.parametrize("block", of("json"), ids=str)
def test_json_parses(block):
    json.loads(block.text)


@pytest.mark.parametrize("block", of("rust"), ids=str)
def test_rust_is_compiled(block):
    """`cargo test --doc` compiles the Rust blocks of the pages that the library includes."""
    library = ROOT / "src" / "lib.rs"
    included = re.findall(r'include_str!\("([^"]+\.md)"\)', library.read_text(encoding="utf-8"))
    pages = {(library.parent / page).resolve() for page in included}
    assert ROOT / block.page in pages, f"src/lib.rs does not include {block.page} for doctests"


@pytest.mark.parametrize("block", of("bash"), ids=str)
def test_commands_exist(block, monkeypatch):
    """The shell accepts the block, and each program in it accepts its arguments. Nothing is run."""
    subprocess.run(["bash", "-n"], input=block.text, text=True, check=True, timeout=30)
    monkeypatch.setattr(cli, "_run", lambda command: 0)
    variables = {"PWD": "."}
    for command in commands(block.text):
        words = [re.sub(r"\$(\w+)", lambda name: variables[name[1]], word) for word in command]
        while words and (found := re.fullmatch(r"(\w+)=(.*)", words[0])):
            variables[found[1]] = found[2]
            words = words[1:]
        if words:
            check_command(words, (ROOT / block.page).read_text(encoding="utf-8"))


def commands(text: str) -> Iterator[list[str]]:
    """Splits shell commands into words.

    Redirections are refused: `<date>` is one, where a reader is meant to put something in.
    """
    for line in text.replace("\\\n", " ").splitlines():
        lexer = shlex.shlex(line, posix=True, punctuation_chars=True)
        lexer.whitespace_split = True
        command: list[str] = []
        for word in [*lexer, ";"]:
            if word in ("&&", "||", ";", "|"):
                yield command
                command = []
            else:
                assert not set(word) <= set("<>&()"), f"{word} in {line}"
                command.append(word)


def check_command(words: list[str], page: str) -> None:
    program, *arguments = words
    match program:
        case "polypod" | ".venv/bin/polypod":
            assert accepts(arguments), shlex.join(words)
        case "polypod-sim" | "target/release/polypod-sim":
            check_simulator(arguments)
        case "torchrun":
            place = arguments.index("polypod")
            assert arguments[place - 1] == "-m"
            assert accepts(arguments[place + 1 :]), shlex.join(words)
        case "make":
            makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
            for word in arguments:
                name, is_variable, _ = word.partition("=")
                pattern = rf"^{name} [?:]?=|\$\({name}\)" if is_variable else rf"^{name}:"
                assert re.search(pattern, makefile, re.MULTILINE), shlex.join(words)
        case "cargo":
            check_cargo(arguments)
        case "export":
            (assignment,) = arguments
            assert re.fullmatch(r"\w+=.+", assignment)
        case "git":
            repository = tomllib.loads((ROOT / "Cargo.toml").read_text(encoding="utf-8"))["workspace"]["package"]
            assert arguments == ["clone", repository["repository"]], shlex.join(words)
        case "cd":
            assert f"/{arguments[0]} && cd {arguments[0]}" in page, "only into what was just cloned"
        case ".venv/bin/pytest":
            assert all((ROOT / file).is_file() for file in arguments), shlex.join(words)
        case "fuzz/run" | "lab/films":
            assert os.access(ROOT / program, os.X_OK)
        case "cp" | "mkdir" | "tar" | "ray" | "pip" | "uvx" | "podman" | ".venv/bin/tensorboard":
            pass
        case ".venv/bin/python" | "python" if words[1] == "-m":
            assert importlib.util.find_spec(words[2]) is not None, shlex.join(words)
        case ".venv/bin/python" | "python":
            check_example(words[1], words[2:])
        case _:
            pytest.fail(f"{shlex.join(words)}: test_docs_run.py does not know {program}")
    check_names(arguments, page)
    for word in (word.rpartition("=")[2] for word in arguments):
        if word.startswith(FOLDERS):
            assert any(ROOT.glob(word)), f"{word} does not exist"


def check_example(script: str, arguments: list[str]) -> None:
    """A script of `examples/` that takes the arguments."""
    parsed = re.findall(r'add_argument\("([^"]+)"', (ROOT / script).read_text(encoding="utf-8"))
    assert script.startswith("examples/")
    for argument in arguments:
        assert not argument.startswith("--") or argument in parsed, argument


def accepts(arguments: list[str]) -> bool:
    """Whether `polypod` reads the arguments, which it does not act upon: `_run` is replaced."""
    try:
        return cli.main(arguments) == 0
    except SystemExit as left:
        return left.code == 0  # exit code of --help


def check_simulator(arguments: list[str]) -> None:
    if SIMULATOR.is_file():
        # arguments before --help are read first, and refused where they are wrong
        done = subprocess.run([SIMULATOR, *arguments, "--help"], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return
    sources = ROOT / "crates" / "sim" / "src" / "cli"
    if arguments == ["list"]:
        return
    text = (sources / f"{arguments[0]}.rs").read_text(encoding="utf-8")
    flags = {"help"}
    for attribute, field in re.findall(r"#\[arg\((long.*)\)\]\s+(\w+):", text):
        flags |= {field.replace("_", "-"), *re.findall(r'(?:long|alias) = "([\w-]+)"', attribute)}
    for word in arguments:
        assert not word.startswith("--") or word[2:].partition("=")[0] in flags, f"{word} of {shlex.join(arguments)}"


def check_cargo(arguments: list[str]) -> None:
    own = arguments[: arguments.index("--")] if "--" in arguments else arguments
    for option, name in itertools.pairwise(own):
        kind = {"--example": "example", "--test": "test", "--bin": "bin"}.get(option)
        assert kind is None or (kind, name) in targets(), shlex.join(arguments)
    if "--test" in own:
        # the tests are modules of one executable; the names of some choose them
        for module in own[own.index("--test") + 2 :]:
            assert len([*(ROOT / "tests").glob(f"*/{module}.rs")]) == 1, shlex.join(arguments)


@cache
def targets() -> set[tuple[str, str]]:
    command = ["cargo", "metadata", "--no-deps", "--offline", "--format-version=1"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True, timeout=60)
    packages = json.loads(done.stdout)["packages"]
    return {(kind, target["name"]) for package in packages for target in package["targets"] for kind in target["kind"]}


def check_names(arguments: list[str], page: str) -> None:
    """Tasks, robots and train configs are built in, or the page makes them."""
    for option, value in itertools.pairwise(arguments):
        match option:
            case "--task":
                is_made = ("bodies generate" in page and value == bodies.TASK) or f"--out {value}" in page
                assert value in known_tasks() or is_made, value
            case "--robot" | "--robots" | "--quadrupeds":
                for name in value.split(","):
                    is_made = f"configs/robots/{name}.toml" in page
                    assert name in known_robots() or name.endswith(".toml") or is_made, name
            case "--train-config":
                config.load(value)


@cache
def known_tasks() -> set[str]:
    return {name for task in _core.tasks() for name in (task["name"], *task["aliases"])}


@cache
def known_robots() -> set[str]:
    return {robot["name"] for robot in _core.robots()}
