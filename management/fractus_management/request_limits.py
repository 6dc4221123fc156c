"""Limits of requests and streams (events and pictures) for each token, and of pages of records for each drone."""

from __future__ import annotations

import math
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus

from fractus_management.problem_details import Reason, Refused, refused
from fractus_management.settings import Settings

MAX_TOKENS = 10_000
"""Number of tokens whose requests are counted. The token without requests for the longest time is dropped first."""


class RequestLimits:
    """Counts the requests and the open streams of each token, and the pages that are read from each drone.

    Args:
        settings: The limits.
        monotonic: Monotonic clock in seconds.
    """

    def __init__(self, settings: Settings, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._settings = settings
        self._monotonic = monotonic
        self._free_at: OrderedDict[bytes, float] = OrderedDict()
        """Time at which each token may send a full burst again."""
        self._streams: Counter[bytes] = Counter()
        self._pages: Counter[str] = Counter()

    @property
    def streams(self) -> int:
        """Number of open event streams and transfers of pictures."""
        return self._streams.total()

    def admit(self, token_hash: bytes) -> None:
        """Count a request (generic cell rate algorithm).

        Raises:
            Refused: The token has sent too many requests.
        """
        now_s = self._monotonic()
        interval_s = 1 / self._settings.requests_per_s
        free_at_s = max(self._free_at.pop(token_hash, now_s), now_s) + interval_s
        excess_s = free_at_s - now_s - self._settings.burst * interval_s
        self._free_at[token_hash] = free_at_s if excess_s <= 0 else free_at_s - interval_s
        if len(self._free_at) > MAX_TOKENS:
            self._free_at.popitem(last=False)
        if excess_s > 0:
            message = f"more than {self._settings.requests_per_s:g} requests per second; wait for {excess_s:.1f} s"
            reason = Reason(reason="TooManyRequests", message=message)
            raise Refused(HTTPStatus.TOO_MANY_REQUESTS, reason, headers={"Retry-After": str(math.ceil(excess_s))})

    @contextmanager
    def stream(self, token_hash: bytes) -> Iterator[None]:
        """Count an event stream or the transfer of a picture while it is open.

        Raises:
            Refused: Too many streams are open.
        """
        if self._streams[token_hash] >= self._settings.max_streams_of_token:
            message = f"{self._settings.max_streams_of_token} streams of this token are open; close one"
            raise refused(HTTPStatus.TOO_MANY_REQUESTS, "TooManyStreams", message)
        if self.streams >= self._settings.max_streams:
            message = f"{self._settings.max_streams} streams are open, which is the limit; try again later"
            raise refused(HTTPStatus.SERVICE_UNAVAILABLE, "TooManyStreams", message)
        self._streams[token_hash] += 1
        try:
            yield
        finally:
            self._streams[token_hash] -= 1
            if not self._streams[token_hash]:
                del self._streams[token_hash]

    @contextmanager
    def page_of_drone(self, drone: str) -> Iterator[None]:
        """Count a page of records while it is read. A compromised drone could send many large pages slowly.

        Raises:
            Refused: Too many pages are being read from the drone.
        """
        if self._pages[drone] >= self._settings.max_pages_of_drone:
            message = f"{drone} is reading records for other requests; try again"
            raise refused(HTTPStatus.SERVICE_UNAVAILABLE, "NodeBusy", message)
        self._pages[drone] += 1
        try:
            yield
        finally:
            self._pages[drone] -= 1
            if not self._pages[drone]:
                del self._pages[drone]
