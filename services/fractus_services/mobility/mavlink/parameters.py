"""The vehicle's parameters: read and written reliably, with a distinction between a lost answer and an absent parameter."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Iterable
from typing import Protocol

from fractus_runtime.mavlink_codec import Message, message
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.errors import AutopilotError

PARAMETER_TIMEOUT_S = 0.7
PARAMETER_ATTEMPTS = 8
ATTEMPTS_BEFORE_LIST = 4
"""Number of unanswered requests for a name after which the complete list of parameters is requested.

The list has about 1,400 parameters, and its transfer takes half a minute at 57,600 baud.
"""

WINDOW = 12
"""Maximum number of concurrent requests. ArduPilot queues 20 requests and drops further requests."""

LIST_QUIET_S = 2.0
"""Time without a further entry after which the autopilot has stopped sending its list."""

LIST_TIMEOUT_S = 180.0
"""Longest time for the transfer of the list, including repeated requests."""

FEW_MISSING = 0.05
"""Share of the parameter list that may be missing.

If more entries are missing, the complete list is requested again. Otherwise only the missing entries are requested.
"""

Spellings = tuple[str, ...]
"""Names of one parameter in older and newer releases. A vehicle has the parameter under one of them."""


class ParameterLost(AutopilotError):
    """The vehicle does not answer, so the value or the existence of a parameter is unknown."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason, link=True)


class Recipient(Protocol):
    """Link interface that `Parameters` needs."""

    def send(self, outgoing: Message) -> None:
        """Send a message."""

    def address(self, *, silent: bool = ...) -> dict[str, int]:
        """Return the target fields of messages to the vehicle."""


