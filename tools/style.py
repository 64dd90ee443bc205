"""Checks that comments, docstrings, help texts and pages follow docs/style.md.

Usage:
    tools/style.py [PATH ...]         report file, line, word and remedy; exit code 1 if there is any
    tools/style.py --wrap [PATH ...]  wrap the comments that are too wide, then report

PATH is a file or a folder; by default all files that git tracks. Text in backquotes and in fenced
blocks is not checked. Needs the standard library alone.
"""

import itertools
import re
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
WIDTH = 100
"""Columns of Markdown, comments and docstrings, with their indentation."""
NOT_OURS = re.compile(r"^tests/data/|^target/|^CHANGELOG\.md$")
"""Inputs of tests, build outputs, and the record of past versions."""

NOUN = "name the subject: a noun or a verb in the third person"
OPENINGS = {
    **dict.fromkeys(("what", "that", "those", "which", "who", "whose", "of"), NOUN),
    **dict.fromkeys(("it itself", "likewise", "as above", "the same of"), "say it in full"),
}
"""Openings of a sentence that postpone its subject, with remedies. Questions may have them."""
OPENING = re.compile(rf"(?:{'|'.join(OPENINGS)})\b(?!:)", re.IGNORECASE)

WORDS = {
    r"anew": "again, or a verb such as 'regenerates'",
    r"likewise": "also, or say it in full",
    r"alike": "equal, uniform, both",
    r"whereof|thereof": "of which, of it",
    r"has it": "say whose convention it is: 'as MuJoCo does'",
    r"of (?:its|their) own(?! \w)": "its own X, or 'separate'",
    r"for whose sake": "because of",
    r"(?:is|are) to be": "must be, shall be",
    r"as \w+ as ever": "still",
    r"so many": "the number, or its name",
    r"beside": "next to, compared with, in addition to",
    r"comes? along": "say what happens",
    r"none any more": "say which state it is",
}
"""Words that have a plain equivalent, as patterns, and the equivalent."""
WORD = re.compile(rf"\b(?:{'|'.join(f'({word})' for word in WORDS)})\b", re.IGNORECASE)

UNIT = r"(?:1/)?(?:rad|kg|Hz|[msNJWV])(?:[ /]?(?:rad|[msNJ])(?:\^\d)?)*"
UNITS_ALONE = re.compile(rf"(?:\[[^\]]*\],? ?)?(?:in )?(?:(?:(?:base|world|link) axes|{UNIT})(?:,| or|;)? ?)*[.]?")
"""A shape and units without the quantity that they are of."""

NAMES = {
    "ALIKE": "UNIFORM",
    "Alike": "UniformParameters",
    "Apart": "CachePadded",
    "Crew": "ThreadTeam",
    "Evidence": "DivergenceRecord",
    "LineUp": "PackOrder",
    "Kind": "its noun: DocumentKind, MorphologySetup",
    "LOOKS": "SPINS",
    "Numbers": "SharedArray",
    "OwnNumbers": "ParameterDeltas",
    "PATIENCE": "SPIN_TIME",
    "RowKind": "BlockMarker",
    "Use": "Purpose",
    "Which": "NetworkName",
    "alike": "uniform, similar",
    "ask_nothing": "clear_drive",
    "bench": "workspace",
    "benches": "workspaces",
    "crew": "team",
    "evidence": "record",
    "kinds": "morphologies, or what they are kinds of: joint_kinds",
    "look_down": "scan_terrain",
    "note_touching": "find_touching",
    "treat": "apply_noise_and_scale",
    "visitors": "gathered",
}
"""Names that mean nothing to a reader of the field, and replacements. Definitions are checked."""
_DEFINES = "struct|enum|trait|type|fn|mod|const|static|class|def|let|let mut"
NAME = re.compile(rf"\b(?:{_DEFINES}) ({'|'.join(NAMES)})\b")

