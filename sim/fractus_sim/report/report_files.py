"""Files of a report, and the common parts of its Markdown page."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    # matplotlib is not imported at run time here, because it takes a second and not every command draws figures.
    from matplotlib.figure import Figure

PAGE = "summary.md"
RESULTS = "report.json"
EXPERIMENT_FILES = (RESULTS, "tracks.geojson", "map.png", "profile.png")
"""Files of the report of an experiment, in addition to the page."""


@dataclass(frozen=True, slots=True)
class Expectation:
    """An expectation of a scenario.

    Attributes:
        text: Description.
        holds: True if the expectation holds.
        observed: Observed value.
        run: Name of the run to which the expectation applies. Empty if the scenario has only one run.
    """

    text: str
    holds: bool
    observed: str
    run: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return the expectation as JSON-compatible values."""
        content: dict[str, Any] = {"text": self.text, "holds": self.holds, "seen": self.observed}
        return {"run": self.run, **content} if self.run else content


def write_report(
    folder: Path,
    page: str,
    results: Mapping[str, Any],
    figures: Mapping[str, Callable[[], Figure]],
    *,
    geojson: Mapping[str, Mapping[str, Any]] | None = None,
    texts: Mapping[str, Callable[[], str]] | None = None,
) -> None:
    """Write the files of a report.

    The results are written first, so that they exist even if a figure cannot be drawn. The page is written last,
    because it links to all other files.

    Args:
        folder: Output folder.
        page: Markdown page.
        results: Machine-readable results.
        figures: Functions that draw the figures, by file name.
        geojson: FeatureCollections by file name.
        texts: Functions that return text files which contain the figures, by file name.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / RESULTS).write_text(json.dumps(results, indent=2) + "\n")
    for name, collection in (geojson or {}).items():
        (folder / name).write_text(json.dumps(collection) + "\n")
    for name, draw in figures.items():
        save_figure(draw(), folder / name)
    for name, text in (texts or {}).items():
        (folder / name).write_text(text())
    write_page(folder, page)


def save_figure(figure: Figure, path: Path) -> None:
    """Write a PNG without dates and versions. The same flight always gives an identical file."""
    figure.savefig(path, metadata={"Software": None})


def remove_report(folder: Path, *names: str) -> None:
    """Remove the page and other files of an earlier run. Otherwise an aborted run would leave an outdated report."""
    for name in (PAGE, *names):
        (folder / name).unlink(missing_ok=True)


def write_page(folder: Path, text: str) -> None:
    """Write the page atomically. It is the last file of a report, so the report is complete if the page exists."""
    scratch = folder / f".{PAGE}"
    try:
        scratch.write_text(text)
        scratch.replace(folder / PAGE)
    finally:
        scratch.unlink(missing_ok=True)


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
    return "\n".join(lines)


def expectations_headline(expectations: Sequence[Expectation]) -> str:
    """Return a sentence with the number of expectations that hold."""
    failed = sum(not expectation.holds for expectation in expectations)
    if failed:
        return f"{failed} of {len(expectations)} expectations do NOT hold."
    return f"All {len(expectations)} expectations hold."


def expectations_table(expectations: Sequence[Expectation]) -> str:
    """Return a table of expectations, with a column for the run if there are several runs."""
    rows = [(e.text, "yes" if e.holds else "**NO**", e.observed) for e in expectations]
    head = ("Expected", "Holds", "Observed")
    if any(expectation.run for expectation in expectations):
        runs = [expectation.run for expectation in expectations]
        return table(("Run", *head), [(run, *row) for run, row in zip(runs, rows, strict=True)])
    return table(head, rows)


def format_duration(seconds: float | None) -> str:
    """Format a duration as seconds, or as minutes and seconds. Return a dash for an unknown duration."""
    if seconds is None:
        return "-"
    whole = round(seconds)
    return f"{seconds:.1f} s" if whole < 60 else f"{whole // 60} min {whole % 60:02d} s"


def rounded(value: float | None) -> float | None:
    """Round a value to two decimals."""
    return None if value is None else round(value, 2)
