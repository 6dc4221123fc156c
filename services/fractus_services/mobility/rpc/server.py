"""Wires the mobility service together and runs it."""

from __future__ import annotations

import asyncio
import logging
import socket
from pathlib import Path
from typing import Any

import grpc
from fractus_core.api.nodes import Drone
from fractus_proto.v1 import mobility_pb2_grpc

from fractus_services.audit import AuditLog
from fractus_services.auth import TlsFiles
from fractus_services.clock import Clock
from fractus_services.grant_verifier import GrantVerifier
from fractus_services.grants import GrantFiles
from fractus_services.hosting import read_description, run_until, serve_grpc
from fractus_services.mobility.authority.journal import Journal
from fractus_services.mobility.mavlink.ardupilot import ARDUCOPTER
from fractus_services.mobility.mavlink.autopilot import MavlinkAutopilot
from fractus_services.mobility.mavlink.failsafes import MavlinkFailsafes
from fractus_services.mobility.mavlink.fence import MissionFence
from fractus_services.mobility.rpc.handlers import MobilityHandlers
from fractus_services.mobility.rpc.wiring import Parts
from fractus_services.options import MobilityOptions

log = logging.getLogger(__name__)

DEFAULT_LINK = "tcp:127.0.0.1:5760"


def describe(path: Path) -> tuple[str, str]:
    """Name and autopilot link of this node, from its description where there is one.

    Raises:
        CannotServe: the description is no Drone manifest.
    """
    drone = read_description(path, Drone)
    if not isinstance(drone, Drone):
        return socket.gethostname(), DEFAULT_LINK
    features = drone.spec.services.mobility
    return drone.name, features.connection if features is not None else DEFAULT_LINK


async def run(options: MobilityOptions, stop: asyncio.Event) -> None:
    """Serve until `stop` is set, or a part of the service fails.

    Raises:
        CannotServe: an option is wrong; also within an ExceptionGroup.
    """
    clock = Clock()
    name, link = describe(options.description)
    node, url = options.node or name, options.autopilot or link
    tls = TlsFiles(options.tls)
    audit = AuditLog(options.audit, clock)
    verifier = GrantVerifier(options.tls, options.grant_memory)
    grants = GrantFiles(options.grants, node, verifier, options.flat_terrain, audit.refused_grant)
    autopilot = MavlinkAutopilot(
        url,
        ARDUCOPTER,
        # The parts need the autopilot first: they are looked up when it calls.
        alive=lambda: parts.supervisor.alive(),  # noqa: PLW0108
        on_found=lambda: parts.observer.found(),  # noqa: PLW0108
        on_heartbeat=lambda: parts.observer.heartbeat(),  # noqa: PLW0108
    )
    parts = Parts(
        autopilot,
        MavlinkFailsafes(autopilot),
        MissionFence(autopilot, options.state),
        journal=Journal(options.state),
        grants=grants,
        audit=audit,
        clock=clock,
        grace_s=options.driver_grace,
        boarding_s=options.boarding,
    )
    control, monitor, tours = parts.control, parts.monitor, parts.tours
    audit.append("started", {"node": node, "autopilot": url})
    grants.listen(lambda old, new: _record_grant(audit, old, new))
    grants.scan()
    handlers = MobilityHandlers(
        parts.service, control, parts.streams, grants=grants, node=node, clock=clock, heard=tours.heard
    )

    def register(server: grpc.aio.Server) -> None:
        mobility_pb2_grpc.add_MobilityServiceServicer_to_server(handlers, server)

    serving = serve_grpc("mobility", options.listen, tls, register)
    await run_until(stop, autopilot.run(), grants.run(), monitor.run(), monitor.record(), tours.run(), serving)
    log.info("mobility: stopped, a drone in flight goes home by its autopilot's failsafe")
    await audit.close()


def _record_grant(audit: AuditLog, old: Any, new: Any) -> None:
    grant = new or old
    change = "added" if old is None else "removed" if new is None else "changed"
    audit.append("grant", {"change": change, "identity": grant.identity, "name": grant.name, "key": grant.key})