FENCE = re.compile(r"\s*(?:```|~~~)")
FIXED = re.compile(r"\s*(?:\||#|!\[|<|\[[^\]]+\]: |[-=*]{3,}\s*$|>>> |\.\. )")
"""Lines that end a paragraph: tables, headings, pictures, tags, targets of links, rules."""
ITEM = re.compile(r"\s*(?:[-*+]|\d+\.) +")
MARKER = re.compile(r" (?=(?:[-*+>]|\d+\.|#+) )")
COLUMNS = re.compile(r"\S {3,}\S")
"""Spaces that align columns of a preformatted line."""
SECTION = re.compile(r"\s*(?:Args|Attributes|Returns|Raises|Yields|Examples?|Notes?|Usage):$")
ENTRY = re.compile(r"\s*\*{0,2}\w[\w.]*(?: \(.*?\))?: ")
CODE = re.compile(r"``[^`]+``|`[^`]+`|\]\([^)\s]*\)")
"""Code, and targets of links."""
PYTHON_TOKEN = re.compile(
    r"""(?P<comment>\#[^\n]*)|(?P<prefix>\b[rfbuRFBU]{1,2}|)(?:\"{3}(?:\\.|[^\\])*?\"{3}|'{3}(?:\\.|[^\\])*?'{3}"""
    r"""|"(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*')""",
    re.DOTALL,
)
"""Comments and strings."""
HELP = re.compile(r"\b(?:help|description|epilog)=\(?\s*$")
DIRECTIVE = re.compile(r"(?:noqa|type:|fmt:|ruff:|mypy:|pragma|/ ?script)\b|!")


@dataclass
class Block:
    """Consecutive lines of one comment, docstring, help text or page.

    Attributes:
        first: number of the first line, from 1.
        lines: lines of the file, whole.
        mark: beginning of each line before its text, such as `    ///`.
        kind: `rust`, `comment`, `docstring`, `attribute`, `help`, `page`, `trailing` or `error`.
    """

    first: int
    lines: list[str]
    mark: str
    kind: str

    @property
    def can_wrap(self) -> bool:
        """Whether the lines hold nothing but this text."""
        return self.kind not in ("help", "trailing", "error")


@dataclass
class Paragraph:
    """Lines of a block that are filled together: `texts` without mark and indentation."""

    first: int
    texts: list[str] = field(default_factory=list)
    indents: list[str] = field(default_factory=list)


@dataclass(frozen=True, order=True)
class Finding:
    """A place that does not follow the style."""

    path: str
    line: int
    word: str
    remedy: str

    def __str__(self) -> str:
        """One line of the report."""
        return f"{self.path}:{self.line}: {self.word}: {self.remedy}"


def rust_blocks(source: str) -> Iterator[Block]:
    """Comments of a Rust file; those behind code are blocks of one line."""
    block: Block | None = None
    for number, line in enumerate(source.split("\n"), start=1):
        own = re.match(r"(\s*)(///|//!|//)(?: |$)", line)
        if own:
            mark = own[1] + own[2]
            if block is None or block.mark != mark:
                if block:
                    yield block
                block = Block(number, [], mark, "rust")
            block.lines.append(line)
            continue
        if block:
            yield block
            block = None
        if error := re.match(r'\s*#\[error\("(.*)"', line):
            yield Block(number, [error[1]], "", "error")
        if " // " in line:
            code, _, text = line.partition(" // ")
            if code.strip() and code.count('"') % 2 == 0:
                yield Block(number, [text], "", "trailing")
    if block:
        yield block


def python_blocks(source: str) -> Iterator[Block]:
    """Docstrings, help texts and comments of a Python file."""
    comments: list[Block] = []
    help_end = -1
    number, position = 1, 0
    for token in PYTHON_TOKEN.finditer(source):
        number += source.count("\n", position, token.start())
        position = token.start()
        begin = source.rfind("\n", 0, position) + 1
        before = source[begin:position]
        if token["comment"] is not None:
            text = token["comment"]
            if DIRECTIVE.match(text[1:].strip()):
                continue
            if before.strip():
                yield Block(number, [text[1:].strip()], "", "trailing")
            elif (
                comments
                and comments[-1].mark == before + "#"
                and number == comments[-1].first + len(comments[-1].lines)
            ):
                comments[-1].lines.append(before + text)
            else:
                comments.append(Block(number, [before + text], before + "#", "comment"))
        elif token["prefix"] is not None and source.startswith('"""', token.start("prefix") + len(token["prefix"])):
            end = source.find("\n", token.end())
            alone = not before.strip() and not source[token.end() : end].strip()
            if alone:
                above = source[:begin].rstrip()
                kind = "docstring" if not above or above.endswith(":") else "attribute"
                yield Block(number, source[begin:end].split("\n"), "", kind)
        elif HELP.search(source, max(0, position - 60), position) or (
            help_end >= 0 and not source[help_end:position].strip()
        ):
            yield Block(number, [token[0].lstrip("frb")[1:-1]], "", "help")
            help_end = token.end()
        else:
            help_end = -1
    yield from comments


