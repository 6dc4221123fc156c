"""What callers hold of the drone: the lease of a driver's stream, the motion that runs, the flight constraints of the system."""

from __future__ import annotations

import asyncio
import itertools
from dataclasses import dataclass, field

from fractus_core.control import ControlEvent
from fractus_core.policy.compiled_grant import CompiledGrant
from fractus_core.policy.decision_types import GotoArgs

from fractus_services.errors import Refused
from fractus_services.grant_files import ActiveGrant

_ids = itertools.count(1)
"""Names what control is told of: the state machine knows leases, motions and flights by their numbers alone."""


class Lease:
    """A driver's stream of GetControl: its grant, and the events that it is still to be told.

    Attributes:
        lease_id: by which control knows it.
        grant: as it is now.
    """

    def __init__(self, grant: ActiveGrant) -> None:
        self.lease_id = next(_ids)
        self.grant = grant
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
    flight_id: int = field(default_factory=lambda: next(_ids))


class Motion:
    """A motion call that is being carried out, until it is complete or it is stopped.

    Attributes:
        motion_id: by which control knows it.
        kind: what it is called.
        braking: whether the drone comes to rest first, so that nothing stops the motion before it begins.
        leg: what it flies at present; None while it flies none.
        under_way: whether the autopilot has acknowledged that leg.
        speed_mps: with what that leg is flown.
    """

    def __init__(self, kind: str) -> None:
        self.motion_id = next(_ids)
        self.kind = kind
        self.braking = False
        self.leg: GotoArgs | None = None
        self.under_way = False
        self.speed_mps: float | None = None
        self._stopped: Refused | None = None

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
