"""What of all that is seen gets written, and when: the flights, with a little before and after."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fractus_core.api.plans import GrantSpec
from fractus_runtime.mavlink_codec import Parser

from fractus_services.recording import messages
from fractus_services.recording.map_features import features
from fractus_services.recording.mavlink_messages import armed, records_of
from fractus_services.recording.mcap_file import completed
from fractus_services.recording.messages import Record
from fractus_services.recording.segment_directory import SegmentDirectory
from fractus_services.recording.segment_writer import SegmentWriter

log = logging.getLogger(__name__)

FLUSH_S = 3.0
"""How much a crash or a lost battery may cost."""

BEFORE_S, AFTER_S = 10.0, 10.0
"""What is recorded before the motors start and after they stop. A drone that stands for weeks must not lose its flights."""

MAX_BEFORE = 2_000
"""And not more than this, however much there is of it."""

COMPLETE_S = 0.01
"""How long the thread works at a time on files that a crash left without an index: it shares the interpreter with the service."""

MAX_FEATURES = 500
"""Zones that are drawn at most: a map of more would take the processor from the flight."""


@dataclass(frozen=True, slots=True)
class _Noted:
    """Something that is written if the drone flies, or does so soon."""

    at_s: float
    time_ns: int
    frame: bytes
    records: Sequence[Record]


class FlightWriter:
    """Writes segments; used by one thread. Times are Unix nanoseconds.

    Args:
        segments: where they go.
        node: the first part of every topic.
        always: write all the time, not only around flights: for a service without an autopilot's link.
        steady: seconds that never jump, by which a flight begins and ends: the wall clock is set, sometimes in flight.

    Attributes:
        rests: whether nothing is to be written for now.
    """

    def __init__(
        self,
        segments: SegmentDirectory,
        node: str,
        *,
        always: bool = False,
        steady: Callable[[], float] = time.monotonic,
    ) -> None:
        self.segments = segments
        self._node = node
        self._always = always
        self._parser = Parser(unknown=self._unknown)
        self._steady = steady
        self._now_ns = 0
        self._armed_s: float | None = None
        self._before: deque[_Noted] = deque(maxlen=MAX_BEFORE)
        self._map: Record | None = None
        self._tape: SegmentWriter | None = None
        self._flush_due_s = 0.0
        self._completing: Iterator[None] = iter(())
        self.rests = False

    def begin(self) -> None:
        """Prepare the directory. Files that a crash left without an index get theirs later, by and by.

        Raises:
            OSError: the disk does not let it.
        """
        self.segments.prepare()
        self.segments.tidy()
        self._completing = _completions([path for paths in self.segments.found().values() for path in paths])

    def received(self, time_ns: int, data: bytes) -> None:
        """Take bytes that came from the autopilot."""
        self._now_ns = time_ns
        for message in self._parser.feed(data):
            if armed(message):
                self._armed_s = self._steady()
            self._note(time_ns, message.frame, tuple(records_of(message, time_ns, self._node)))

    def sent(self, time_ns: int, frame: bytes) -> None:
        """Take a frame that went to the autopilot."""
        self._note(time_ns, frame, ())

    def entry(self, time_ns: int, entry: dict[str, Any]) -> None:
        """Take an entry of the audit log."""
        self._note(time_ns, b"", tuple(messages.of_audit(entry, self._node)))

    def grants(self, time_ns: int, specs: Sequence[GrantSpec]) -> None:
        """Take the grants that are in force: their zones are drawn, at the beginning of later segments, too."""
        found = features(specs)
        if len(found) > MAX_FEATURES:
            log.warning("recording: not all zones are drawn (zones=%d, drawn=%d)", len(found), MAX_FEATURES)
        self._map = messages.zones(time_ns, found[:MAX_FEATURES])
        if self._tape is not None:
            self._tape.write(time_ns, b"", (self._map,))

    def picture(self, time_ns: int, jpeg: bytes) -> None:
        """Take a picture as components get it."""
        self._note(time_ns, b"", (messages.picture(time_ns, self._node, jpeg),))

    def tick(self) -> None:
        """Flush, close or change the segment when it is time to; without one, go on with what a crash left.

        Raises:
            OSError: the disk does not let it, or is nearly full.
        """
        # A drone in flight has better to do; a service that flies nothing may never stop recording.
        if self._tape is None or self._always:
            self._complete()
        if self._tape is None:
            return
        if not self._recording or self._tape.size_bytes >= self.segments.segment_bytes:
            self.end()
        elif time.monotonic() >= self._flush_due_s:
            self.flush()

    def flush(self) -> None:
        """Bring the segment so far to the disk.

        Raises:
            OSError: the disk does not take it, or is nearly full.
        """
        self._flush_due_s = time.monotonic() + FLUSH_S
        if self._tape is not None:
            self._tape.flush()
            self.segments.check_space()

    def end(self) -> None:
        """Close the segment.

        Raises:
            OSError: the disk does not take the rest; what was flushed can be read.
        """
        tape, self._tape = self._tape, None
        if tape is not None:
            tape.close()

    def close(self) -> None:
        """Close the segment, and leave the directory to others.

        Raises:
            OSError: see `end`.
        """
        self._completing = iter(())
        try:
            self.end()
        finally:
            self.segments.release()

    def abandon(self) -> None:
        """Leave the segment as it is."""
        self._completing = iter(())
        tape, self._tape = self._tape, None
        if tape is not None:
            tape.abandon()

    @property
    def _recording(self) -> bool:
        return self._always or (self._armed_s is not None and self._steady() - self._armed_s < AFTER_S)

    def _complete(self) -> None:
        until_s = time.monotonic() + COMPLETE_S
        while time.monotonic() < until_s and next(self._completing, self) is not self:
            pass

    def _unknown(self, frame: bytes) -> None:
        """Frames that are not of our dialect are for ground stations all the same."""
        self._note(self._now_ns, frame, ())

    def _note(self, time_ns: int, frame: bytes, records: Sequence[Record]) -> None:
        if self.rests:
            self._before.clear()
            return
        at_s = self._steady()
        self._before.append(_Noted(at_s, time_ns, frame, records))
        if not self._recording:
            while at_s - self._before[0].at_s > BEFORE_S:
                self._before.popleft()
            return
        if self._tape is None:
            self._tape = self._new_tape()
        while self._before:
            noted = self._before.popleft()
            self._tape.write(noted.time_ns, noted.frame, noted.records)

    def _new_tape(self) -> SegmentWriter:
        first_ns = self._before[0].time_ns
        tape = SegmentWriter(self.segments.begin(first_ns), self._node)
        self._flush_due_s = time.monotonic() + FLUSH_S
        if self._map is not None:
            tape.write(first_ns, b"", (self._map,))
        return tape


def _completions(paths: Sequence[Path]) -> Iterator[None]:
    """Give those of the files that a crash left without an index theirs; what fails stays as it is, and can be read."""
    for path in paths:
        if path.suffix == ".mcap" and path.exists():
            try:
                yield from completed(path)
            except OSError as error:
                log.warning("recording: has no index (file=%s, reason=%s)", path, error.strerror or error)
