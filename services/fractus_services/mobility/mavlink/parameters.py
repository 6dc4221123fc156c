"""The vehicle's parameters as it tells them: one whose answer was lost is told apart from one that it does not have."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Iterable
from typing import Protocol

from fractus_runtime.mavlink_codec import Message, message
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.errors import AutopilotError

ANSWER_TIMEOUT_S = 0.7
ATTEMPTS = 8
ATTEMPTS_BEFORE_LIST = 4
"""The list has some 1,400 parameters, half a minute at 57,600 baud: it is asked for only when a name gets no answer."""

WINDOW = 12
"""Requests under way at a time: ArduPilot keeps 20, and drops the others."""

LIST_QUIET_S = 2.0
LIST_TIMEOUT_S = 180.0
FEW_MISSING = 0.05
"""Share of the list that is asked for one by one; when more is missing, the whole list is asked for again."""

Spellings = tuple[str, ...]
"""The names of one parameter in older and newer releases: a vehicle has it under one of them."""


class ParameterLost(AutopilotError):
    """Whether the vehicle has a parameter, or which value it has, is not known: it does not answer."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason, link=True)


class Recipient(Protocol):
    """The link, as far as parameters need it."""

    def send(self, outgoing: Message) -> None:
        """Send a message."""

    def recipient(self) -> dict[str, int]:
        """The vehicle, as messages name their target."""


