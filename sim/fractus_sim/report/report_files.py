"""Common parts of the pages: Markdown tables and time formats."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

PAGE = "summary.md"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
    return "\n".join(lines)


def clock(seconds: float | None) -> str:
    """Format a duration."""
    if seconds is None:
        return "-"
    whole = round(seconds)
    return f"{seconds:.1f} s" if whole < 60 else f"{whole // 60} min {whole % 60:02d} s"


def rounded(value: float | None) -> float | None:
    """Round a value to two decimals."""
    return None if value is None else round(value, 2)


def write_page(folder: Path, text: str) -> None:
    """Write the page atomically, as the last file of a report. If the page exists, the report is complete."""
    scratch = folder / f".{PAGE}"
    try:
        scratch.write_text(text)
        scratch.replace(folder / PAGE)
    finally:
        scratch.unlink(missing_ok=True)
