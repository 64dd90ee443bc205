"""README, docs and code agree on numbers, features, names, paths and links.

Each rule reads the pages and returns what is wrong. `test_rules_find_what_they_are_for` gives every
rule a sentence that it must find, so that no rule passes because it reads nothing.
"""

import io
import json
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import redirect_stdout
from functools import cache
from pathlib import Path

import pytest

from common import ROOT
from polypod import _core, bundled, cli
from polypod.compat import tomllib
from polypod.runs import config

Pages = Mapping[str, str]
"""Texts of the pages by their path in the repository."""

WORDS = ("none", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve")
NUMBERS = {word: number for number, word in enumerate(WORDS)}
NUMBER = rf"(\d+|{'|'.join(WORDS)})"


def read_pages() -> dict[str, str]:
    listed = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md")]
    listed += [path for folder in ("crates", "docs", "src", "systems") for path in ROOT.glob(f"{folder}/**/*.md")]
    return {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in sorted(listed)}


PAGES = read_pages()


def number_of(text: str) -> int:
    return NUMBERS[text.lower()] if text.lower() in NUMBERS else int(text)


def flat(text: str) -> str:
    """The text of a page in one line, without its fenced blocks.

    Sentences go over several lines.
    """
    return " ".join(re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL).split())


def tables(text: str) -> Iterator[list[dict[str, str]]]:
    """The tables of a page; a row is its cells by the names of the columns."""
    header: list[str] = []
    rows: list[dict[str, str]] = []
    for line in [*text.splitlines(), ""]:
        if not line.startswith("|"):
            if rows:
                yield rows
            header, rows = [], []
            continue
        cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line.strip().strip("|"))]
        if not header:
            header = cells
        elif not set(line) <= set("|-: "):
            rows.append(dict(zip(header, cells, strict=False)))


def every(pages: Pages, pattern: str, value: object) -> list[str]:
    """Places where a pattern's number is another one."""
    found = [(page, match) for page, text in pages.items() for match in re.finditer(pattern, flat(text), re.IGNORECASE)]
    return [f"{page}: {match[0]!r}, and it is {value}" for page, match in found if number_of(match[1]) != value]


# Numbers


@cache
def robots_of(task: str) -> int:
    (robots,) = (entry["robots"] for entry in _core.tasks() if task in entry["aliases"])
    return len(robots)


def library(pages: Pages) -> list[str]:
    """Numbers of robots are those of the library and of the tasks."""
    built_in, eight = len(_core.robots()), robots_of("velocity_flat")
    return [
        *every(pages, rf"\b{NUMBER} robots are built in", built_in),
        *every(pages, rf"\bMuJoCo [\d.]+, over {NUMBER} robots", built_in),
        *every(pages, rf"summary is of (?:the first |all |the )?{NUMBER} robots", built_in),
        *every(pages, rf"\ball {NUMBER} robots of the library", built_in),
        *every(pages, rf"\b{NUMBER} quadrupeds, `legged`", eight),
        *every(pages, rf"[Tt]he task's {NUMBER} robots", eight),
        *every(pages, rf"\bspecialists\]\([^)]*\) for {NUMBER} robots", built_in - eight),
        *every(
            pages, r"(?:over|of) (2\d) (?:kinds|robots) on two, four and six legs", robots_of("velocity_flat_legged")
        ),
        *every(pages, r"all (2\d) robots of `Velocity-Flat-Legged-v0`", robots_of("velocity_flat_legged")),
    ]


def judged() -> list[dict[str, dict[str, str]]]:
    """Tables of docs/results.md that say which robots walk: per policy, rows by robot."""
    found = [rows for rows in tables(PAGES["docs/results.md"]) if "walks" in rows[0]]
    assert len(found) == len(bundled.NAMES)
    return [{row["robot"]: row for row in rows} for rows in found]


def walking() -> tuple[int, int]:
    """How many robots walk under `legged`, and how many turn as fast as it takes."""
    (legged,) = (found for found in judged() if len(found) == len(_core.robots()))
    turn = sum(int(row["turn"].rstrip("%")) >= 60 for row in legged.values())
    return sum(row["walks"] == "yes" for row in legged.values()), turn