def page_blocks(source: str) -> Iterator[Block]:
    """A Markdown page is one block."""
    yield Block(1, source.split("\n"), "", "page")


READERS = {".rs": rust_blocks, ".py": python_blocks, ".pyi": python_blocks, ".md": page_blocks}


def paragraphs(block: Block) -> Iterator[Paragraph]:
    """Paragraphs and list items of a block, without fenced blocks, tables and headings."""
    paragraph: Paragraph | None = None
    is_fenced = is_comment = False
    section = ""
    for index, line in enumerate(block.lines):
        body = line[len(block.mark) :]
        text = body.strip()
        indent = body[: len(body) - len(body.lstrip())]
        if FENCE.match(body):
            is_fenced = not is_fenced
            text = ""
        is_comment = is_comment or text.startswith("<!--")
        ends_comment = is_comment and "-->" in text
        is_entry = section in ("Args", "Attributes", "Raises") and ENTRY.match(body)
        if SECTION.match(body):
            section = text.rstrip(":")
            text = ""
        fixed = is_fenced or is_comment or (block.kind in ("page", "rust") and FIXED.match(text))
        fixed = fixed or text.startswith(("|", ">>> ", "---")) or COLUMNS.search(text)
        if ends_comment:
            is_comment = False
        indented_code = block.kind in ("page", "rust") and len(indent) > 4 and paragraph is None
        if not text or fixed or indented_code or text == '"""':
            if paragraph:
                yield paragraph
            paragraph = None
            continue
        if paragraph is None or ITEM.match(body) or is_entry:
            if paragraph:
                yield paragraph
            paragraph = Paragraph(index)
        paragraph.texts.append(text)
        paragraph.indents.append(indent)
        if block.kind in ("docstring", "page") and text.endswith("::"):
            yield paragraph
            paragraph = None
    if paragraph:
        yield paragraph


def check_block(block: Block, path: str) -> Iterator[Finding]:
    """Units alone, openings, words and wide lines of a block."""
    whole = " ".join(line[len(block.mark) :].strip() for line in block.lines).strip('" ')
    is_documentation = block.kind in ("docstring", "attribute") or block.mark.endswith("///")
    if is_documentation and whole and UNITS_ALONE.fullmatch(whole):
        yield Finding(path, block.first, f"'{whole}' alone", "name the quantity, as in 'Mass, kg.'")
    for paragraph in paragraphs(block):
        for position, word, remedy in check_text(" ".join(paragraph.texts), opens=block.kind != "error"):
            ends = itertools.accumulate(len(text) + 1 for text in paragraph.texts)
            index = sum(end <= position for end in ends)
            yield Finding(path, block.first + paragraph.first + index, word, remedy)
        for index in range(paragraph.first, paragraph.first + len(paragraph.texts)):
            if block.can_wrap and is_wide(block.lines[index], block.mark):
                columns = len(block.lines[index])
                remedy = "shorten the summary" if is_summary(block, paragraph) else "tools/style.py --wrap"
                yield Finding(path, block.first + index, f"{columns} columns, at most {WIDTH}", remedy)


def check_text(text: str, *, opens: bool) -> Iterator[tuple[int, str, str]]:
    """Places, words and remedies in a paragraph; `opens`: whether openings count."""
    plain = CODE.sub(lambda code: "`" * len(code[0]), text)
    for start, sentence in sentences(plain) if opens else ():
        opening = OPENING.match(sentence)
        if opening and not sentence.rstrip(" *_\"')").endswith("?"):
            yield start, f"'{opening[0]}' opens a sentence", OPENINGS[opening[0].lower()]
    for word in WORD.finditer(plain):
        yield word.start(), f"'{word[0]}'", list(WORDS.values())[(word.lastindex or 1) - 1]


def sentences(text: str) -> Iterator[tuple[int, str]]:
    """Start and text of the sentences of a paragraph."""
    marks = [0, *(found.end() for found in re.finditer(r"[.!?][)\"'*_]*\s+(?=[\"'(*_]*[A-Z])", text)), len(text)]
    for start, end in itertools.pairwise(marks):
        lead = re.match(r"(?:\s*(?:[-*+]|\d+\.) )?[\s\"'(*_]*", text[start:end])
        begin = start + (lead.end() if lead else 0)
        yield begin, text[begin:end]


def is_wide(line: str, mark: str) -> bool:
    """Whether a line is too wide and has a place to wrap."""
    return len(line) > WIDTH and " " in line[len(mark) :].strip()


