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
from fractus_services.mobility.authority.control import Control
from fractus_services.mobility.authority.journal import Journal
from fractus_services.mobility.authority.observer import Observer
from fractus_services.mobility.authority.situation import situation_of
from fractus_services.mobility.authority.supervisor import Supervisor
from fractus_services.mobility.flight.calls import CallJudge
from fractus_services.mobility.flight.courses import Courses
from fractus_services.mobility.flight.guard import Guard
from fractus_services.mobility.flight.homing import Homing
from fractus_services.mobility.flight.monitor import MotionMonitor
from fractus_services.mobility.flight.service import MobilityService
from fractus_services.mobility.flight.tours import Tours
from fractus_services.mobility.flight.transit import TransitFlight
from fractus_services.mobility.mavlink.ardupilot import ARDUCOPTER
from fractus_services.mobility.mavlink.autopilot import Autopilot
from fractus_services.mobility.mavlink.fence import MissionFence
from fractus_services.mobility.rpc.handlers import MobilityHandlers
from fractus_services.mobility.rpc.streams import Streams
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
    journal = Journal(options.state)
    autopilot = Autopilot(url, ARDUCOPTER)
    fence = MissionFence(autopilot, options.state)

    def guard_of(control: Control) -> Guard:
        return Guard(lambda: situation_of(control, clock()), audit)

    control = Control(
        autopilot,
        journal,
        grants,
        audit,
        fence=fence,
        grace_s=options.driver_grace,
        way_home=lambda control: Homing(control, guard_of(control)).approach,
    )
    guard = guard_of(control)
    homing = Homing(control, guard)
    courses = Courses(control, guard)
    transit = TransitFlight(control, guard, courses)
    tours = Tours(control, grants, transit.launch, courses, options.boarding)
    supervisor = Supervisor(control)
    autopilot.alive = supervisor.alive
    monitor = MotionMonitor(control, guard, audit, supervisor)
    observer = Observer(control)
    autopilot.on_found = observer.found
    autopilot.on_message = lambda m: observer.heartbeat() if m.name == "HEARTBEAT" else None
    audit.append("started", {"node": node, "autopilot": url})
    grants.listen(lambda old, new: _record_grant(audit, old, new))
    grants.scan()
    service = MobilityService(control, CallJudge(control, guard), homing.around)
    streams = Streams(control, transit.bring)
    handlers = MobilityHandlers(service, control, streams, grants=grants, node=node, clock=clock, heard=tours.heard)

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
