"""Whose logs `fractus logs` shows: the containers of pods, and what a line of a log tells of its time."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from typing import Any

COMPONENT = "fractus.dev/component"
_PART = "app.kubernetes.io/component"
_DURATION = re.compile(r"(?:(\d+)d)?(?:(\d+)h)?(?:(\d+)m)?(?:(\d+)s)?")
_TIME = re.compile(r"(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d)(?:\.(\d{1,9}))?(Z|[+-]\d\d:\d\d)")


@dataclass(frozen=True, slots=True)
class Source:
    """A container of a pod.

    Attributes:
        namespace: of the pod.
        pod: its name.
        uid: the pod's.
        container: its name.
        part: the component, or fractus-PART for a part of Fractus.
        node: where it is; empty where the pod is not bound yet.
        system: whether it is a part of Fractus.
        run: ID of the container that runs, or ran last; empty where none has started.
        previous: ID of the one before it, which ended; empty where there is none.
        running: whether its log may grow.
        waits_for: why none has started.
    """

    namespace: str
    pod: str
    uid: str
    container: str
    part: str
    node: str = ""
    system: bool = False
    run: str = ""
    previous: str = ""
    running: bool = False
    waits_for: str = ""

    @property
    def key(self) -> tuple[str, str]:
        """What stays the same while the container restarts."""
        return self.uid, self.container

    @property
    def label(self) -> str:
        """How its lines begin."""
        return f"{self.part}@{self.node}" if self.node else self.part


@dataclass(frozen=True, slots=True, order=True)
class Line:
    """A line of a log.

    Attributes:
        time_ns: when it was written, by its node's clock, in ns since 1970; that of the line before it where it has none.
        time: the same as the node wrote it; empty where it has none.
        text: without the time.
        source: who wrote it.
    """

    time_ns: int
    time: str = field(compare=False)
    text: str = field(compare=False)
    source: Source = field(compare=False)


def sources(pod: Mapping[str, Any]) -> tuple[Source, ...]:
    """The containers of a pod, those that prepare it first."""
    metadata, spec, status = pod["metadata"], pod.get("spec") or {}, pod.get("status") or {}
    labels = metadata.get("labels") or {}
    system = COMPONENT not in labels
    part = f"fractus-{labels.get(_PART, '')}" if system else labels[COMPONENT]
    told = (*(status.get("initContainerStatuses") or ()), *(status.get("containerStatuses") or ()))
    states = {state["name"]: state for state in told}
    blank = Source(metadata["namespace"], metadata["name"], metadata["uid"], "", part, spec.get("nodeName", ""), system)
    pending = _unscheduled(status) or status.get("message") or status.get("phase", "Pending")
    containers = (*(spec.get("initContainers") or ()), *(spec.get("containers") or ()))
    return tuple(_source(blank, container["name"], states.get(container["name"]), pending) for container in containers)


def _source(blank: Source, name: str, told: Mapping[str, Any] | None, pending: str) -> Source:
    state, last = (told or {}).get("state") or {}, ((told or {}).get("lastState") or {}).get("terminated") or {}
    ended = last.get("containerID", "")
    running, terminated = "running" in state, state.get("terminated")
    # As the kubelet answers: where the next container did not start, the log is that of the last.
    run = (told or {}).get("containerID", "") if running else (terminated or {}).get("containerID") or ended
    waiting = state.get("waiting") or {}
    return replace(
        blank,
        container=name,
        run=run,
        previous=ended if ended != run else "",
        running=running,
        waits_for="" if run else ": ".join(filter(None, (waiting.get("reason"), waiting.get("message")))) or pending,
    )


def _unscheduled(status: Mapping[str, Any]) -> str:
    for condition in status.get("conditions") or ():
        if condition["type"] == "PodScheduled" and condition["status"] == "False":
            return str(condition.get("message") or condition.get("reason") or "")
    return ""


def read_line(raw: bytes, source: Source, before_ns: int) -> Line:
    """A line as a kubelet gives it with timestamps; before_ns is the time of the line before it."""
    line = raw.decode(errors="replace")
    time, _, text = line.partition(" ")
    moment_ns = time_ns(time)
    return Line(before_ns, "", line, source) if moment_ns is None else Line(moment_ns, time, text, source)


def time_ns(text: str) -> int | None:
    """A time of RFC 3339 in ns since 1970, which is finer than a datetime; None where it is none."""
    found = _TIME.fullmatch(text)
    if found is None:
        return None
    moment, fraction, zone = found.groups()
    try:
        seconds = int(datetime.fromisoformat(moment + zone).timestamp())
    except ValueError:
        return None
    return seconds * 1_000_000_000 + int((fraction or "").ljust(9, "0"))


def duration(text: str) -> timedelta | None:
    """A length of time as kubectl spells it, such as 90s, 10m or 1h30m; None where it is none or nothing."""
    found = _DURATION.fullmatch(text)
    if found is None:
        return None
    days, hours, minutes, seconds = (int(part or 0) for part in found.groups())
    try:
        return timedelta(days=days, hours=hours, minutes=minutes, seconds=seconds) or None
    except OverflowError:
        return None


def by_node(failed: Mapping[Source, str]) -> Iterator[tuple[str, tuple[str, ...], str]]:
    """What could not be read, by node: its name, the parts on it, and why the first could not."""
    nodes: dict[str, dict[str, str]] = {}
    for source, why in failed.items():
        nodes.setdefault(source.node, {}).setdefault(source.part, why)
    for node, parts in nodes.items():
        yield node, tuple(parts), next(iter(parts.values()))
