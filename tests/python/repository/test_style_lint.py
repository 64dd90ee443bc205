"""`tools/style.py` finds breaches of docs/style.md, says where, and wraps wide comments."""

import importlib.util
import subprocess
import sys

import pytest

from common import ROOT

SCRIPT = ROOT / "tools" / "style.py"


def _load():
    spec = importlib.util.spec_from_file_location("style", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules["style"] = module
    spec.loader.exec_module(module)
    return module


style = _load()
OPENINGS = ("What", "That", "Those", "Which", "Who", "Whose", "Of", "It itself", "Likewise", "As above", "The same of")
WORDS = (
    *("anew", "likewise", "alike", "whereof", "thereof", "has it", "of its own", "for whose sake", "is to be"),
    *("as fast as ever", "so many", "beside", "comes along", "none any more"),
)
LONG = "Word " + "word " * 24


def found(source: str, path: str) -> list[tuple[int, str]]:
    return [(finding.line, finding.word) for finding in style.check(source, path)]


@pytest.mark.parametrize(
    ("path", "template", "line"),
    [
        ("a.rs", "fn f() {{}}\n/// {} the rows have.\nstruct A;\n", 2),
        ("a.rs", "//! A page.\n//!\n//! A sentence\n//! ends. {} it has.\n", 4),
        ("a.rs", "let x = 1; // {} it has\n", 1),
        ("a.py", '"""A module."""\n\nx = 1\n"""{} it has."""\n', 4),
        ("a.py", "x = 1  # {} it has\n", 1),
        ("a.py", '"""A module."""\nparser.add_argument("--x", help="{} it has")\n', 2),
        ("a.md", "# Title\n\n- An item. {} it has.\n", 3),
    ],
)
def test_openings_are_found(path, template, line):
    for opening in OPENINGS:
        assert (line, f"'{opening}' opens a sentence") in found(template.format(opening), path)


@pytest.mark.parametrize("template", ["/// Rows {}, m.\n", "//! Rows {}.\n", '#[error("rows {}: remedy")]\n'])
def test_words_are_found(template):
    for word in WORDS:
        assert found(template.format(word), "a.rs") == [(1, f"'{word}'")]
        assert found(f"Rows {word}.\n", "a.md") == [(1, f"'{word}'")]


def test_names_are_found_where_they_are_defined():
    for name in style.NAMES:
        assert found(f"fn {name}() {{}}\n", "a.rs") == [(1, f"name '{name}'")]
        assert found(f"class {name}:\n    pass\n", "a.py") == [(1, f"name '{name}'")]
        assert found(f"other.{name}()\n", "a.rs") == []


def test_units_alone_are_found():
    for text in ("m.", "rad/s.", "N m s/rad.", "[num_envs, 3], m.", "[n].", "[3], base axes, rad/s."):
        assert found(f'x = 1\n"""{text}"""\n', "a.py") == [(2, f"'{text}' alone")]
        assert found(f"/// {text}\nx: f32,\n", "a.rs") == [(1, f"'{text}' alone")]
        assert found(f"/// Speed, {text}\nx: f32,\n", "a.rs") == []


def test_wide_lines_are_found():
    for path, text in {
        "a.rs": f"    /// {LONG}\n",
        "a.py": f"# {LONG}\n",
        "a.md": f"- {LONG}\n",
    }.items():
        ((line, word),) = found(text, path)
        assert (line, word.split()[1]) == (1, "columns,")


def test_good_style_passes():
    assert found("//! What is a row? A place.\n\n/// Number of rows of `what`.\n// see `beside`\n", "a.rs") == []
    assert (
        found('"""Rows, m."""\n\ndef f(of):\n    """Gives rows.\n\n    Args:\n        of: it.\n    """\n', "a.py") == []
    )
    assert found(f"# What it is\n\n| Of {LONG}|\n\n```text\nWhat {LONG}\n```\n\n[a](#beside)\n", "a.md") == []
    assert found(f'let x = "{LONG} // What"; let url = "https://a";\n', "a.rs") == []
    assert found(f's = "# What {LONG}"\n', "a.py") == []


def test_wide_comments_are_wrapped():
    rust = f"/// Rows.\n///\n/// - {LONG}\n///   `a`\n///\n/// ```text\n/// {LONG}\n/// ```\n"
    wrapped = style.wrap(rust, "a.rs")
    assert [line for line in wrapped.split("\n") if len(line) > style.WIDTH] == [f"/// {LONG}"]
    assert "\n///   word" in wrapped
    assert wrapped.replace("///", "").split() == rust.replace("///", "").split()
    assert style.wrap(wrapped, "a.rs") == wrapped

    chance = f"/// {'word ' * 18}number - 1 word\n"
    assert style.wrap(chance, "a.rs").endswith("word\n/// number - 1 word\n")

    python = f'def f():\n    """One. {LONG}"""\n    # {LONG}\n    x = 1\n    """{LONG}"""\n'
    wrapped = style.wrap(python, "a.py")
    assert max(map(len, wrapped.split("\n"))) <= style.WIDTH
    assert wrapped.startswith('def f():\n    """One.\n\n    Word')
    compile(wrapped, "a.py", "exec")
    assert style.wrap(wrapped, "a.py") == wrapped


def test_a_summary_of_one_sentence_is_left_to_its_writer():
    source = f'def f():\n    """{LONG}"""\n'
    assert style.wrap(source, "a.py") == source
    assert [finding.remedy for finding in style.check(source, "a.py")] == ["shorten the summary"]


def test_the_command_reports_places_and_fails(tmp_path):
    bad = ROOT / "tools" / f"bad_{tmp_path.name}.py"
    bad.write_text('"""A module."""\n\nx = 1\n"""What it is."""\n', encoding="utf-8")
    try:
        run = subprocess.run([sys.executable, SCRIPT, bad], capture_output=True, text=True, check=False, timeout=60)
    finally:
        bad.unlink()
    assert run.returncode == 1
    assert run.stdout.startswith(f"tools/{bad.name}:4: 'What' opens a sentence: name the subject")
    good = subprocess.run([sys.executable, SCRIPT, SCRIPT], capture_output=True, text=True, check=False, timeout=60)
    assert (good.returncode, good.stdout) == (0, "")
