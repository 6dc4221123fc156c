"""Parts that all benchmarks share: options, timing, statistics of processes, and a report of claims.

`claims.yaml` contains each claim with its unit and its limit. A benchmark measures a value and, in the same run, the value
of a comparator. It passes both to `Report.add`, which prints one line and checks the limit.
"""

from __future__ import annotations

import argparse
import json
import math
import operator
import os
import re
import signal
import statistics
import subprocess
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).parents[1]

_CLAIMS = Path(__file__).with_name("claims.yaml")
_COMPARED = re.compile(r"(?:(measured|measured/reference|reference/measured) )?(<=|>=|<|>|=) (reference|[\d.]+)")
_NEAR = re.compile(r"within ([\d.]+) % of reference(?:, or ([\d.]+))?")
_OPERATORS: dict[str, Callable[[float, float], bool]] = {
    "<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge, "=": operator.eq,
}  # fmt: skip
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


def parser(description: str | None, *, quick: str) -> argparse.ArgumentParser:
    """Return a parser with the options that every benchmark has.

    Args:
        description: Docstring of the benchmark.
        quick: Effect of `--quick`.
    """
    made = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--quick", action="store_true", help=quick)
    made.add_argument("--json", type=Path, help="write the results to this JSON file")
    return made


class Report:
    """Results of one benchmark run, compared with the claims. Each result is printed when it is added.

    Args:
        section: Section of `claims.yaml`.
        options: Parsed options of `parser`.
    """

    def __init__(self, section: str, options: argparse.Namespace) -> None:
        self._claims: dict[str, dict[str, str]] = yaml.safe_load(_CLAIMS.read_text())[section]
        self._file: Path | None = options.json
        self._results: list[dict[str, Any]] = []

    def add(
        self, claim: str, measured: float, reference: float | None = None, *, valid: bool = True, **details: object
    ) -> None:
        """Check a measured value against the limit of its claim, and print the result.

        Args:
            claim: Key of the claim in the section.
            measured: Measured value.
            reference: Value of the comparator, if there is one.
            valid: False if the measurement is invalid. The claim then fails for every value.
            **details: Values for the placeholders in the name of the claim. The JSON file contains all of them.
        """
        entry = self._claims[claim]
        limit = entry.get("limit")
        quantity = "reference/measured"
        holds = valid
        if limit is not None:
            quantity, within = _check(limit, measured, reference)
            holds = valid and within
        result = {
            "name": entry["name"].format(**details), "measured": measured, "reference": reference, "unit": entry["unit"],
            "ratio": _ratio(quantity, measured, reference), "target": limit, "holds": holds,
        }  # fmt: skip
        self._results.append(result | details)
        verdict = "FAILS"
        if holds:
            verdict = "holds" if limit is not None else ""
        compared = "" if reference is None else f"{entry['against']} {reference:.4g}"
        print(
            f"{verdict:6}{result['name']:62} {measured:10.4g} {entry['unit']:12} {limit or '':26} {compared}",
            flush=True,
        )

    def finish(self) -> int:
        """Write the JSON file, and return the exit status: 0 if every claim holds."""
        self.save()
        return 0 if all(result["holds"] for result in self._results) else 1

    def save(self) -> None:
        """Write the results so far to the JSON file if the option `--json` is set."""
        if self._file is not None:
            self._file.parent.mkdir(parents=True, exist_ok=True)
            self._file.write_text(json.dumps({"claims": self._results}, indent=1) + "\n")


def _check(limit: str, measured: float, reference: float | None) -> tuple[str, bool]:
    """Return the quantity that a limit applies to, and True if the quantity is within the limit."""
    compared = _COMPARED.fullmatch(limit)
    if compared is not None:
        quantity = compared[1] or "measured"
        value = measured if quantity == "measured" else _ratio(quantity, measured, reference)
        bound = reference if compared[3] == "reference" else float(compared[3])
        return quantity, value is not None and bound is not None and _OPERATORS[compared[2]](value, bound)
    near = _NEAR.fullmatch(limit)
    if near is None:
        raise ValueError(f"{_CLAIMS}: limit {limit!r} has an unknown format")
    if reference is None:
        return "measured/reference", False
    return "measured/reference", abs(measured - reference) <= max(
        abs(reference) * float(near[1]) / 100, float(near[2] or 0)
    )


def _ratio(quantity: str, measured: float, reference: float | None) -> float | None:
    if reference is None:
        return None
    above, below = (measured, reference) if quantity == "measured/reference" else (reference, measured)
    return above / below if below else None


