"""The commands that the pages show, as shells would read them."""

from __future__ import annotations

import functools
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = (
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md")),
    *(page for folder in ("docs", "charts", "examples") for page in sorted((ROOT / folder).rglob("*.md"))),
)
SHELL_BLOCKS = {"", "sh", "bash", "console"}
"""What blocks of commands say behind their fence. Drawings and output say `text`."""

BEGINNINGS = {
    "fractus", "kubectl", "helm", "make", "docker", "buildah", "python", "uv", "pip", "pytest", "ssh", "kind", "k3s", "ctr",
}  # fmt: skip
"""First words of what is a command, rather than a name, between backticks in a sentence."""

PLACEHOLDERS = (
    "APP", "COMMAND", "DIR", "DRONE", "FILE", "FORMAT", "HOST", "IMAGE", "MANIFESTS", "MOBILITY-POD", "NAME", "NODE",
    "POD", "PORT", "SERVER", "TOKEN", "URL", "OWNER", "REPOSITORY", "X.Y.Z",
)  # fmt: skip
"""What a reader puts something else for."""

SUBSTITUTED = "SUBSTITUTED"
"""What another command prints: $(...)."""

_PLACEHOLDER = re.compile(rf"(?<![\w-])({'|'.join(map(re.escape, (*PLACEHOLDERS, SUBSTITUTED)))})(?![\w-])")
_SPAN = re.compile(r"(?<!`)`([^`]+)`(?!`)")
_VARIABLE = re.compile(r"([A-Z][A-Z0-9_]*)=(.*)", re.DOTALL)
_OPERATORS = re.compile(r"[|&;<>]+")


@dataclass(frozen=True, slots=True)
class Command:
    """One command of a page.

    Attributes:
        page: relative to the repository.
        line: where it begins.
        argv: its words, without variables before it and without redirections.
        variables: what is set for it alone.
        in_sentence: whether it stands between backticks in a sentence, where what is meant need not be complete.
        output: what the page says that it prints.
        text: the line that it is a part of.
    """

    page: str
    line: int
    argv: tuple[str, ...]
    variables: tuple[str, ...] = ()
    in_sentence: bool = False
    output: tuple[str, ...] = ()
    text: str = ""

    @property
    def shown(self) -> str:
        """As messages name it."""
        return f"{self.page}:{self.line}: {self.text}"


@dataclass(slots=True)
class _Block:
    """Lines of a block of commands, with their numbers."""

    lines: list[tuple[int, str]] = field(default_factory=list)


def has_placeholder(word: str) -> bool:
    """Whether a reader puts something else for a part of a word."""
    return _PLACEHOLDER.search(word) is not None


def placeholders(word: str) -> list[str]:
    """The parts of a word for which a reader puts something else."""
    return [found for found in _PLACEHOLDER.findall(word) if found != SUBSTITUTED]


@functools.cache
def every_command() -> list[Command]:
    """All commands of all pages."""
    return [command for page in PAGES for command in commands(str(page.relative_to(ROOT)), page.read_text())]


def commands(page: str, text: str) -> list[Command]:
    """The commands of a page, in the order in which they stand there."""
    blocks, prose = _parts(text)
    found = [command for block in blocks for command in _typed(page, block)]
    found += [command for number, span in _spans(prose) for command in _parsed(page, number, span, in_sentence=True)]
    return sorted(found, key=lambda command: command.line)


def typed_lines(page: str, section: str = "") -> list[str]:
    """What the blocks of a page have a reader type, line by line; or those of a section, by its heading."""
    text = (ROOT / page).read_text()
    if section:
        _, heading, rest = text.partition(f"\n## {section}\n")
        assert heading, f"{page} has no section {section}"
        text = rest.partition("\n## ")[0]
    return [typed for block in _parts(text)[0] for _, typed, _ in _lines(block)]


def _parts(text: str) -> tuple[list[_Block], list[str]]:
    """Blocks of commands, fenced or indented; and the lines of everything else but blocks, with empty ones in their places."""
    blocks: list[_Block] = []
    prose: list[str] = []
    fence: str | None = None
    block: _Block | None = None
    before = ""
    for number, line in enumerate(text.splitlines(), 1):
        mark = re.match(r"\s*```(\w*)", line)
        indented = line.startswith("    ") and (block is not None or not before.strip() or before.startswith("#"))
        if mark:
            fence = mark[1] if fence is None else None
            block = _Block() if fence in SHELL_BLOCKS else None
            if block is not None:
                blocks.append(block)
        elif fence is None and indented:
            if block is None:
                block = _Block()
                blocks.append(block)
            block.lines.append((number, line[4:]))
        elif fence is not None and block is not None:
            block.lines.append((number, line))
        elif fence is None:
            block = None
        prose.append(line if fence is None and not mark and not indented else "")
        before = line
    return blocks, prose


def _typed(page: str, block: _Block) -> Iterator[Command]:
    """The commands of each line of a block."""
    for number, typed, output in _lines(block):
        *most, last = _parsed(page, number, typed) or [None]
        yield from (one for one in most if one is not None)
        if last is not None:
            yield Command(**{**_fields(last), "output": tuple(output)})


def _lines(block: _Block) -> list[tuple[int, str, list[str]]]:
    """Where each line of a block begins, what is typed, and what it prints; where some begin with $, what follows is output."""
    marked = any(line.startswith("$ ") for _, line in block.lines)
    lines = iter(block.lines)
    found: list[tuple[int, str, list[str]]] = []
    for number, line in lines:
        if marked and not line.startswith("$ "):
            found[-1][2].append(line)
            continue
        typed = line.removeprefix("$ ") if marked else line
        while typed.endswith("\\"):
            typed = typed[:-1] + next(lines)[1]
        if typed.strip():
            found.append((number, typed, []))
    return found


def _fields(command: Command) -> dict[str, object]:
    return {name: getattr(command, name) for name in Command.__slots__}


def _spans(prose: list[str]) -> Iterator[tuple[int, str]]:
    text = "\n".join(prose)
    for match in _SPAN.finditer(text):
        words = match[1].split()
        while words and _VARIABLE.fullmatch(words[0]):
            words = words[1:]
        program = Path(words[0]).name if words else ""
        if len(words) > 1 and (program in BEGINNINGS or program.endswith(".py")):
            yield text.count("\n", 0, match.start()) + 1, " ".join(match[1].split())


def _parsed(page: str, line: int, text: str, *, in_sentence: bool = False) -> list[Command]:
    """The simple commands of a line: those in $(...) first, then those of its pipes."""
    found: list[Command] = []
    outer = text
    while inner := re.search(r"\$\(([^()]*)\)", outer):
        found += _parsed(page, line, inner[1], in_sentence=in_sentence)
        outer = outer[: inner.start()] + SUBSTITUTED + outer[inner.end() :]
    lexer = shlex.shlex(outer, posix=True, punctuation_chars="|&;<>")
    lexer.whitespace_split, lexer.commenters = True, "#"
    words: list[str] = []
    tokens = [*lexer, ";"]
    for i, token in enumerate(tokens):
        if i and re.fullmatch("[<>]+", tokens[i - 1]):
            continue
        if not _OPERATORS.fullmatch(token):
            words.append(token)
        elif set(token) & set("|&;") and words:
            count = next((at for at, word in enumerate(words) if not _VARIABLE.fullmatch(word)), len(words))
            found.append(
                Command(page, line, tuple(words[count:]), tuple(words[:count]), in_sentence, text=text.strip())
            )
            words = []
    return found
