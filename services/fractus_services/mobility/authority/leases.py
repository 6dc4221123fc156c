"""Who holds the drone: the lease that a driver's stream keeps alive, the motion that runs, the fences it keeps to."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from enum import Enum

from fractus_core.policy.compiled import CompiledGrant
from fractus_core.policy.values import GotoArgs

from fractus_services.errors import Refused
from fractus_services.grants import ActiveGrant


class ControlState(Enum):
    """States of a driver's stream."""

    WAITING = "waiting"
    GRANTED = "granted"
    RIDING = "riding"
    LOST = "lost"
    COMPLETE = "complete"


@dataclass(frozen=True, slots=True)
class ControlEvent:
    """One event on a driver's stream."""

    state: ControlState
    control_point: int = 0
    reason: str = ""
    waypoints_reached: int = 0

    @property
    def final(self) -> bool:
        """Whether the stream ends after it."""
        return self.state in {ControlState.LOST, ControlState.COMPLETE}


class Lease:
    """A driver's hold on the drone.

    Attributes:
        grant: the grant, as it is now.
        granted: whether the driver drives, or still waits.
        transit: whether the system flies, or flew, for the waiting driver.
    """

    def __init__(self, grant: ActiveGrant) -> None:
        self.grant = grant
        self.granted = False
        self.transit = False
        self._events: asyncio.Queue[ControlEvent | None] = asyncio.Queue()

    @property
    def key(self) -> str:
        """The mission."""
        return self.grant.key

    def tell(self, event: ControlEvent | None) -> None:
        """Send an event to the driver; None ends the stream without one."""
        self._events.put_nowait(event)

    async def next(self, timeout_s: float) -> ControlEvent | None:
        """The next event, or None when the stream ends.

        Raises:
            TimeoutError: nothing happened.
        """
        async with asyncio.timeout(timeout_s):
            return await self._events.get()


@dataclass(eq=False, slots=True)
class FlightConstraints:
    """The fences under which the system flies an application's drone; they follow the grant when it changes."""

    grant: ActiveGrant
    compiled: CompiledGrant


class Motion:
    """A motion call that is being carried out, until it is complete or somebody stops it.

    Attributes:
        kind: what it is called.
        braking: whether the drone comes to rest first, so that nothing stops the motion before it begins.
        leg: what it flies at present; None while it flies none.
        speed_mps: with what that leg is flown.
    """

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.braking = False
        self.leg: GotoArgs | None = None
        self.speed_mps: float | None = None
        self._stopped: Refused | None = None

    @property
    def stopped(self) -> bool:
        """Whether it was stopped."""
        return self._stopped is not None

    def stop(self, why: Refused) -> None:
        """End it; the caller's stream ends with the reason."""
        self._stopped = self._stopped or why

    def check(self) -> None:
        """Go on, or raise why not.

        Raises:
            Refused: it was stopped.
        """
        if self._stopped is not None:
            raise self._stopped
