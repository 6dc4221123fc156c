"""Wires the mobility service together and runs it."""

from __future__ import annotations

import asyncio
import logging
import socket
from functools import partial
from typing import Any

from fractus_core.api.nodes import Drone
from fractus_proto.v1 import mobility_pb2_grpc
from fractus_runtime.audit import AuditLog
from fractus_runtime.exposition import LastRead, serving

from fractus_services.auth import TlsFiles
from fractus_services.clock import Clock
from fractus_services.decision_log import log_decision
from fractus_services.grant_files import GrantFiles
from fractus_services.grant_verifier import GrantVerifier
from fractus_services.grpc_server import run_until, serve_grpc
from fractus_services.metrics import ServiceMetrics, common_figures
from fractus_services.mobility.authority.journal import Journal
from fractus_services.mobility.mavlink.ardupilot import ARDUCOPTER
from fractus_services.mobility.mavlink.autopilot import MavlinkAutopilot
from fractus_services.mobility.mavlink.failsafes import MavlinkFailsafes
from fractus_services.mobility.mavlink.fence import MissionFence
from fractus_services.mobility.mavlink.neighbours import Memory
from fractus_services.mobility.mavlink.returning import MavlinkReturn
from fractus_services.mobility.mavlink.startup import VEHICLE_FILE, came_to_serve
from fractus_services.mobility.mavlink.traced import TracedAutopilot
from fractus_services.mobility.rpc.figures import flight_figures
from fractus_services.mobility.rpc.handlers import MobilityHandlers
from fractus_services.mobility.rpc.wiring import Parts
from fractus_services.node_description import NodeDescription
from fractus_services.options import CannotServe, MobilityOptions
from fractus_services.recording.recorder import Recorder
from fractus_services.recording.segment_directory import segments_in

log = logging.getLogger(__name__)

DEFAULT_LINK = "tcp:127.0.0.1:5760"


def _link(description: NodeDescription) -> str:
    """The autopilot's link."""
    features = description.value.spec.services.mobility if isinstance(description.value, Drone) else None
    return features.connection if features is not None else DEFAULT_LINK


def _fixed_camera(description: NodeDescription) -> bool:
    """Whether pictures are judged by a mount that does not move; one that is not described counts as seeing everything."""
    camera = description.value.spec.services.camera if description.value is not None else None
    return camera is not None and camera.mount is not None and not camera.mount.gimbal


async def _follow(description: NodeDescription, url: str, heard: asyncio.Event, *, told: bool) -> None:
    """Follow the description, and watch for one with another link, where the command line does not tell it.

    Raises:
        CannotServe: there is one, and no vehicle was ever heard on the present link.
    """
    while True:
        await description.changed()
        if told or _link(description) == url:
            continue
        if not heard.is_set():
            raise CannotServe(f"the node's description tells another autopilot ({_link(description)}); starting again")
        log.warning("mobility: another autopilot is described, used after a restart (url=%s)", _link(description))


def _linked(
    options: MobilityOptions,
    url: str,
    heard: asyncio.Event,
    *,
    recorder: Recorder,
    grants: GrantFiles,
    audit: AuditLog,
    clock: Clock,
) -> tuple[MavlinkAutopilot, Parts]:
    """The autopilot's link, and the parts that command it; `heard` is set once there is a vehicle on the link."""

    def found() -> None:
        heard.set()
        parts.observer.found()
        parts.control.tasks.spawn(came_to_serve(options.state))

    autopilot = TracedAutopilot(
        url,
        ARDUCOPTER,
        # The parts need the autopilot first: they are looked up when it calls.
        alive=lambda: parts.supervisor.alive(),  # noqa: PLW0108
        on_found=found,
        on_heartbeat=lambda: parts.observer.heartbeat(),  # noqa: PLW0108
        on_parameter=lambda name: parts.observer.parameter(name),  # noqa: PLW0108
        memory=Memory(options.state / VEHICLE_FILE, url),
        received=recorder.take_received,
        sent=recorder.take_sent,
    )
    parts = Parts(
        autopilot,
        MavlinkFailsafes(autopilot),
        MissionFence(autopilot, options.state),
        MavlinkReturn(autopilot, options.state),
        journal=Journal(options.state),
        grants=grants,
        audit=audit,
        clock=clock,
        grace_s=options.driver_grace,
        boarding_s=options.boarding,
    )
    return autopilot, parts


async def run(options: MobilityOptions, stop: asyncio.Event) -> None:
    """Serve until `stop` is set, or a part of the service fails.

    Raises:
        CannotServe: an option is wrong; also within an ExceptionGroup.
    """
    # The log has its times from the clock, and is looked up when that is stepped.
    clock = Clock(lambda step_s, trusted: audit.clock_stepped(step_s, trusted))  # noqa: PLW0108
    description = NodeDescription(options.node, options.node_object, options.description, Drone)
    name = description.value.name if description.value is not None else socket.gethostname()
    node, url = options.node or name, options.autopilot or _link(description)
    tls = TlsFiles(options.tls)
    recorder = Recorder(segments_in(options.recordings, options.recordings_mb), node)
    metrics = ServiceMetrics()

    def recorded(entry: dict[str, Any]) -> None:
        metrics.take_entry(entry)
        recorder.take_entry(entry)
        log_decision(entry)

    audit = AuditLog(options.audit, clock, tls=options.tls, copied=recorded)
    verifier = GrantVerifier(options.tls, options.grant_memory)
    grants = GrantFiles(options.grants, node, verifier, options.flat_terrain, audit.refused_grant)
    heard = asyncio.Event()
    autopilot, parts = _linked(options, url, heard, recorder=recorder, grants=grants, audit=audit, clock=clock)
    control, monitor, tours = parts.control, parts.monitor, parts.tours
    audit.append("started", {"node": node, "autopilot": url})
    grants.listen(lambda old, new: _record_grant(audit, old, new))
    grants.listen(lambda _old, _new: recorder.take_grants([grant.spec for grant in grants.active.values()]))
    grants.scan()
    handlers = MobilityHandlers(
        parts.service,
        control,
        parts.streams,
        grants=grants,
        node=node,
        clock=clock,
        heard=tours.heard,
        fixed_camera=partial(_fixed_camera, description),
        recording_problem=lambda: recorder.problem,
    )

    register = partial(mobility_pb2_grpc.add_MobilityServiceServicer_to_server, handlers)
    calls = serve_grpc("mobility", options.listen, tls, register, handlers.admission, node=node)
    running = [autopilot.run(), grants.run(), monitor.run(), monitor.record(), tours.run(), calls]
    running.append(_follow(description, url, heard, told=bool(options.autopilot)))
    metrics.observe(partial(common_figures, LastRead(tls.expires_s), grants, audit, lambda: recorder.problem))
    metrics.observe(partial(flight_figures, control, parts.supervisor))
    try:
        async with serving(options.metrics, metrics.text):
            await run_until(stop, *running)
    finally:
        control.close()
    log.info("mobility: stopped, a drone in flight goes home by its autopilot's failsafe")
    await audit.close()
    await recorder.close()


def _record_grant(audit: AuditLog, old: Any, new: Any) -> None:
    grant = new or old
    change = "added" if old is None else "removed" if new is None else "changed"
    audit.append("grant", {"change": change, "identity": grant.identity, "name": grant.name, "key": grant.key})
