"""GetControl streams: drivers wait for control, command the drone and return it; passengers follow their mission."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing

from fractus_core.control import ControlEvent, OutcomeKind, StreamState
from fractus_core.control.events import PassengerBoarded, TransitRequested
from fractus_core.control.machine import SECOND_STREAM
from fractus_core.control.state import ended_refusal

from fractus_services.errors import InvalidRequest, PolicyDenied, PreconditionFailed
from fractus_services.grant_files import ActiveGrant
from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.authority.effects import Lease
from fractus_services.mobility.settings import SETTINGS

MIN_RESPONSE_TIMEOUT_S = 1.0
MAX_RESPONSE_TIMEOUT_S = 60.0
"""Limits of the time within which a driver answers liveness requests."""


class ControlStreams:
    """Produces the events of control streams.

    Args:
        control: Control state.
        bring: Flies the drone to the control point of a driver with partial control. Yields the current step.
    """

    def __init__(self, control: ControlStore, bring: Callable[[Lease], AsyncGenerator[str, None]]) -> None:
        self._control = control
        self._bring = bring

    def follow(self, grant: ActiveGrant, response_timeout_s: float = 0.0) -> AsyncGenerator[ControlEvent, None]:
        """Yield the events of a caller's stream.

        Args:
            grant: Grant of the caller.
            response_timeout_s: Seconds within which a driver with control has to answer liveness requests; 0 for no requests.

        Raises:
            Refused: The caller may neither control the drone nor follow a mission.
        """
        if response_timeout_s and not MIN_RESPONSE_TIMEOUT_S <= response_timeout_s <= MAX_RESPONSE_TIMEOUT_S:
            limits = f"{MIN_RESPONSE_TIMEOUT_S:g} to {MAX_RESPONSE_TIMEOUT_S:g} s, or 0 for no liveness requests"
            raise InvalidRequest(
                "InvalidArgument", f"response_timeout_s is {response_timeout_s:g}; it must be {limits}"
            )
        return self._follow_mission(grant) if grant.spec.tour else self._drive(grant, response_timeout_s)

    # Drivers

    async def _drive(self, grant: ActiveGrant, response_timeout_s: float) -> AsyncGenerator[ControlEvent, None]:
        """Yield the events of a driver. The driver has control from GRANTED until this generator is closed."""
        control = self._control
        if grant.spec.class_ != "driver":
            raise PolicyDenied("NotADriver", "a passenger cannot get control; only a driver can")
        async with aclosing(self._until_alone(grant)) as waiting:
            async for reason in waiting:
                yield ControlEvent(StreamState.WAITING, control.mission(grant).points_done, reason)
        lease = control.open_lease(grant)
        try:
            while control.lease is lease and not control.state.granted:
                async with aclosing(self._until_ready(lease)) as waiting:
                    async for reason in waiting:
                        yield ControlEvent(StreamState.WAITING, control.mission(grant).points_done, reason)
                if control.not_ready_reason(lease.key) is None:
                    control.grant_control(lease)
                if not control.state.granted:
                    await control.changes.wait(SETTINGS.stream_check_interval_s)
            if not response_timeout_s:
                lease.called_at = control.autopilot.now
            async with aclosing(self._events(lease, response_timeout_s)) as events:
                async for event in events:
                    yield event
        finally:
            control.close_lease(lease)

    async def _events(self, lease: Lease, response_timeout_s: float) -> AsyncGenerator[ControlEvent, None]:
        """Yield the events of a lease until its end, and a liveness request in every interval without an event.

        A request is repeated until it is answered, because the answer may be lost. The waiting time is counted in completed intervals and not read from a clock. An answer that arrived while the service
        itself was suspended is therefore noticed in time.
        """
        waited_s = 0.0
        while True:
            try:
                event = await lease.receive(SETTINGS.ping_interval_s)
            except TimeoutError:
                waited_s += SETTINGS.ping_interval_s
                if not response_timeout_s:
                    continue
                if lease.responded:
                    waited_s = 0.0
                if waited_s >= response_timeout_s:
                    self._control.drop_unresponsive_driver(lease, waited_s)
                else:
                    yield lease.next_ping()
                continue
            if event is None:
                return
            yield event
            if event.final:
                return

    async def _until_alone(self, grant: ActiveGrant) -> AsyncGenerator[str, None]:
        """Wait until no other stream of this driver is open, at most `second_stream_wait_s`. Yield the reason once.

        The other stream may belong to a connection whose client no longer exists. The pings of the gRPC server then close
        the connection, and the driver continues. The stream of a client that exists stays open, unless the client answers
        no liveness requests and makes no motion call for `silent_driver_s`.
        """
        control = self._control
        give_up = control.autopilot.now + SETTINGS.second_stream_wait_s
        reported = False
        while (held := control.lease) is not None and held.key == grant.key and control.autopilot.now < give_up:
            if not reported:
                reported = True
                yield SECOND_STREAM
            silent_s = control.autopilot.now - held.called_at
            if control.motion is None and silent_s >= SETTINGS.silent_driver_s:
                control.drop_unresponsive_driver(held, round(silent_s))
            else:
                await control.changes.wait(SETTINGS.stream_check_interval_s)

    async def _until_ready(self, lease: Lease) -> AsyncGenerator[str, None]:
        """Yield each new reason to wait until the driver can get control."""
        control = self._control
        reported = ""
        while control.lease is lease:
            reason = control.not_ready_reason(lease.key)
            if control.state.armed_for_other(lease.key):
                raise PreconditionFailed(
                    "ControlHeld",
                    "another application has the drone; try again when the flight of that application has ended",
                )
            if reason is None:
                if lease.grant.spec.control != "partial":
                    return
                control.dispatch(TransitRequested(lease.lease_id))
                async with aclosing(self._bring(lease)) as flying:
                    async for step in flying:
                        yield step
                return
            if reason != reported:
                reported = reason
                yield reason
            await control.changes.wait(SETTINGS.stream_check_interval_s)

    # Passengers

    async def _follow_mission(self, grant: ActiveGrant) -> AsyncGenerator[ControlEvent, None]:
        """Yield the progress of a mission over points of interest. Closing the stream does not change the mission."""
        control = self._control
        control.dispatch(PassengerBoarded(grant.key, grant.identity))
        outcome = control.mission(grant).outcome
        if outcome is not None:
            raise PreconditionFailed(*ended_refusal(outcome))
        reported: ControlEvent | None = None
        while True:
            event = self._mission_event(grant)
            if event != reported:
                reported = event
                yield event
            if event.final:
                return
            await control.changes.wait(SETTINGS.stream_check_interval_s)

    def _mission_event(self, grant: ActiveGrant) -> ControlEvent:
        mission = self._control.mission(grant)
        visited = mission.waypoints
        outcome = mission.outcome
        if outcome is not None and outcome.kind is OutcomeKind.COMPLETE:
            return ControlEvent(StreamState.COMPLETE, visited, "every point of interest was visited", visited)
        if outcome is not None:
            return ControlEvent(StreamState.LOST, visited, str(outcome), visited)
        if self._control.state.touring == grant.key:
            reason = "the system flies through the points of interest"
            return ControlEvent(StreamState.PASSENGER, visited, reason, visited)
        reason = self._control.not_ready_reason(grant.key) or "the system is about to take off"
        return ControlEvent(StreamState.WAITING, visited, reason, visited)