class Parameters:
    """Reads and writes parameters, and hears when someone else changes them.

    A parameter is absent only when the vehicle's whole list is known and does not have it; ArduPilot leaves out of its list
    what belongs to a part that is switched off, so that it is asked for by its name first, and again afterwards.

    Args:
        link: to the vehicle.
        on_change: called with the name of a parameter that has another value than before, when this service did not write it.

    Attributes:
        told: the values that the vehicle told last, by name.
        leg_speed: the owner's speed of legs while the vehicle's own ways home are slower; legs are flown with it.
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
        """The link broke: what answers next may be another vehicle, or another release."""
        self.told: dict[str, float] = {}
        self._news = asyncio.Event()
        self._number = 0
        self._heard: dict[str, int] = {}
        self._list: dict[int, str] = {}
        self._size: int | None = None
        self._absent: set[str] = set()

    def take(self, told: Message) -> None:
        """Hear a PARAM_VALUE: an answer, or the news that another station changed something."""
        name, value = told.text("param_id"), told.real("param_value")
        index, size = told.integer("param_index"), told.integer("param_count")
        self._number += 1
        before, self.told[name], self._heard[name] = self.told.get(name), value, self._number
        self._absent.discard(name)
        # Answers to names have index 65535; those of the list count, until switching a part on changes its length.
        if index < size:
            if size != self._size:
                self._size, self._list = size, {}
            self._list[index] = name
        news, self._news = self._news, asyncio.Event()
        news.set()
        if before is not None and not same(before, value) and not same(self._written.get(name, math.nan), value):
            self._on_change(name)

    def ask(self, name: str) -> None:
        """Ask for one parameter, and wait for nothing."""
        self._request(name.encode(), -1)

    async def read(self, wanted: Iterable[Spellings]) -> dict[str, float]:
        """The parameters that the vehicle has of those wanted, each under the name by which it has it, as it tells them now.

        Raises:
            ParameterLost: for one of them it is not known.
            AutopilotError: the vehicle is not connected.
        """
        begun, asked = self._number, tuple(wanted)
        wanted = [names for names in asked if not self._absent.issuperset(names)]
        # What was absent may be there by now: it is asked for, and not waited for.
        for name in self._absent.intersection(name for names in asked for name in names):
            self._request(name.encode(), -1)

        def fresh(names: Spellings) -> bool:
            return any(self._heard.get(name, 0) > begun for name in names)

        rest = await self._ask(wanted, fresh, ATTEMPTS_BEFORE_LIST)
        unknown = [" or ".join(names) for names in rest if not self._known(names)]
        if unknown and not await self._fetch_list():
            raise ParameterLost(
                f"{', '.join(unknown)} cannot be read: the autopilot answers neither that nor tells its whole list "
                f"({len(self._list)} of {self._size or '?'} parameters)"
            )
        rest = await self._ask(rest, fresh, ATTEMPTS - ATTEMPTS_BEFORE_LIST)
        if lost := [self._spelt(names) for names in rest if self._known(names)]:
            raise ParameterLost(f"{', '.join(lost)} cannot be read: the autopilot does not answer")
        self._absent.update(name for names in rest for name in names)
        found = (next((name for name in names if self._heard.get(name, 0) > begun), None) for names in wanted)
        return {name: self.told[name] for name in found if name is not None}

    async def write(self, name: str, value: float) -> float:
        """Set a parameter that the vehicle has; returns what it says it is then, which is another value when it refuses.

        Raises:
            ParameterLost: it does not say anything.
            AutopilotError: the vehicle is not connected.
        """
        async with self._locks.setdefault(name, asyncio.Lock()):
            self._written[name] = value
            heard, others = self._number, 0
            for _ in range(ATTEMPTS):
                self._link.send(
                    message(
                        "PARAM_SET",
                        param_id=name.encode(),
                        param_value=value,
                        param_type=mavlink.MAV_PARAM_TYPE_REAL32,
                        **self._link.recipient(),
                    )
                )
                while others < 2 and await self._answered(lambda: self._heard.get(name, 0) > heard):  # noqa: B023
                    if same(self.told[name], value):
                        return value
                    # The first other value may be a late answer to a question from before.
                    heard, others = self._heard[name], others + 1
                if others > 1:
                    break
            del self._written[name]
        if not others:
            raise ParameterLost(f"{name} cannot be set to {value:g}: the autopilot does not answer")
        return self.told[name]

    def _known(self, names: Spellings) -> bool:
        """Whether the vehicle is known to have a parameter."""
        return any(name in self._heard for name in names)

    def _spelt(self, names: Spellings) -> str:
        return next((name for name in names if name in self._heard), " or ".join(names))

    async def _ask(self, wanted: list[Spellings], fresh: Callable[[Spellings], bool], attempts: int) -> list[Spellings]:
        """Ask for parameters by name; returns those without an answer."""
        for _ in range(attempts):
            wanted = [names for names in wanted if not fresh(names)]
            asked = [(names, name) for names in wanted for name in self._to_ask(names)]
            for begin in range(0, len(asked), WINDOW):
                window = asked[begin : begin + WINDOW]
                for _, name in window:
                    # An index of -1 asks by name.
                    self._request(name.encode(), -1)
                await self._answered(lambda: all(fresh(names) for names, _ in window))  # noqa: B023
        return [names for names in wanted if not fresh(names)]

    def _to_ask(self, names: Spellings) -> Spellings:
        known = tuple(name for name in names if name in self._heard)
        return known[:1] or names

    def _request(self, name: bytes, index: int) -> None:
        self._link.send(message("PARAM_REQUEST_READ", param_index=index, param_id=name, **self._link.recipient()))

    @property
    def _complete(self) -> bool:
        return self._size is not None and len(self._list) == self._size

    async def _fetch_list(self) -> bool:
        """Learn the names of all parameters; False when the list does not become complete."""
        async with self._listing:
            silent = 0
            try:
                async with asyncio.timeout(LIST_TIMEOUT_S):
                    while silent < ATTEMPTS and not self._complete:
                        before = len(self._list)
                        await self._fetch()
                        silent = 0 if len(self._list) > before else silent + 1
            except TimeoutError:
                pass
            return self._complete

    async def _fetch(self) -> None:
        """Ask for the list, or for what it lacks."""
        size = self._size or 0
        if size - len(self._list) > FEW_MISSING * size or not size:
            self._link.send(message("PARAM_REQUEST_LIST", **self._link.recipient()))
            heard = -1
            while heard != self._number and not self._complete:
                heard = self._number
                await self._answered(lambda: self._number > heard, LIST_QUIET_S)  # noqa: B023
        else:
            window = [index for index in range(size) if index not in self._list][:WINDOW]
            for index in window:
                self._request(b"", index)
            await self._answered(lambda: all(index in self._list for index in window))

    async def _answered(self, done: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Wait until something was heard; False when it was not in time."""
        if done():
            return True
        try:
            async with asyncio.timeout(ANSWER_TIMEOUT_S if timeout_s is None else timeout_s):
                while not done():
                    await self._news.wait()
        except TimeoutError:
            return False
        return True


def same(a: float, b: float) -> bool:
    """Whether two values are one 32-bit float, which PARAM_VALUE carries."""
    return math.isclose(a, b, rel_tol=1e-6, abs_tol=1e-6)