def policies(pages: Pages) -> list[str]:
    """Sentences about the bundled policies have the numbers of the tables of docs/results.md."""
    walk, turn = walking()
    problems = every(pages, rf"\bwith {NUMBER} bodies\b", walk)
    for page, text in pages.items():
        for match in re.finditer(rf"\b{NUMBER} of (?:the |its )?{len(_core.robots())}\b", flat(text)):
            if number_of(match[1]) not in (walk, turn):
                problems.append(f"{page}: {match[0]!r}, and the tables say {walk} and {turn}")
    quadrupeds = [found for found in judged() if len(found) == robots_of("velocity_flat_universal")]
    for found in quadrupeds:
        walked = sum(row["walks"] == "yes" for row in found.values())
        problems += every(pages, rf"\bwalk with {NUMBER} of eight quadrupeds", walked)
    names = {"err xy": "velocity error (m/s)", "turn": "turn", "drift": "drift (m/s)", "walks": "walks"}
    shown = [rows for rows in tables(pages["docs/networks.md"]) if "walks" in rows[0]]
    by_size = {len(found): found for found in judged() if found not in quadrupeds}
    if sorted(map(len, shown)) != sorted(by_size):
        problems.append("docs/networks.md: a robot's row is missing")
        shown = [rows for rows in shown if len(rows) in by_size]
    for rows in shown:
        for row in rows:
            measured = by_size[len(rows)][row["robot"]]
            problems += [
                f"docs/networks.md: {row['robot']}: {name} is {row[name]}, and docs/results.md says {measured[key]}"
                for name, key in names.items()
                if row[name] != measured[key]
            ]
    manifest = json.loads((bundled.checkpoint("quadruped").parent / "manifest.json").read_text(encoding="utf-8"))
    count = len(manifest["robots"])
    walked = sum(row["walks"] == "yes" for row in by_size[count].values())
    return [*problems, *every(pages, rf"\b{NUMBER} of (?:the )?\[?{count}\b", walked)]


def speeds(pages: Pages) -> list[str]:
    """The README's ratios to MuJoCo are the ranges of docs/performance.md."""
    problems = []
    readme = flat(pages["README.md"])
    for rows in tables(PAGES["docs/performance.md"]):
        for row in rows:
            what, measured = next(iter(row.values())), row.get("range", "")
            if name := re.match(r"times (`mujoco\.\w+`)", what):
                claims = re.findall(
                    rf"(\d+ to \d+)(?: times)?(?: as many)?(?: steps)? as(?: many as)? {name[1]}", readme
                )
                problems += [
                    f"README.md: {claim} times {name[1]}, measured {measured}" for claim in claims if claim != measured
                ]
                if not claims:
                    problems.append(f"README.md says nothing of {what}")
    return problems


def builds(pages: Pages) -> list[str]:
    """How long a build takes is said with one set of figures."""
    agreed = r"takes (\d+) minutes on two idle cores of an AVX-512 EPYC"
    claim = r"\b(?:build|builds|compiles|takes)\b[^.|]{0,80}?\d+ min(?:utes)? on two [^.|]*?AVX-512[^.|]*"
    said: dict[tuple[str, ...], str] = {}
    problems = []
    for page, text in pages.items():
        for match in re.finditer(claim, flat(text)):
            if "build" not in match[0] and "compile" not in match[0]:
                continue  # how long a training takes
            figures = re.search(agreed, match[0])
            if figures is None:
                problems.append(f"{page}: {match[0]!r}: write it as README.md does")
            else:
                said[figures.groups()] = page
    if len(said) > 1:
        problems.append(f"other figures on other pages: {said}")
    return problems


