"""Figures as Prometheus reads them: gauges, counters and histograms, and its text format.

Prometheus' own library for Python loads two web servers, which takes each workload of a node megabytes of a companion computer's memory.
"""

from __future__ import annotations

import bisect
import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"

Sample = tuple[str, Mapping[str, str], float]
"""What follows the figure's name, labels, and the value."""


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure as it is now.

    Attributes:
        name: of the metric, with its unit.
        text: what it is.
        kind: how Prometheus takes it.
        samples: its values.
    """

    name: str
    text: str
    kind: Literal["gauge", "counter", "histogram"]
    samples: Sequence[Sample]


def gauge(name: str, text: str, value: float | Mapping[str, float], label: str = "") -> Figure:
    """A figure that goes up and down, or one for each value of a label.

    Args:
        name: of the metric, with its unit.
        text: what it is.
        value: the figure, or figures by the label's values.
        label: name of the label.
    """
    values = value if isinstance(value, Mapping) else {"": value}
    return Figure(name, text, "gauge", [("", {label: key} if label else {}, each) for key, each in values.items()])


class Counter:
    """Counts what happens, by labels.

    Args:
        name: of the metric, which ends in `_total`.
        text: what it is.
        labels: their names.
    """

    def __init__(self, name: str, text: str, *labels: str) -> None:
        self._name, self._text, self._labels = name, text, labels
        self._counts: dict[tuple[str, ...], float] = {}

    def count(self, *values: str) -> None:
        """One more, with these values of the labels."""
        self._counts[values] = self.counted(*values) + 1.0

    def counted(self, *values: str) -> float:
        """How many there were."""
        return self._counts.get(values, 0.0)

    def figure(self) -> Figure:
        """The figure as it is now."""
        samples = [("", dict(zip(self._labels, key, strict=True)), count) for key, count in self._counts.items()]
        return Figure(self._name, self._text, "counter", samples)


class Histogram:
    """Counts durations by how long they are, and by a label.

    Args:
        name: of the metric, which ends in `_seconds`.
        text: what it is.
        label: its name.
        bounds_s: upper ends of the classes, ascending; one without end follows.
    """

    def __init__(self, name: str, text: str, label: str, bounds_s: Sequence[float]) -> None:
        self._name, self._text, self._label, self._bounds_s = name, text, label, (*bounds_s, float("inf"))
        self._counts: dict[str, list[int]] = {}
        self._sums_s: dict[str, float] = {}

    @contextmanager
    def timed(self, value: str) -> Iterator[None]:
        """Measure how long a block takes, with this value of the label."""
        begun_s = time.perf_counter()
        try:
            yield
        finally:
            took_s = time.perf_counter() - begun_s
            counts = self._counts.setdefault(value, [0] * len(self._bounds_s))
            counts[bisect.bisect_left(self._bounds_s, took_s)] += 1
            self._sums_s[value] = self._sums_s.get(value, 0.0) + took_s

    def figure(self) -> Figure:
        """The figure as it is now."""
        return Figure(self._name, self._text, "histogram", list(self._samples()))

    def _samples(self) -> Iterator[Sample]:
        for value, counts in self._counts.items():
            labels, below = {self._label: value}, 0
            for bound_s, count in zip(self._bounds_s, counts, strict=True):
                below += count
                yield "_bucket", {**labels, "le": _number(bound_s)}, below
            yield "_count", labels, below
            yield "_sum", labels, self._sums_s[value]


def hash_number(hash_: str) -> int:
    """The first 13 hexadecimal digits of a hash: as much of it as a figure, which has 53 bits, tells exactly."""
    return int(hash_[:13], 16)


def text_of(figures: Iterable[Figure]) -> bytes:
    """Figures in Prometheus' text format."""
    return "".join(line for figure in figures for line in _lines(figure)).encode()


def _lines(figure: Figure) -> Iterator[str]:
    text = figure.text.replace("\\", r"\\").replace("\n", r"\n")
    yield f"# HELP {figure.name} {text}\n# TYPE {figure.name} {figure.kind}\n"
    for suffix, labels, value in figure.samples:
        told = ",".join(f'{name}="{_escaped(content)}"' for name, content in labels.items())
        yield (
            f"{figure.name}{suffix}{{{told}}} {_number(value)}\n"
            if told
            else f"{figure.name}{suffix} {_number(value)}\n"
        )


def _escaped(content: str) -> str:
    return content.replace("\\", r"\\").replace("\n", r"\n").replace('"', r"\"")


def _number(value: float) -> str:
    """As the text format spells it: +Inf, -Inf and NaN have forms of their own."""
    return repr(float(value)) if math.isfinite(value) else "NaN" if math.isnan(value) else f"{value:+}".title()
