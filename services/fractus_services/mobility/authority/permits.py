"""Permits of what the system flies: checked before each command is sent, so that nothing stale reaches the autopilot."""

from __future__ import annotations

from fractus_core.control import Authority

from fractus_services.errors import PreconditionFailed
from fractus_services.mobility.authority.control import Control
from fractus_services.mobility.authority.leases import FlightConstraints, Lease, Motion
from fractus_services.mobility.autopilot import Permit


def transit_permit(control: Control, lease: Lease, motion: Motion) -> Permit:
    """What the system flies for a waiting driver goes only while that one waits."""

    def check() -> None:
        motion.check()
        if control.lease is not lease or control.authority is not Authority.SYSTEM or not control.valid(lease.grant):
            raise PreconditionFailed("ControlLost", "the driver is gone")

    return check


def tour_permit(control: Control, constraints: FlightConstraints, motion: Motion) -> Permit:
    """What the system flies for passengers goes only while no one else has the drone."""

    def check() -> None:
        motion.check()
        if (
            control.constraints is not constraints
            or control.authority is not Authority.SYSTEM
            or not control.valid(constraints.grant)
        ):
            raise PreconditionFailed("ControlLost", "the system does not fly this mission any more")

    return check