def start(pages: Pages) -> list[str]:
    """The README's first block clones.

    Then one command shows something and one tests everything.
    """
    block = re.search(r"^```bash$(.*?)^```$", pages["README.md"], flags=re.MULTILINE | re.DOTALL)
    lines = [line.partition("#")[0].strip() for line in block[1].strip().splitlines()] if block else []
    problems = [] if lines and lines[0].startswith("git clone ") else ["README.md does not begin with git clone"]
    wanted = ("make demo", "make test")
    return problems + [f"README.md: the first block lacks {line}" for line in wanted if line not in lines[1:]]


def versions(pages: Pages) -> list[str]:
    """Versions are those of the manifests, and of one peer the same on all pages."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    cargo = tomllib.loads((ROOT / "Cargo.toml").read_text(encoding="utf-8"))["workspace"]["package"]
    (torch,) = re.findall(r"torch>=([\d.]+)", " ".join(project["optional-dependencies"]["train"]))
    wanted = {
        r"Python (3\.\d+) or newer": project["requires-python"].removeprefix(">="),
        r"torch >= ([\d.]+\d)": torch,
        r"polypod-(\d+\.\d+\.\d+)-": cargo["version"],
        r"git clone (\S+)": cargo["repository"],
        r"opset (\d+)": polypod_opset(),
    }
    problems = []
    for page, text in pages.items():
        for pattern, value in wanted.items():
            problems += [
                f"{page}: {match[0]!r}, and it is {value}" for match in re.finditer(pattern, text) if match[1] != value
            ]
    for peer in ("mjlab", "Isaac Lab", "MuJoCo Warp"):
        said = {
            match for text in pages.values() for match in re.findall(rf"{peer}\]?(?:\[\w+\])?,? (\d+(?:\.\d+)?)", text)
        }
        majors = {text.partition(".")[0] for text in said}
        if len(majors) > 1 or len({text for text in said if "." in text}) > 1:
            problems.append(f"{peer} has several versions: {', '.join(sorted(said))}")
    return problems


def polypod_opset() -> str:
    """Read, not imported: the module needs torch, which takes seconds."""
    source = (ROOT / "python" / "polypod" / "policy.py").read_text(encoding="utf-8")
    (opset,) = re.findall(r"^OPSET = (\d+)$", source, flags=re.MULTILINE)
    return str(opset)


# Features and names


def trainings(pages: Pages) -> list[str]:
    """The tables of train configs name all configs, with their envs and iterations."""
    problems = []
    for page in ("docs/train.md", "docs/networks.md"):
        for rows in tables(pages[page]):
            for row in rows:
                cells = list(row.values())
                if next(iter(row)) not in ("config", "train config"):
                    continue
                for name in re.findall(r"`(\w+)`", cells[0].partition(" bundled as ")[0]):
                    if not (ROOT / "configs" / "train" / f"{name}.toml").is_file():
                        problems.append(f"{page}: no train config {name}")
                        continue
                    run = config.load(name).run
                    said = {"max_iterations": r"(\d+) iterations", "num_envs": r"(\d+) envs"}
                    for key, pattern in said.items():
                        wrong = [n for n in re.findall(pattern, cells[-1]) if int(n) != getattr(run, key)]
                        problems += [f"{page}: {name}: {key} is {getattr(run, key)}, not {n}" for n in wrong]
    return problems


def names(pages: Pages) -> list[str]:
    """Tasks and robots that a page names in its text are built in.

    Tables of old trainings may name others.
    """
    tasks = {name for task in _core.tasks() for name in (task["name"], *task["aliases"])}
    robots = {robot["name"] for robot in _core.robots()}
    makers = "|".join(sorted({robot.partition("_")[0] for robot in robots if "_" in robot} - {"box"}))
    sets = {name for file in (ROOT / "configs" / "tasks").glob("*.toml")
            for name in tomllib.loads(file.read_text(encoding="utf-8")).get("rewards", {})}  # fmt: skip
    problems = []
    for page, text in pages.items():
        for code in codes(re.sub(r"<!-- results:begin -->.*<!-- results:end -->", "", text, flags=re.DOTALL)):
            if re.fullmatch(r"Velocity-[\w-]+-v0", code) and code not in tasks and "Big-Dog" not in code:
                problems.append(f"{page}: no task {code}")
            if re.fullmatch(rf"(?:{makers})_\w+", code) and code not in robots | sets | EMBODIED:
                problems.append(f"{page}: no robot {code}")
    return problems


def precision(pages: Pages) -> list[str]:
    """Only single precision does without libm: a sentence that denies it says so."""
    sentences = [(page, text) for page in pages for text in re.split(r"(?<=[a-z`)])\. ", flat(pages[page]))]
    said = [(page, text[-200:]) for page, text in sentences if "no libm" in text]
    return [f"{page}: {text!r}" for page, text in said if not re.search(r"`f32`|single precision", text)]


EMBODIED = {"berkeley_drafted", "unitree_sdk2"}
"""Other names that begin like a robot: a library and a stage of a recipe."""


MISSING = re.compile(r"^## (Not (?:there|modelled|promised).*)$", re.MULTILINE)


def missing_items(pages: Pages) -> Iterator[tuple[str, str]]:
    """Page and text of what sections such as "Not modelled" list."""
    for page, text in pages.items():
        for section in MISSING.finditer(text):
            body = text[section.end() :].partition("\n## ")[0]
            for item in re.split(r"^(?:- |\| )", body, flags=re.MULTILINE)[1:]:
                yield page, " ".join(item.split())


def missing(pages: Pages) -> list[str]:
    """A thing that a page calls missing is no subject of another page.

    Else the page links there and says which part.
    """
    subjects = {}
    for page, text in PAGES.items():
        for heading in re.findall(r"^#{1,2} (.+)$", text, flags=re.MULTILINE):
            if len(heading.split()) >= 2 and not MISSING.match(f"## {heading}"):
                subjects[heading.lower()] = page
    problems = []
    for page, item in missing_items(pages):
        for subject, other in subjects.items():
            if other != page and subject in item.lower() and Path(other).name not in item:
                problems.append(f"{page}: {item!r} is said to be missing, and {other} describes it; link there")
    return problems


COMMAND_PAGES = {"export": "docs/export.md", "sim2sim": "docs/evaluate.md", "play": "docs/viewer.md"}


def support(pages: Pages) -> list[str]:
    """A table that says "no export" of something is not contradicted by the page of the command."""
    problems = []
    for page, text in pages.items():
        for rows in tables(text):
            for row in rows:
                subject, *cells = row.values()
                for command in re.findall(r"\bno `?(export|sim2sim|play)`?", " ".join(cells)):
                    described = [
                        other
                        for other in {COMMAND_PAGES[command], "docs/train.md"}
                        if subject.lower() in PAGES[other].lower()
                    ]
                    if described:
                        problems.append(f"{page}: {subject}: no {command}, and {', '.join(described)} describes it")
    return problems


def extras(pages: Pages) -> list[str]:
    """The extras of the package are the list of docs/develop.md; every page names only these."""
    known = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"][
        "optional-dependencies"
    ].keys()
    listed: set[str] = set()
    for rows in tables(pages["docs/develop.md"]):
        if "extra" in rows[0]:
            listed = {name for row in rows for name in re.findall(r"`(\w+)`", row["extra"])}
    problems = [f"docs/develop.md: the table of extras lacks or adds {name}" for name in listed ^ known]
    for page, text in pages.items():
        named = re.findall(r"polypod\[([\w,]+)\]", text) + re.findall(r"\bextras? `(\w+)`", flat(text))
        problems += [f"{page}: no extra {name}" for names in named for name in names.split(",") if name not in known]
    return problems


def learners(pages: Pages) -> list[str]:
    """The learners of README.md, of docs/learners.md and of the extra are the same."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    packages = {re.split(r"[\[>]", entry)[0] for entry in project["optional-dependencies"]["learners"]}
    of_package = {"ray": "RLlib", "skrl": "skrl", "stable-baselines3": "Stable-Baselines3", "torchrl": "TorchRL"}
    wanted = {of_package[package] for package in packages} | {"rsl_rl"}
    listed: set[str] = set()
    for rows in tables(pages["docs/learners.md"]):
        if "learner" in rows[0]:
            listed = {row["learner"] for row in rows} - {"anything else"}
    readme = re.search(r"It works with ([^:]+):", flat(pages["README.md"]))
    named = set(re.split(r", | and ", readme[1])) if readme else set()
    return [f"{where} names {sorted(names)}, and there are {sorted(wanted)}" for where, names in
            (("docs/learners.md", listed), ("README.md", named)) if names != wanted]  # fmt: skip


def shapes(pages: Pages) -> list[str]:
    """No page gives the actions of any batch the 12 columns of quadrupeds."""
    patterns = (r"actions `\[num_envs, \d+\]`", r"\b\d{3,} \* 12\b")
    return [f"{page}: {match[0]}" for page, text in pages.items() for pattern in patterns
            for match in re.finditer(pattern, text)]  # fmt: skip


# Names, paths and links


FOLDERS = (
    "assets",
    "benches",
    "configs",
    "crates",
    "docs",
    "examples",
    "fuzz",
    "python",
    "src",
    "systems",
    "tests",
)
FOLDERS += (".github", ".ci", ".config")
MADE_BY_A_READER = ("my_", "big_dog")
"""How names of files begin that the examples of the pages make."""


def codes(text: str) -> Iterator[str]:
    """Inline code of a page, without fenced blocks."""
    for code in re.findall(r"(?<!`)`([^`]+)`(?!`)", re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)):
        yield " ".join(code.split())


