"""The state machine of control at work: holds its one state, tells it what happens, carries out what it asks for."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence

from fractus_core.control import ControlState
from fractus_core.control.actions import Action
from fractus_core.control.events import Event, Tick
from fractus_core.control.machine import transition
from fractus_core.control.state import VehicleFacts

from fractus_services.mobility.autopilot import Autopilot


class Machine:
    """The only one that assigns the state of control.

    Args:
        autopilot: the link, whose clock counts.
        state: to begin with.
        perform: carries out the actions.
    """

    def __init__(
        self,
        autopilot: Autopilot,
        state: ControlState,
        perform: Callable[[Sequence[Action]], None],
    ) -> None:
        self._autopilot = autopilot
        self._state = state
        self._timer: asyncio.TimerHandle | None = None
        self._closed = False
        self._perform = perform

    @property
    def known(self) -> ControlState:
        """The state after the last event, with the vehicle as it was then: for what does not depend on the vehicle."""
        return self._state

    @property
    def state(self) -> ControlState:
        """Everything that decides who commands the drone, with the drone as it is now."""
        self._state = self._state.observed(self._facts())
        return self._state

    def dispatch(self, event: Event) -> tuple[Action, ...]:
        """Tell the state machine what happened, and carry out what it asks for.

        Raises:
            Exception: an action failed; the others were carried out all the same.
        """
        self._state, actions = transition(self.state, event, self._autopilot.now)
        try:
            self._perform(actions)
        finally:
            self._set_timer()
        return actions

    def _facts(self) -> VehicleFacts:
        vehicle = self._autopilot.vehicle
        return VehicleFacts(
            connected=self._autopilot.connected,
            armed=vehicle.armed,
            in_air=vehicle.in_air,
            mode=vehicle.mode,
            failsafe=vehicle.failsafe,
            failsafe_text=vehicle.failsafe_text,
            failsafe_text_at=vehicle.failsafe_text_at,
            silent_s=vehicle.silent_s * self._autopilot.pace,
        )

    def close(self) -> None:
        """Let no deadline act any more: the service ends, and the autopilot's failsafe takes its place."""
        self._closed = True
        self._set_timer()

    def _set_timer(self) -> None:
        """Wake up at the next deadline of the state."""
        deadline = None if self._closed else self._state.deadline
        if self._timer is not None and self._timer.when() == deadline and not self._timer.cancelled():
            return
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if deadline is not None:
            self._timer = asyncio.get_running_loop().call_at(deadline, self._tick)

    def _tick(self) -> None:
        self._timer = None
        self.dispatch(Tick())
