"""Records what a service sees, in a thread of its own: it takes what fits into its queue, and the service never waits."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import queue
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fractus_core.api.plans import GrantSpec
from fractus_runtime.files import write_file

from fractus_services.recording.segment_directory import SegmentDirectory

if TYPE_CHECKING:
    from fractus_services.recording.flight_writer import FlightWriter

log = logging.getLogger(__name__)

DRAIN_S = 0.25
"""How often the thread looks what there is: seldom, so that it wakes the processor as seldom."""

RETRY_S = 60.0
"""How long a recording that failed rests before it is tried again."""

HANG_TIMEOUT_S = 5.0
"""A write that takes longer counts as failed until it returns."""

MAX_WAITING = 5_000
"""What waits for the thread at most; the rest is lost. A drone in flight has about a hundred a second."""


class Recorder:
    """Records flights: what passes the autopilot's link, decisions, zones and pictures.

    Every `take_*` method may be called from any thread, returns at once and raises nothing. While the disk is full or fails,
    nothing is recorded; `problem` says why, and it is tried again every minute.

    Args:
        segments: where files go; None: nothing is recorded.
        node: the first part of every topic.
        always: see `FlightWriter`.
        max_waiting: what waits for the thread at most.
        told: file that holds `problem` while there is one, for the node's agent; None: it is not written.
        clock: Unix nanoseconds.
    """

    def __init__(
        self,
        segments: SegmentDirectory | None,
        node: str,
        *,
        always: bool = False,
        max_waiting: int = MAX_WAITING,
        told: Path | None = None,
        clock: Callable[[], int] = time.time_ns,
    ) -> None:
        self._max_waiting = max_waiting if segments is not None else 0
        self._clock = clock
        # Its put is one step in C: there is no lock that the thread could hold while the service waits.
        self._waiting: queue.SimpleQueue[Callable[[FlightWriter], None]] = queue.SimpleQueue()
        self._lost = 0
        self._problem = ""
        self._told = told
        # What an earlier process could not record is no problem of this one.
        self._tell("")
        self._busy_since_s: float | None = None
        self._rests_until_s = 0.0
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        if segments is not None:
            # Imported here: a service that records nothing does without the libraries of file formats.
            from fractus_services.recording.flight_writer import FlightWriter  # noqa: PLC0415

            writer = FlightWriter(segments, node, always=always)
            self._thread = threading.Thread(target=self._run, args=(writer,), name="recorder", daemon=True)
            self._thread.start()

    @property
    def problem(self) -> str:
        """Why nothing is recorded that should be; empty while it is."""
        since_s = self._busy_since_s
        if since_s is not None and time.monotonic() - since_s > HANG_TIMEOUT_S:
            return f"recording stopped: the disk has not answered for {time.monotonic() - since_s:.0f} s"
        return self._problem

    def take_received(self, data: bytes) -> None:
        """Take bytes that came from the autopilot."""
        time_ns = self._clock()
        self._offer(lambda writer: writer.received(time_ns, data))

    def take_sent(self, frame: bytes) -> None:
        """Take a frame that went to the autopilot."""
        time_ns = self._clock()
        self._offer(lambda writer: writer.sent(time_ns, frame))

    def take_entry(self, entry: dict[str, Any]) -> None:
        """Take an entry of the audit log."""
        time_ns = self._clock()
        self._offer(lambda writer: writer.entry(time_ns, entry))

    def take_grants(self, specs: Sequence[GrantSpec]) -> None:
        """Take the grants that are in force by now."""
        time_ns = self._clock()
        self._offer(lambda writer: writer.grants(time_ns, specs))

    def take_picture(self, time_s: float, jpeg: bytes) -> None:
        """Take a picture as components get it, and when it was taken (Unix seconds)."""
        self._offer(lambda writer: writer.picture(int(time_s * 1e9), jpeg))

    async def close(self) -> None:
        """Write what is left."""
        self._closing.set()
        if self._thread is not None:
            await asyncio.to_thread(self._thread.join, HANG_TIMEOUT_S)

    def _offer(self, work: Callable[[FlightWriter], None]) -> None:
        if self._waiting.qsize() < self._max_waiting:
            self._waiting.put(work)
        else:
            self._lost += 1

    # The thread

    def _run(self, writer: FlightWriter) -> None:
        self._guarded(writer, writer.begin)
        while True:
            closing = self._closing.wait(DRAIN_S)
            self._guarded(writer, lambda: self._drain(writer))
            if closing:
                self._guarded(writer, writer.close)
                return

    def _guarded(self, writer: FlightWriter, work: Callable[[], None]) -> None:
        self._busy_since_s = time.monotonic()
        try:
            work()
        except OSError as error:
            self._fail(writer, error.strerror or str(error))
        except Exception as error:  # whatever it is, the flight goes on without a recording
            log.exception("recording: failed")
            self._fail(writer, f"{type(error).__name__}: {error}")
        finally:
            self._busy_since_s = None

    def _fail(self, writer: FlightWriter, why: str) -> None:
        writer.abandon()
        writer.rests = True
        self._rests_until_s = time.monotonic() + RETRY_S
        if not self._problem:
            log.error("recording: stopped, flights go on (directory=%s): %s", writer.segments.directory, why)
        self._tell(f"recording stopped: {why}")

    def _tell(self, problem: str) -> None:
        self._problem = problem
        if self._told is None:
            return
        # A disk that takes no file takes no state and no audit log either: that is told elsewhere.
        with contextlib.suppress(OSError):
            if problem:
                write_file(self._told, problem.encode(), durable=False)
            else:
                self._told.unlink(missing_ok=True)

    def _drain(self, writer: FlightWriter) -> None:
        if writer.rests and time.monotonic() >= self._rests_until_s:
            writer.begin()
            writer.rests = False
            self._tell("")
            log.warning("recording: goes on (directory=%s)", writer.segments.directory)
        for _ in range(self._waiting.qsize()):
            self._waiting.get_nowait()(writer)
        if self._lost:
            log.warning("recording: too slow, not all is in it (lost=%d)", self._lost)
            self._lost = 0
        writer.tick()