def paths(pages: Pages) -> list[str]:
    """Files and folders that a page names exist."""
    tests = {path.name for path in ROOT.glob("tests/**/*.*")}
    problems = []
    for page, text in pages.items():
        for code in codes(text):
            path = code.partition("::")[0].partition(":")[0]
            if re.fullmatch(r"test_\w+\.py", path):
                if path not in tests:
                    problems.append(f"{page}: no test {path}")
            elif any(part.startswith(MADE_BY_A_READER) for part in path.split("/")):
                continue
            elif re.fullmatch(r"[\w.*<>/-]+", path) and path.partition("/")[0] in FOLDERS and "/" in path:
                pattern = re.sub(r"<\w+>", "*", path).rstrip("/")
                near = (ROOT, ROOT / "docs", (ROOT / page).parent)
                if not any(any(folder.glob(pattern)) for folder in near):
                    problems.append(f"{page}: no {path}")
    return problems


def slug(heading: str) -> str:
    text = re.sub(r"\[([^\]]+)\]\([^)]*\)", r"\1", heading).replace("`", "").strip().lower()
    return re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", text)).strip("-")


def headings(text: str) -> set[str]:
    is_code, found = False, set()
    for line in text.splitlines():
        is_code ^= line.lstrip().startswith("```")
        if not is_code and (heading := re.match(r"#{1,6} (.+)", line)):
            found.add(slug(heading[1]))
    return found


