"""Runtime objects that the control state refers to by id: control leases, motions and flight constraints."""

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


class Lease:
    """Control lease of one driver: its grant, and the events that its control stream still has to send.

    Attributes:
        lease_id: Id in the control state.
        grant: Current grant of the driver.
    """

    def __init__(self, grant: ActiveGrant) -> None:
        self.lease_id = next(_ids)
        self.grant = grant
        self._events: asyncio.Queue[ControlEvent | None] = asyncio.Queue()

    @property
    def key(self) -> str:
        """Key of the mission."""
        return self.grant.key

    def send(self, event: ControlEvent | None) -> None:
        """Queue an event for the driver. None ends the stream without an event."""
        self._events.put_nowait(event)

    async def receive(self, timeout_s: float) -> ControlEvent | None:
        """Return the next event, or None at the end of the stream.

        Raises:
            TimeoutError: No event was queued in time.
        """
        async with asyncio.timeout(timeout_s):
            return await self._events.get()


@dataclass(eq=False, slots=True)
class FlightConstraints:
    """Flight constraints of a system flight. They follow changes of the grant."""

    grant: ActiveGrant
    compiled: CompiledGrant
    flight_id: int = field(default_factory=lambda: next(_ids))


class Motion:
    """Motion call in progress, until it completes or is stopped.

    Attributes:
        motion_id: Id in the control state.
        kind: Name of the method.
        braking: True while the drone comes to rest before the motion, so that the monitor does not stop the motion.
        leg: Leg being flown; None if there is none.
        under_way: True if the autopilot acknowledged the leg.
        speed_mps: Speed of the leg.
    """

    def __init__(self, kind: str) -> None:
        self.motion_id = next(_ids)
        self.kind = kind
        self.braking = False
        self.leg: GotoArgs | None = None
        self.under_way = False
        self.speed_mps: float | None = None
        self._refusal: Refused | None = None

    def stop(self, refusal: Refused) -> None:
        """End the motion. Its caller receives the first refusal."""
        self._refusal = self._refusal or refusal

    def check(self) -> None:
        """Return if the motion may continue.

        Raises:
            Refused: The motion was stopped.
        """
        if self._refusal is not None:
            raise self._refusal