def print_table(headers: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Print rows below their headers. Numbers have four significant digits."""
    cells = [[f"{cell:.4g}" if isinstance(cell, float) else str(cell) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(headers, *cells, strict=True)]
    for row in (headers, *cells):
        print("  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)), flush=True)


class Progress:
    """One line with the progress of a long run and the estimated remaining time.

    Args:
        total: Number of cases.
    """

    def __init__(self, total: int) -> None:
        self._total = total
        self._started_s = time.monotonic()

    def show(self, done: int, text: str) -> None:
        """Update the line."""
        left_s = (time.monotonic() - self._started_s) / max(done, 1) * max(self._total - done, 0)
        end = "\n" if done >= self._total else " "
        print(f"\r{done:,} of {self._total:,}: {text}; {left_s / 60:.0f} min left", end=end, flush=True)


def durations_us(
    work: Callable[[], object], runs: int, *, warm_up: int = 0, clock: Callable[[], int] = time.perf_counter_ns
) -> list[float]:
    """Return the sorted durations of several calls, in microseconds.

    Args:
        work: Function to time.
        runs: Number of timed calls.
        warm_up: Number of untimed calls before the timed calls.
        clock: Clock in nanoseconds, for example of processor time.
    """
    for _ in range(warm_up):
        work()
    taken = []
    for _ in range(runs):
        begun_ns = clock()
        work()
        taken.append((clock() - begun_ns) / 1e3)
    return sorted(taken)


def median_ms(work: Callable[[], object], runs: int) -> float:
    """Call a function several times, and return the median processor time of a call in milliseconds."""
    return statistics.median(durations_us(work, runs, clock=time.process_time_ns)) / 1e3


def quantile(values: Iterable[float], share: float) -> float:
    """Return the quantile of values, for example the 99th percentile for a share of 0.99.

    It is always one of the values.
    """
    ordered = sorted(values)
    return ordered[max(math.ceil(share * len(ordered)) - 1, 0)]


def cpu_s(pid: int | None = None) -> float:
    """Return the processor time of a process, by default of the current process, in seconds."""
    fields = Path(f"/proc/{pid or 'self'}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS_PER_S


def cpu_percent(pid: int, seconds: float) -> float:
    """Wait for some seconds, and return the share of one core that a process used, in percent."""
    before_s = cpu_s(pid)
    begun_s = time.monotonic()
    time.sleep(seconds)
    return 100 * (cpu_s(pid) - before_s) / (time.monotonic() - begun_s)


def memory_mb(pid: int | None = None) -> dict[str, float]:
    """Return the memory of a process, by default of the current process, in megabytes.

    `resident` includes all shared pages. `proportional` includes a share of each shared page, divided by the number of
    processes that use the page. `private` excludes shared pages. `peak` is the largest resident size so far.
    """
    texts = [Path(f"/proc/{pid or 'self'}/{name}").read_text() for name in ("smaps_rollup", "status")]
    sizes = {
        name: int(kb) * 1024 / 1e6 for name, kb in re.findall(r"^(\w+):\s+(\d+) kB", "\n".join(texts), re.MULTILINE)
    }
    return {
        "resident": sizes["Rss"], "proportional": sizes["Pss"], "peak": sizes["VmHWM"],
        "private": sizes["Private_Clean"] + sizes["Private_Dirty"],
    }  # fmt: skip


class Processes:
    """Processes that are stopped at the end of a `with` block. Each process has a log file.

    Args:
        directory: Working directory of the processes, and directory of their logs.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._running: list[subprocess.Popen[bytes]] = []

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, *_: object) -> None:
        for process in reversed(self._running):
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait(10)
        self._running.clear()

    def start(self, name: str, *command: object, **environment: str) -> int:
        """Start a process with additional environment variables, and return its process id."""
        with (self._directory / f"{name}.log").open("ab") as log:
            process = subprocess.Popen(
                [str(word) for word in command], stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                cwd=self._directory, env=os.environ | environment,
            )  # fmt: skip
        self._running.append(process)
        return process.pid

    def log(self, name: str) -> str:
        """Return the output of a process so far."""
        return (self._directory / f"{name}.log").read_text(errors="replace")

    def wait_for_log(self, name: str, text: str, timeout_s: float = 60.0) -> None:
        """Wait until a text occurs in the output of a process.

        Raises:
            TimeoutError: The text did not occur in time.
        """

        def logged() -> bool:
            self.check()
            return text in self.log(name)

        wait_until(logged, f"{text!r} in the log of {name}", timeout_s=timeout_s, pause_s=0.2)

    def check(self) -> None:
        """Check that all processes are running.

        Raises:
            SystemExit: A process has ended.
        """
        for process in self._running:
            if process.poll() is not None:
                raise SystemExit(f"bench: {process.args} ended with {process.returncode}, see {self._directory}")


def wait_until(condition: Callable[[], bool], name: str, *, timeout_s: float, pause_s: float = 0.05) -> None:
    """Poll a condition until it is true.

    Args:
        condition: Function to poll.
        name: Description of the condition for the error.
        timeout_s: Maximum duration in seconds.
        pause_s: Pause between two calls in seconds.

    Raises:
        TimeoutError: The condition did not become true in time.
    """
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline_s:
            raise TimeoutError(f"timed out after {timeout_s:.0f} s of waiting for {name}")
        time.sleep(pause_s)