def links(pages: Pages) -> list[str]:
    """Links lead to files of the repository, their anchors to headings."""
    problems = []
    for page, text in pages.items():
        prose = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
        inline = re.findall(r"\]\(([^)\s]+)\)", prose) + re.findall(r"^\[[^\]]+\]: (\S+)", prose, flags=re.MULTILINE)
        for target in inline:
            if (
                re.match(r"https?:|mailto:", target)
                or "::" in target
                or (page.startswith("src/") and "/" not in target)
            ):
                continue
            file, _, anchor = target.partition("#")
            path = (ROOT / page).parent / file if file else ROOT / page
            if not path.exists():
                problems.append(f"{page}: the link {target} leads nowhere")
            elif anchor and path.suffix == ".md":
                there = text if not file else path.read_text(encoding="utf-8")
                if anchor not in headings(there):
                    problems.append(f"{page}: {target}: no such heading")
    return problems


def nav(pages: Pages) -> list[str]:
    """The site's navigation has every page."""
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    return [f"mkdocs.yml lacks {page}" for page in pages
            if page.startswith("docs/") and page.removeprefix("docs/") not in text]  # fmt: skip


@cache
def help_of(*command: str) -> str:
    """Output of `polypod COMMAND --help`."""
    with redirect_stdout(io.StringIO()) as printed, pytest.raises(SystemExit):
        cli.main([*command, "--help"])
    return printed.getvalue()


