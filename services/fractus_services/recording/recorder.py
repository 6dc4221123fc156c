"""Flight recorder: a bounded queue that never blocks the service, and a thread that writes segments."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from fractus_core.api.grants import GrantSpec
from fractus_runtime.files import write_file

from fractus_services.recording import messages
from fractus_services.recording.map_features import grant_features
from fractus_services.recording.messages import Record
from fractus_services.recording.segment_directory import SegmentDirectory
from fractus_services.recording.segment_writer import SegmentWriter, rebuild_index

log = logging.getLogger(__name__)

FLUSH_INTERVAL_S = 3.0
"""Maximum length of a recording that a crash or a power failure may lose."""

BEFORE_S = 10.0
AFTER_S = 10.0
"""Time recorded before the motors are armed and after they are disarmed. Recordings of a parked drone would displace flights."""

MAX_BEFORE = 2_000
"""Maximum number of messages kept for the time before the motors are armed."""

INDEX_SLICE_S = 0.01
"""Time that the thread spends at once on rebuilding indexes. It shares the interpreter with the service."""

MAX_FEATURES = 500
"""Maximum number of zones drawn. Larger maps would take processor time from the flight."""

POLL_INTERVAL_S = 0.25
"""Interval at which the thread empties the queue. A short interval would wake the processor more often."""

RETRY_S = 60.0
"""Delay before recording is tried again after a failure."""

HANG_TIMEOUT_S = 5.0
"""Duration after which a write counts as failed."""

MAX_WAITING = 5_000
"""Default size of the queue. A drone in flight produces about a hundred messages per second."""


@dataclass(frozen=True, slots=True)
class AutopilotFrame:
    """A frame received from the autopilot.

    Attributes:
        data: Bytes of the frame.
        records: Records of the contents of the frame.
        armed: True if the frame reports that the motors are armed.
    """

    data: bytes
    records: Sequence[Record] = ()
    armed: bool = False


class AutopilotDecoder(Protocol):
    """Decodes the byte stream of the autopilot link."""

    def decode(self, data: bytes, time_ns: int) -> Iterable[AutopilotFrame]:
        """Add received bytes, and return the frames that they complete.

        Args:
            data: Bytes received from the autopilot.
            time_ns: Time of arrival in Unix nanoseconds, for the records.
        """


@dataclass(frozen=True, slots=True)
class _Pending:
    """A message that is written if the drone flies now or soon."""

    at_s: float
    time_ns: int
    frame: bytes
    records: Sequence[Record]


class FlightWriter:
    """Writes segments around flights. It is used by one thread. Times are Unix nanoseconds.

    Args:
        segments: Directory of the segments.
        node: Name of the node, which is the first part of each topic.
        decoder: Decoder of the autopilot link. A service without this link has no decoder, and records all the time.
        steady: Returns seconds of a clock that is never stepped. The system clock may be set in flight.

    Attributes:
        paused: True if nothing is written for now.
    """

    def __init__(
        self,
        segments: SegmentDirectory,
        node: str,
        decoder: AutopilotDecoder | None = None,
        *,
        steady: Callable[[], float] = time.monotonic,
    ) -> None:
        self.segments = segments
        self._node = node
        self._decoder = decoder
        self._always = decoder is None
        self._steady = steady
        self._armed_s: float | None = None
        self._pending: deque[_Pending] = deque(maxlen=MAX_BEFORE)
        self._map: Record | None = None
        self._segment: SegmentWriter | None = None
        self._flush_due_s = 0.0
        self._indexing: Iterator[None] = iter(())
        self.paused = False

    def begin(self) -> None:
        """Prepare the directory. `tick` rebuilds missing indexes of earlier segments later.

        Raises:
            OSError: The directory is unusable, or the disk is full.
        """
        self.segments.prepare()
        self.segments.remove_incomplete()
        self._indexing = _rebuild_indexes([path for paths in self.segments.by_number().values() for path in paths])

    def received(self, time_ns: int, data: bytes) -> None:
        """Record bytes received from the autopilot. Without a decoder there is no autopilot link, and nothing is recorded."""
        if self._decoder is None:
            return
        for frame in self._decoder.decode(data, time_ns):
            if frame.armed:
                self._armed_s = self._steady()
            self._write(time_ns, frame.data, frame.records)

    def sent(self, time_ns: int, frame: bytes) -> None:
        """Record a frame sent to the autopilot."""
        self._write(time_ns, frame, ())

    def entry(self, time_ns: int, entry: dict[str, Any]) -> None:
        """Record an entry of the audit log."""
        self._write(time_ns, b"", tuple(messages.audit_records(entry, self._node)))

    def grants(self, time_ns: int, specs: Sequence[GrantSpec]) -> None:
        """Record the zones of the Grants in force. Each later segment starts with them."""
        features = grant_features(specs)
        if len(features) > MAX_FEATURES:
            log.warning("recording: too many zones to draw (zones=%d drawn=%d)", len(features), MAX_FEATURES)
        self._map = messages.zones(time_ns, features[:MAX_FEATURES])
        if self._segment is not None:
            self._segment.write(time_ns, b"", (self._map,))

    def picture(self, time_ns: int, jpeg: bytes, owner: str) -> None:
        """Record an image as components receive it."""
        self._write(time_ns, b"", (messages.picture(time_ns, self._node, jpeg, owner),))

    def tick(self) -> None:
        """Flush or close the segment when due. Without an open segment, continue to rebuild indexes.

        Raises:
            OSError: The disk failed or is nearly full.
        """
        # Leave the processor to a drone in flight. A service that records always may never close its segment.
        if self._segment is None or self._always:
            self._rebuild_some()
        if self._segment is None:
            return
        if not self._recording or self._segment.size_bytes >= self.segments.segment_bytes:
            self.end()
        elif time.monotonic() >= self._flush_due_s:
            self.flush()

    def flush(self) -> None:
        """Write the segment so far to the disk.

        Raises:
            OSError: The disk failed or is nearly full.
        """
        self._flush_due_s = time.monotonic() + FLUSH_INTERVAL_S
        if self._segment is not None:
            self._segment.flush()
            self.segments.check_space()

    def end(self) -> None:
        """Close the segment.

        Raises:
            OSError: The disk failed or is full. The flushed part is readable.
        """
        segment = self._take_segment()
        if segment is not None:
            segment.close()

    def close(self) -> None:
        """Close the segment, and unlock the directory.

        Raises:
            OSError: See `end`.
        """
        self._indexing = iter(())
        try:
            self.end()
        finally:
            self.segments.unlock()

    def abandon(self) -> None:
        """Close the segment without an index."""
        self._indexing = iter(())
        segment = self._take_segment()
        if segment is not None:
            segment.abandon()

    @property
    def _recording(self) -> bool:
        return self._always or (self._armed_s is not None and self._steady() - self._armed_s < AFTER_S)

    def _take_segment(self) -> SegmentWriter | None:
        segment = self._segment
        self._segment = None
        return segment

    def _rebuild_some(self) -> None:
        until_s = time.monotonic() + INDEX_SLICE_S
        while time.monotonic() < until_s and next(self._indexing, self) is not self:
            pass

    def _write(self, time_ns: int, frame: bytes, records: Sequence[Record]) -> None:
        """Write a message, or keep it for `BEFORE_S` seconds if the drone does not fly."""
        if self.paused:
            self._pending.clear()
            return
        at_s = self._steady()
        self._pending.append(_Pending(at_s, time_ns, frame, records))
        if not self._recording:
            while at_s - self._pending[0].at_s > BEFORE_S:
                self._pending.popleft()
            return
        if self._segment is None:
            self._segment = self._open_segment()
        while self._pending:
            pending = self._pending.popleft()
            self._segment.write(pending.time_ns, pending.frame, pending.records)

    def _open_segment(self) -> SegmentWriter:
        first_ns = self._pending[0].time_ns
        segment = SegmentWriter(self.segments.new_segment(first_ns), self._node)
        self._flush_due_s = time.monotonic() + FLUSH_INTERVAL_S
        if self._map is not None:
            segment.write(first_ns, b"", (self._map,))
        return segment


def _rebuild_indexes(paths: Sequence[Path]) -> Iterator[None]:
    """Rebuild missing indexes, one message per step. A file whose index cannot be written stays readable without one."""
    for path in paths:
        if path.suffix == ".mcap" and path.exists():
            try:
                yield from rebuild_index(path)
            except OSError as error:
                log.warning("recording: cannot write index (file=%s error=%s)", path, error.strerror or error)


class Recorder:
    """Records the traffic of the autopilot link, decisions, zones and images.

    The `take_*` methods may be called from any thread, return immediately and raise nothing. While the disk is full or failed,
    nothing is recorded, `problem` contains the reason, and recording is tried again every minute.

    Args:
        segments: Directory of the segments, or None to record nothing.
        node: Name of the node, which is the first part of each topic.
        decoder: See `FlightWriter`.
        max_waiting: Size of the queue. Messages beyond it are lost.
        problem_file: File that contains `problem` while recording fails. The agent reads it. None: no file is written.
        clock: Returns Unix nanoseconds.
    """

    def __init__(
        self,
        segments: SegmentDirectory | None,
        node: str,
        decoder: AutopilotDecoder | None = None,
        *,
        max_waiting: int = MAX_WAITING,
        problem_file: Path | None = None,
        clock: Callable[[], int] = time.time_ns,
    ) -> None:
        self._max_waiting = max_waiting if segments is not None else 0
        self._clock = clock
        # SimpleQueue.put is atomic, so the service never waits for a lock that the thread holds.
        self._waiting: queue.SimpleQueue[Callable[[FlightWriter], None]] = queue.SimpleQueue()
        self._lost = 0
        self._problem = ""
        self._problem_file = problem_file
        # Remove the problem file of an earlier process.
        self._set_problem("")
        self._busy_since_s: float | None = None
        self._retry_at_s = 0.0
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        if segments is not None:
            writer = FlightWriter(segments, node, decoder)
            self._thread = threading.Thread(target=self._run, args=(writer,), name="recorder", daemon=True)
            self._thread.start()

    @property
    def problem(self) -> str:
        """Reason why nothing is recorded, or an empty string if recording works or is disabled."""
        since_s = self._busy_since_s
        if since_s is not None and time.monotonic() - since_s > HANG_TIMEOUT_S:
            return f"recording stopped: the disk has not responded for {time.monotonic() - since_s:.0f} s"
        return self._problem

    def take_received(self, data: bytes) -> None:
        """Record bytes received from the autopilot."""
        time_ns = self._clock()
        self._offer(lambda writer: writer.received(time_ns, data))

    def take_sent(self, frame: bytes) -> None:
        """Record a frame sent to the autopilot."""
        time_ns = self._clock()
        self._offer(lambda writer: writer.sent(time_ns, frame))

    def take_entry(self, entry: dict[str, Any]) -> None:
        """Record an entry of the audit log."""
        time_ns = self._clock()
        self._offer(lambda writer: writer.entry(time_ns, entry))

    def take_grants(self, specs: Sequence[GrantSpec]) -> None:
        """Record the zones of the Grants that are now in force."""
        time_ns = self._clock()
        self._offer(lambda writer: writer.grants(time_ns, specs))

    def take_picture(self, owner: str, time_s: float, jpeg: bytes) -> None:
        """Record an image as components receive it, with its owner and its Unix time in seconds."""
        self._offer(lambda writer: writer.picture(int(time_s * 1e9), jpeg, owner))

    async def close(self) -> None:
        """Write the remaining messages."""
        self._closing.set()
        if self._thread is not None:
            await asyncio.to_thread(self._thread.join, HANG_TIMEOUT_S)

    def _offer(self, work: Callable[[FlightWriter], None]) -> None:
        if self._waiting.qsize() < self._max_waiting:
            self._waiting.put(work)
        else:
            self._lost += 1

    # Methods of the thread

    def _run(self, writer: FlightWriter) -> None:
        self._guard(writer, writer.begin)
        while True:
            closing = self._closing.wait(POLL_INTERVAL_S)
            self._guard(writer, lambda: self._drain(writer))
            if closing:
                self._guard(writer, writer.close)
                return

    def _guard(self, writer: FlightWriter, work: Callable[[], None]) -> None:
        """Run `work`. Any failure stops the recording, but never the flight."""
        self._busy_since_s = time.monotonic()
        try:
            work()
        except OSError as error:
            self._fail(writer, error.strerror or str(error))
        except Exception as error:
            log.exception("recording: failed")
            self._fail(writer, f"{type(error).__name__}: {error}")
        finally:
            self._busy_since_s = None

    def _fail(self, writer: FlightWriter, reason: str) -> None:
        writer.abandon()
        writer.paused = True
        self._retry_at_s = time.monotonic() + RETRY_S
        if not self._problem:
            log.error("recording: stopped, flights continue (directory=%s error=%s)", writer.segments.directory, reason)
        self._set_problem(f"recording stopped: {reason}")

    def _set_problem(self, problem: str) -> None:
        self._problem = problem
        if self._problem_file is None:
            return
        # If the disk rejects this file, it also rejects the state and the audit log. Those failures are reported
        # elsewhere.
        with contextlib.suppress(OSError):
            if problem:
                write_file(self._problem_file, problem.encode(), durable=False)
            else:
                self._problem_file.unlink(missing_ok=True)

    def _drain(self, writer: FlightWriter) -> None:
        if writer.paused and time.monotonic() >= self._retry_at_s:
            writer.begin()
            writer.paused = False
            self._set_problem("")
            log.warning("recording: resumed (directory=%s)", writer.segments.directory)
        for _ in range(self._waiting.qsize()):
            self._waiting.get_nowait()(writer)
        if self._lost:
            log.warning("recording: queue full, messages lost (lost=%d)", self._lost)
            self._lost = 0
        writer.tick()
