"""What of all that is seen gets written, and when: the flights, with a little before and after."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from fractus_core.api.plans import GrantSpec
from fractus_mavlink import Parser

from fractus_services.recording import messages
from fractus_services.recording.mcap_file import complete
from fractus_services.recording.messages import Record
from fractus_services.recording.places import features
from fractus_services.recording.segments import Segments
from fractus_services.recording.tape import Tape
from fractus_services.recording.vehicle_messages import armed, records_of

log = logging.getLogger(__name__)

FLUSH_S = 3.0
"""How much a crash or a lost battery may cost."""

BEFORE_S, AFTER_S = 10.0, 10.0
"""What is recorded before the motors start and after they stop. A drone that stands for weeks must not lose its flights."""

MAX_BEFORE = 2_000
"""And not more than this, for a clock that is set back lets nothing grow old."""

MAX_FEATURES = 500
"""Zones that are drawn at most: a map of more would take the processor from the flight."""


@dataclass(frozen=True, slots=True)
class _Noted:
    """Something that is written if the drone flies, or does so soon."""

    time_ns: int
    frame: bytes
    records: Sequence[Record]


class FlightWriter:
    """Writes segments; used by one thread. Times are Unix nanoseconds.

    Args:
        segments: where they go.
        node: the first part of every topic.
        always: write all the time, not only around flights: for a service without an autopilot's link.

    Attributes:
        rests: whether nothing is to be written for now.
    """

    def __init__(self, segments: Segments, node: str, *, always: bool = False) -> None:
        self.segments = segments
        self._node = node
        self._always = always
        self._parser = Parser(unknown=self._unknown)
        self._now_ns = 0
        self._armed_ns: int | None = None
        self._before: deque[_Noted] = deque(maxlen=MAX_BEFORE)
        self._map: Record | None = None
        self._tape: Tape | None = None
        self._flush_due_s = 0.0
        self.rests = False

    def begin(self) -> None:
        """Prepare the directory, and give files that a crash left without an index theirs.

        Raises:
            OSError: the disk does not let it.
        """
        self.segments.prepare()
        for path in (path for paths in self.segments.found().values() for path in paths):
            if path.suffix == ".mcap":
                complete(path)

    def received(self, time_ns: int, data: bytes) -> None:
        """Take bytes that came from the autopilot."""
        self._now_ns = time_ns
        for message in self._parser.feed(data):
            if armed(message):
                self._armed_ns = time_ns
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
        """Flush, close or change the segment when it is time to.

        Raises:
            OSError: the disk does not let it, or is nearly full.
        """
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

    def abandon(self) -> None:
        """Leave the segment as it is."""
        tape, self._tape = self._tape, None
        if tape is not None:
            tape.abandon()

    @property
    def _recording(self) -> bool:
        return self._always or (self._armed_ns is not None and self._now_ns - self._armed_ns < AFTER_S * 1e9)

    def _unknown(self, frame: bytes) -> None:
        """Frames that are not of our dialect are for ground stations all the same."""
        self._note(self._now_ns, frame, ())

    def _note(self, time_ns: int, frame: bytes, records: Sequence[Record]) -> None:
        if self.rests:
            self._before.clear()
            return
        self._before.append(_Noted(time_ns, frame, records))
        if not self._recording:
            while time_ns - self._before[0].time_ns > BEFORE_S * 1e9:
                self._before.popleft()
            return
        if self._tape is None:
            self._tape = self._new_tape()
        while self._before:
            noted = self._before.popleft()
            self._tape.write(noted.time_ns, noted.frame, noted.records)

    def _new_tape(self) -> Tape:
        first_ns = self._before[0].time_ns
        tape = Tape(self.segments.begin(first_ns), self._node)
        self._flush_due_s = time.monotonic() + FLUSH_S
        if self._map is not None:
            tape.write(first_ns, b"", (self._map,))
        return tape