def is_summary(block: Block, paragraph: Paragraph) -> bool:
    """Whether a paragraph is the first line of a docstring, which must stay one line."""
    return block.kind == "docstring" and paragraph.first == 0


def wrap_block(block: Block) -> list[str]:
    """Lines of a block with its wide paragraphs filled."""
    lines = list(block.lines)
    for paragraph in reversed(list(paragraphs(block))):
        first, last = paragraph.first, paragraph.first + len(paragraph.texts)
        if not any(is_wide(line, block.mark) for line in block.lines[first:last]):
            continue
        indent = paragraph.indents[0]
        item = ITEM.match(indent + paragraph.texts[0])
        if len(paragraph.indents) > 1:
            hanging = paragraph.indents[1]
        elif item:
            hanging = " " * item.end()
        else:
            is_entry = block.kind == "docstring" and first > 0 and ENTRY.match(paragraph.texts[0]) and len(indent) >= 8
            hanging = indent + "    " if is_entry else indent
        text = " ".join(paragraph.texts)
        if is_summary(block, paragraph):
            lines[first:last] = wrap_summary(text, indent, closes=last == len(block.lines))
        else:
            closes = block.kind == "docstring" and last == len(block.lines) and text.endswith('"""')
            text = text.removesuffix('"""') if closes else text
            lines[first:last] = fill(text, block.mark + indent, block.mark + hanging)
            if closes:
                lines.append(block.lines[0][: len(block.lines[0]) - len(block.lines[0].lstrip())] + '"""')
    return lines


def wrap_summary(text: str, indent: str, *, closes: bool) -> list[str]:
    """A docstring's first paragraph: its first sentence, an empty line, the rest.

    One sentence stays as it is.
    """
    sentence = re.match(r"(.+?[.]) (?=[A-Z`])(.+)", text)
    if not sentence or len(indent + sentence[1]) > WIDTH:
        return [indent + text]
    rest = sentence[2].removesuffix('"""') if closes else sentence[2]
    return [indent + sentence[1], "", *fill(rest, indent, indent), *([indent + '"""'] if closes else [])]


def fill(text: str, first: str, following: str) -> list[str]:
    """Lines of at most `WIDTH` columns. None begins like a list item by chance."""
    glued = MARKER.sub("\0", text)
    lines = textwrap.wrap(
        glued,
        WIDTH,
        initial_indent=first,
        subsequent_indent=following,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return [line.replace("\0", " ") for line in lines]


def check_names(source: str, path: str) -> Iterator[Finding]:
    """Definitions whose name is on the list."""
    for found in NAME.finditer(source):
        yield Finding(path, 1 + source.count("\n", 0, found.start(1)), f"name '{found[1]}'", NAMES[found[1]])


def check(source: str, path: str) -> list[Finding]:
    """Findings in a file's text; its path says how it is read."""
    suffix = Path(path).suffix
    found = [finding for block in READERS[suffix](source) for finding in check_block(block, path)]
    if suffix != ".md":
        found += check_names(source, path)
    return sorted(set(found))


def wrap(source: str, path: str) -> str:
    """The text of a file with its wide comments filled."""
    lines = source.split("\n")
    blocks = [block for block in READERS[Path(path).suffix](source) if block.can_wrap]
    for block in sorted(blocks, key=lambda block: -block.first):
        lines[block.first - 1 : block.first - 1 + len(block.lines)] = wrap_block(block)
    return "\n".join(lines)


def files(paths: list[str]) -> list[Path]:
    """Files that git tracks, or has not been told to ignore, under the paths."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", "--", *paths],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    names = sorted({name for name in listed.stdout.split("\0") if Path(name).suffix in READERS})
    return [ROOT / name for name in names if not NOT_OURS.match(name) and (ROOT / name).is_file()]


def main() -> int:
    """Reports all findings; the exit code says whether there are any."""
    arguments = sys.argv[1:]
    does_wrap = "--wrap" in arguments
    paths = [str(Path(path).resolve()) for path in arguments if path != "--wrap"]
    count = 0
    for file in files(paths):
        source = file.read_text(encoding="utf-8")
        name = file.relative_to(ROOT).as_posix()
        if does_wrap and (wrapped := wrap(source, name)) != source:
            file.write_text(wrapped, encoding="utf-8")
            source = wrapped
        for finding in check(source, name):
            print(finding)
            count += 1
    if count:
        print(f"{count} findings; docs/style.md says how polypod writes", file=sys.stderr)
    return int(count > 0)


if __name__ == "__main__":
    sys.exit(main())