@cache
def simulator_flags() -> set[str]:
    flags = {"--help"}
    for source in (ROOT / "crates" / "sim" / "src" / "cli").glob("*.rs"):
        for attribute, field in re.findall(
            r"#\[arg\((.*?)\)\]\s+(?:pub )?(\w+):", source.read_text(encoding="utf-8"), re.DOTALL
        ):
            flags |= {f"--{field.replace('_', '-')}", *(f"--{name}" for name in re.findall(r'"([\w-]+)"', attribute))}
    return flags


@cache
def every_flag() -> set[str]:
    pages = [help_of(command) for command in cli.COMMANDS]
    return {flag for page in pages for flag in re.findall(r"--[a-z][\w-]*", page)} | simulator_flags()


FOREIGN = {
    "--tyro-print-completion",
    "--locked",
    "--deterministic",
    "--nocapture",
    "--nnodes",
    "--nproc-per-node",
    "--build-arg",
    "--fmad",
    "--use_fast_math",
}
"""Flags of other programs, and of the library that reads the command line."""


def commands(pages: Pages) -> list[str]:
    """Commands and flags in the text of a page exist.

    `test_docs_run.py` holds the same for its fenced blocks.
    """
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    problems = []
    for page, text in pages.items():
        for code in codes(text):
            words = code.split()
            if words[0] == "make" and len(words) > 1 and re.fullmatch(r"[a-z-]+", words[1]):
                if not re.search(rf"^{words[1]}:", makefile, re.MULTILINE):
                    problems.append(f"{page}: no target {code}")
            elif words[0].rpartition("/")[2] == "polypod" and len(words) > 1 and re.fullmatch(r"[a-z]\w+", words[1]):
                problems += [f"{page}: no command {code}"] if words[1] not in cli.COMMANDS else []
            if re.match(r"(?:\S*/)?polypod(?:-sim)? |--[a-z]", code):
                flags = {flag.replace("_", "-") for flag in re.findall(r"(?<![\w-])(--[a-z][\w-]*)", code)}
                problems += [f"{page}: no flag {flag}: {code}" for flag in sorted(flags - every_flag() - FOREIGN)]
    return problems


RULES: tuple[Callable[[Pages], list[str]], ...] = (
    library,
    policies,
    speeds,
    builds,
    start,
    versions,
    trainings,
    names,
    precision,
    missing,
    support,
    extras,
    learners,
    shapes,
    paths,
    links,
    nav,
    commands,
)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_pages_agree(rule):
    assert rule(PAGES) == []


