"""Shell commands and files that pages of the documentation show."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGES = (
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md")),
    *(page for folder in ("docs", "charts", "examples") for page in sorted((ROOT / folder).rglob("*.md"))),
)
_SHELL = {"", "sh", "bash", "console"}


def shell_lines(page: str, section: str = "") -> list[str]:
    """Return the lines that a page has the reader type, without prompts and with continued lines joined.

    Shell blocks are fenced without a language (or as sh, bash or console), or indented by four spaces. If lines of a block
    begin with `$ `, its other lines are output.

    Args:
        page: Path of the page, relative to the repository.
        section: Heading of the section (`## `) to read. Empty for the whole page.
    """
    text = (ROOT / page).read_text()
    if section:
        _, heading, rest = text.partition(f"\n## {section}\n")
        assert heading, f"{page} has no section {section}"
        text = rest.partition("\n## ")[0]
    lines: list[str] = []
    for block in _parts(text)[0]:
        typed = [line.strip() for line in "\n".join(block).replace("\\\n", "").splitlines() if line.strip()]
        prompts = [line.removeprefix("$ ") for line in typed if line.startswith("$ ")]
        lines += prompts or typed
    return lines


def code_spans(page: str) -> list[str]:
    """Return the texts between single backticks in the sentences of a page."""
    prose = _parts((ROOT / page).read_text())[1]
    return [" ".join(span.split()) for span in re.findall(r"(?<!`)`([^`]+)`(?!`)", prose)]


def _parts(text: str) -> tuple[list[list[str]], str]:
    """Split a page into its shell blocks, as lines, and the text outside of all blocks."""
    blocks: list[list[str]] = []
    prose: list[str] = []
    language: str | None = None
    indented = False
    before = ""
    for line in text.splitlines():
        fence = re.match(r"\s*```(\w*)", line)
        if fence:
            language = fence[1] if language is None else None
            if language in _SHELL:
                blocks.append([])
        elif language is not None:
            if language in _SHELL:
                blocks[-1].append(line)
        elif line.startswith("    ") and (indented or not before.strip()):
            if not indented:
                blocks.append([])
            indented = True
            blocks[-1].append(line[4:])
        else:
            indented = False
            prose.append(line)
        before = line
    return blocks, "\n".join(prose)


def shown_file(page: str, name: str) -> str:
    """Return the content of a file that a page shows after its name: the first block after "`NAME` ...:"."""
    found = re.search(rf"`{re.escape(name)}`[^`\n]*:\n```\w+\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)
    assert found is not None, f"{page} does not show {name}"
    return found[1]