class Parameters:
    """Reads and writes parameters, and reports changes by other stations.

    A parameter is absent only if the autopilot reports that it does not exist (PARAM_ERROR, from ArduCopter 4.7 on), or if the complete
    list is known and does not contain it. ArduPilot omits parameters of disabled features from its list, so a parameter is requested by
    name first, and again afterwards.

    Args:
        link: Link to the vehicle.
        on_change: Callback invoked with the name of a parameter whose value changed, unless this service wrote it.

    Attributes:
        values: Latest reported values by name.
        leg_speed: The owner's speed of legs while the return flight is limited; legs are flown with this speed.
    """

    def __init__(self, link: Recipient, on_change: Callable[[str], None] = lambda _name: None) -> None:
        self._link = link
        self._on_change = on_change
        self._locks: dict[str, asyncio.Lock] = {}
        self._listing = asyncio.Lock()
        self._written: dict[str, float] = {}
        self.leg_speed: dict[str, float] = {}
        self.forget()

    def forget(self) -> None:
        """Delete all received values.

        Call this after a connection loss, because the next vehicle may be another one or run another firmware release.
        """
        self.values: dict[str, float] = {}
        self._value_received = asyncio.Event()
        self._number = 0
        self._received: dict[str, int] = {}
        self._list: dict[int, str] = {}
        self._size: int | None = None
        self._absent: set[str] = set()
        self._errors: dict[str, int] = {}

    def take(self, message: Message) -> None:
        """Process a PARAM_VALUE: an answer, or a report that another station changed a parameter."""
        name = message.text("param_id")
        value = message.real("param_value")
        index = message.integer("param_index")
        size = message.integer("param_count")
        self._number += 1
        before = self.values.get(name)
        self.values[name] = value
        self._received[name] = self._number
        self._absent.discard(name)
        # Answers to requests by name have index 65535. Enabling a feature changes the length and the indices of the
        # list.
        if index < size:
            if size != self._size:
                self._size = size
                self._list = {}
            self._list[index] = name
        self._value_received.set()
        self._value_received = asyncio.Event()
        if before is not None and not same(before, value) and not same(self._written.get(name, math.nan), value):
            self._on_change(name)

    def take_error(self, message: Message) -> None:
        """Process a PARAM_ERROR for this station: a request for a parameter was refused."""
        name = message.text("param_id")
        self._number += 1
        self._errors[name] = self._number
        if message.integer("error") == mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST:
            self._absent.add(name)
        self._value_received.set()
        self._value_received = asyncio.Event()

    async def read_all(self) -> dict[str, float]:
        """Return the complete list of parameters, or the known part of the list if the vehicle does not send all of it."""
        if not self._complete:
            await self._fetch_list()
        return {name: self.values[name] for name in self._list.values()} or dict(self.values)

    def request(self, name: str) -> None:
        """Request one parameter without waiting for the answer."""
        self._request(name.encode(), -1)

    async def read(self, parameters: Iterable[Spellings]) -> dict[str, float]:
        """Return the parameters that the vehicle has, each under the name that the vehicle uses.

        Raises:
            ParameterLost: The value or the existence of a parameter is unknown.
            AutopilotError: The vehicle is not connected.
        """
        begun = self._number
        requested = tuple(parameters)
        expected = [names for names in requested if not self._absent.issuperset(names)]
        # An absent parameter may exist by now. Request it, but do not wait for it.
        for name in self._absent.intersection(name for names in requested for name in names):
            self._request(name.encode(), -1)

        def fresh(names: Spellings) -> bool:
            received = any(self._received.get(name, 0) > begun for name in names)
            # Every other error proves that the parameter exists.
            return received or all(self._errors.get(name, 0) > begun and name in self._absent for name in names)

        unanswered = await self._request_by_name(expected, fresh, ATTEMPTS_BEFORE_LIST)
        unknown = [" or ".join(names) for names in unanswered if not self._known(names)]
        if unknown and not await self._fetch_list():
            raise ParameterLost(
                f"{', '.join(unknown)} cannot be read: the autopilot neither answers the request nor sends its complete parameter list "
                f"({len(self._list)} of {self._size or '?'} parameters received)"
            )
        unanswered = await self._request_by_name(unanswered, fresh, PARAMETER_ATTEMPTS - ATTEMPTS_BEFORE_LIST)
        if lost := [self._spelt(names) for names in unanswered if self._known(names)]:
            raise ParameterLost(f"{', '.join(lost)} cannot be read: the autopilot does not answer")
        self._absent.update(name for names in unanswered for name in names)
        present = (next((name for name in names if self._received.get(name, 0) > begun), None) for names in expected)
        return {name: self.values[name] for name in present if name is not None}

    async def write(self, name: str, value: float) -> float:
        """Set a parameter that the vehicle has, and return the value that it reports, which differs if the vehicle refuses.

        Raises:
            ParameterLost: The vehicle does not answer.
            AutopilotError: The vehicle is not connected, or does not have the parameter any more.
        """
        async with self._locks.setdefault(name, asyncio.Lock()):
            self._written[name] = value
            begun = self._number
            last_number = begun
            different_values = 0
            refused = False
            for _ in range(PARAMETER_ATTEMPTS):
                self._link.send(
                    message(
                        "PARAM_SET",
                        param_id=name.encode(),
                        param_value=value,
                        param_type=mavlink.MAV_PARAM_TYPE_REAL32,
                        **self._link.address(silent=True),
                    )
                )
                while different_values < 2 and await self._answered(
                    lambda: max(self._received.get(name, 0), self._errors.get(name, 0)) > last_number  # noqa: B023
                ):
                    refused = self._errors.get(name, 0) > begun
                    if refused:
                        break
                    if same(self.values[name], value):
                        return value
                    # The first different value may be a late answer to an earlier request.
                    last_number = self._received[name]
                    different_values += 1
                if different_values > 1 or refused:
                    break
            del self._written[name]
        if refused and (name in self._absent or name not in self.values):
            raise AutopilotError(f"{name} cannot be set to {value:g}: the autopilot has no such parameter")
        if not different_values and not refused:
            raise ParameterLost(f"{name} cannot be set to {value:g}: the autopilot does not answer")
        return self.values[name]

    def _known(self, names: Spellings) -> bool:
        """Return True if the vehicle has reported the parameter."""
        return any(name in self._received for name in names)

    def _spelt(self, names: Spellings) -> str:
        return next((name for name in names if name in self._received), " or ".join(names))

    async def _request_by_name(
        self, unanswered: list[Spellings], fresh: Callable[[Spellings], bool], attempts: int
    ) -> list[Spellings]:
        """Request parameters by name and return those without an answer."""
        for _ in range(attempts):
            unanswered = [names for names in unanswered if not fresh(names)]
            requests = [(names, name) for names in unanswered for name in self._names_to_request(names)]
            for begin in range(0, len(requests), WINDOW):
                window = requests[begin : begin + WINDOW]
                for _, name in window:
                    # An index of -1 requests by name.
                    self._request(name.encode(), -1)
                await self._answered(lambda: all(fresh(names) for names, _ in window))  # noqa: B023
        return [names for names in unanswered if not fresh(names)]

    def _names_to_request(self, names: Spellings) -> Spellings:
        known = tuple(name for name in names if name in self._received and name not in self._absent)
        return known[:1] or names

    def _request(self, name: bytes, index: int) -> None:
        self._link.send(
            message("PARAM_REQUEST_READ", param_index=index, param_id=name, **self._link.address(silent=True))
        )

    @property
    def _complete(self) -> bool:
        return self._size is not None and len(self._list) == self._size

    async def _fetch_list(self) -> bool:
        """Request the complete list and return False if it stays incomplete."""
        async with self._listing:
            silent = 0
            try:
                async with asyncio.timeout(LIST_TIMEOUT_S):
                    while silent < PARAMETER_ATTEMPTS and not self._complete:
                        before = len(self._list)
                        await self._fetch()
                        silent = 0 if len(self._list) > before else silent + 1
            except TimeoutError:
                pass
            return self._complete

    async def _fetch(self) -> None:
        """Request the list, or its missing entries."""
        size = self._size or 0
        if size - len(self._list) > FEW_MISSING * size or not size:
            self._link.send(message("PARAM_REQUEST_LIST", **self._link.address(silent=True)))
            last_number = -1
            while last_number != self._number and not self._complete:
                last_number = self._number
                await self._answered(lambda: self._number > last_number, LIST_QUIET_S)  # noqa: B023
        else:
            window = [index for index in range(size) if index not in self._list][:WINDOW]
            for index in window:
                self._request(b"", index)
            await self._answered(lambda: all(index in self._list for index in window))

    async def _answered(self, done: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Wait for a condition on received values; return False after the timeout."""
        if done():
            return True
        try:
            async with asyncio.timeout(PARAMETER_TIMEOUT_S if timeout_s is None else timeout_s):
                while not done():
                    await self._value_received.wait()
        except TimeoutError:
            return False
        return True


def same(a: float, b: float) -> bool:
    """Return True if two values are the same 32-bit float, as PARAM_VALUE transmits them."""
    return math.isclose(a, b, rel_tol=1e-6, abs_tol=1e-6)