WRONG = (
    ("library", "README.md", "26 robots are built in."),
    ("library", "README.md", "The largest deviations from MuJoCo 4.0.0, over 8 robots; 5 stand."),
    ("library", "docs/accuracy.md", "The README's summary is of the\nfirst nine robots."),
    ("library", "docs/networks.md", "A policy over 25 robots on two, four and six legs."),
    ("policies", "README.md", "One walks with 17 bodies on two, four and six legs."),
    ("policies", "README.md", "`legged` walks with 22 of 25 kinds."),
    ("policies", "docs/status.md", "It walks with 23 of 25."),
    ("policies", "README.md", "Both walk with eight of eight quadrupeds."),
    (
        "policies",
        "docs/networks.md",
        "| robot | err xy | turn | drift | walks |\n|---|---|---|---|---|\n| spot | 0 | 0 | 0 | yes |",
    ),
    ("speeds", "README.md", "Its physics takes 1 to 2 times as many steps as `mujoco.rollout`."),
    ("speeds", "README.md", "Its physics takes 1 to 2 times as many as `mujoco.batch`."),
    ("builds", "docs/first-run.md", "`make build` compiles 370 crates: 8 minutes on two cores of an AVX-512 Xeon."),
    ("versions", "docs/first-run.md", "It needs Python 3.9 or newer."),
    ("versions", "docs/performance.md", "mjlab 1.5 does this."),
    ("versions", "docs/export.md", "The graphs use opset 3."),
    ("trainings", "docs/train.md", "| config | differs |\n|---|---|\n| `quick` | 651 iterations |"),
    ("trainings", "docs/train.md", "| config | differs |\n|---|---|\n| `quick` | of 1023 envs |"),
    ("trainings", "docs/networks.md", "| train config | robots |\n|---|---|\n| `quickest` | eight |"),
    ("precision", "docs/reproducibility.md", "Every operation of the engine is one IEEE operation per lane; no\nlibm."),
    ("names", "docs/task.md", "`Velocity-Flat-Snake-v0`"),
    ("names", "docs/results.md", "`unitree_z9` walks."),
    ("missing", "docs/physics.md", "## Not modelled\n\n- Learned actuator networks, motor heating."),
    ("missing", "docs/status.md", "## Not there\n\n- Policies that\n  remember."),
    ("support", "docs/networks.md", "| network | tools |\n|---|---|\n| recurrent | no export, no `sim2sim` |"),
    ("extras", "docs/viewer.md", "`pip install 'polypod[film]'`"),
    ("extras", "docs/viewer.md", "It needs the extra `films`."),
    ("shapes", "docs/learners.md", "actions `[num_envs, 12]`, rewards"),
    ("shapes", "src/README.md", "let actions = vec![0.0; 4096 * 12];"),
    ("paths", "docs/status.md", "`tests/python/test_that_nobody_wrote.py`"),
    ("paths", "docs/status.md", "`test_that_nobody_wrote.py`"),
    ("paths", "docs/physics.md", "`src/physics/nothing.rs`"),
    ("links", "docs/physics.md", "[there](nowhere.md)"),
    ("links", "docs/physics.md", "[there](train.md#a-heading-that-is-not-there)"),
    ("links", "README.md", "[there]: docs/nowhere.md"),
    ("commands", "docs/train.md", "`polypod tarin` does it."),
    ("commands", "docs/train.md", "`polypod train --num-robots 3` does it."),
    ("commands", "docs/train.md", "`--num-robots` does it."),
    ("commands", "docs/train.md", "`make everything` does it."),
)
"""A rule, a page, and what the rule must find when it stands at the page's end."""


@cache
def standing(rule: Callable[[Pages], list[str]]) -> set[str]:
    """Findings of a rule in the pages of the repository: none, where `test_pages_agree` passes."""
    return set(rule(PAGES))


@pytest.mark.parametrize(("rule", "page", "text"), WRONG, ids=range(len(WRONG)))
def test_rules_find_what_they_are_for(rule, page, text):
    (check,) = (candidate for candidate in RULES if candidate.__name__ == rule)
    spoiled = {**PAGES, page: f"{PAGES[page]}\n\n{text}\n"}
    assert set(check(spoiled)) - standing(check), f"{rule} does not find {text!r}"


def test_a_first_block_without_the_tests_or_the_clone_is_found():
    readme = PAGES["README.md"]
    assert start({**PAGES, "README.md": readme.replace("make test ", "make lint ")})
    assert start({**PAGES, "README.md": readme.replace("git clone ", "git pull ")})
    assert start({**PAGES, "README.md": readme.replace("```bash\n", "```bash\nmake build\n", 1)})


def test_a_page_out_of_the_navigation_and_lists_that_shrink_are_found():
    assert nav({**PAGES, "docs/lost.md": "# Lost"})
    assert extras({**PAGES, "docs/develop.md": PAGES["docs/develop.md"].replace("| `ray` |", "| `rai` |")})
    assert learners({**PAGES, "README.md": PAGES["README.md"].replace(", skrl,", ",")})
    assert learners({**PAGES, "docs/learners.md": PAGES["docs/learners.md"].replace("| skrl |", "| skirl |")})
