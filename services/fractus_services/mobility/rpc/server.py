"""Process of the mobility service: construction, servers and shutdown."""

from __future__ import annotations

import asyncio
import logging
import socket
from functools import partial
from typing import Any

from fractus_core.api.nodes import Drone
from fractus_proto.v1 import mobility_pb2_grpc
from fractus_runtime.audit import AuditLog
from fractus_runtime.metrics import BackgroundReader, serve_metrics

from fractus_services.auth import TlsFiles
from fractus_services.clock import Clock
from fractus_services.decision_log import log_decision
from fractus_services.gateway.decisions import DECISIONS
from fractus_services.grant_files import GrantFiles
from fractus_services.grant_verifier import GrantVerifier
from fractus_services.grpc_server import run_until, serve_grpc
from fractus_services.mobility.authority.contact import CONTACT_FILE, LastContactFile
from fractus_services.mobility.authority.flown_grant import FLOWN_GRANT_FILE, FlownGrantFile
from fractus_services.mobility.authority.journal import Journal
from fractus_services.mobility.authority.supervisor import Supervisor
from fractus_services.mobility.mavlink.ardupilot import ARDUCOPTER
from fractus_services.mobility.mavlink.expected_position import EXPECTED_POSITION_FILE, ExpectedPositionFile
from fractus_services.mobility.mavlink.failsafes import MavlinkFailsafes
from fractus_services.mobility.mavlink.fence import MissionFence
from fractus_services.mobility.mavlink.mavlink_autopilot import MavlinkAutopilot
from fractus_services.mobility.mavlink.rtl_parameters import RtlParameters
from fractus_services.mobility.mavlink.startup_heartbeat import VEHICLE_FILE, mark_served
from fractus_services.mobility.mavlink.vehicle_identification import KnownVehicleFile
from fractus_services.mobility.rpc.flight_metrics import flight_metrics
from fractus_services.mobility.rpc.gateway_socket import GatewaySocket
from fractus_services.mobility.rpc.handlers import MobilityHandlers
from fractus_services.mobility.rpc.mobility_components import MobilityComponents
from fractus_services.node_description import NodeDescription
from fractus_services.options import CannotServe, MobilityOptions
from fractus_services.recording.mavlink_messages import MavlinkDecoder
from fractus_services.recording.recorder import Recorder
from fractus_services.recording.segment_directory import segments_in
from fractus_services.service_metrics import ServiceMetrics, common_metrics

log = logging.getLogger(__name__)

DEFAULT_LINK = "tcp:127.0.0.1:5760"
"""Autopilot link if neither the command line nor the node description specifies one."""


def _link(description: NodeDescription) -> str:
    """Return the autopilot link of a node description."""
    features = description.value.spec.services.mobility if isinstance(description.value, Drone) else None
    return features.connection if features is not None else DEFAULT_LINK


def _fixed_camera(description: NodeDescription) -> bool:
    """Return True if the description declares a mount without a gimbal. An undescribed mount may point anywhere."""
    camera = description.value.spec.services.camera if description.value is not None else None
    return camera is not None and camera.mount is not None and not camera.mount.gimbal


async def _watch_description(
    description: NodeDescription, url: str, identified: asyncio.Event, *, fixed_link: bool
) -> None:
    """Reload the node description when it changes.

    Args:
        description: The node description.
        url: Autopilot link in use.
        identified: Set once the vehicle was identified on this link.
        fixed_link: True if the command line specifies the link.

    Raises:
        CannotServe: The description names a different link, and no autopilot was found on the present one.
    """
    while True:
        await description.changed()
        if fixed_link or _link(description) == url:
            continue
        if not identified.is_set():
            raise CannotServe(
                f"the node description now names a different autopilot link ({_link(description)}); restarting"
            )
        log.warning(
            "mobility: node description names a different autopilot link, used after a restart (url=%s)",
            _link(description),
        )


def _connect(
    options: MobilityOptions,
    url: str,
    identified: asyncio.Event,
    *,
    recorder: Recorder,
    grants: GrantFiles,
    audit: AuditLog,
    clock: Clock,
) -> tuple[MavlinkAutopilot, MobilityComponents]:
    """Create the autopilot and the components that command it. `identified` is set once the vehicle is identified."""

    def on_found() -> None:
        identified.set()
        components.observer.found()
        components.control.tasks.spawn(mark_served(options.state))

    autopilot = MavlinkAutopilot(
        url,
        ARDUCOPTER,
        # The components need the autopilot, so its callbacks look them up when they are called.
        alive=lambda: components.supervisor.alive(),  # noqa: PLW0108
        on_found=on_found,
        on_heartbeat=lambda: components.observer.heartbeat(),  # noqa: PLW0108
        on_parameter=lambda name: components.observer.parameter(name),  # noqa: PLW0108
        known_vehicle=KnownVehicleFile(options.state / VEHICLE_FILE, url),
        expected_position=ExpectedPositionFile(options.state / EXPECTED_POSITION_FILE),
        received=recorder.take_received,
        sent=recorder.take_sent,
    )
    components = MobilityComponents(
        autopilot,
        MavlinkFailsafes(autopilot),
        MissionFence(autopilot, options.state),
        RtlParameters(autopilot, options.state),
        journal=Journal(options.state),
        grants=grants,
        audit=audit,
        clock=clock,
        grace_s=options.driver_grace,
        boarding_s=options.boarding,
        contact_file=LastContactFile(options.state / CONTACT_FILE),
        flown_grant=FlownGrantFile(options.state / FLOWN_GRANT_FILE),
    )
    return autopilot, components


async def run(options: MobilityOptions, stop: asyncio.Event) -> None:
    """Serve until `stop` is set and the owner's fence and parameters are restored, or a task of the service fails.

    Raises:
        CannotServe: An option is wrong. The error may be inside an ExceptionGroup.
    """
    # The audit log needs the clock, which reports its steps to the audit log.
    clock = Clock(lambda step_s, trusted: audit.clock_stepped(step_s, trusted))  # noqa: PLW0108
    description = NodeDescription(options.node, options.node_object, options.description, Drone)
    name = description.value.name if description.value is not None else socket.gethostname()
    node = options.node or name
    url = options.autopilot or _link(description)
    tls = TlsFiles(options.tls)
    recorder = Recorder(segments_in(options.recordings, options.recordings_mb), node, MavlinkDecoder(node))
    metrics = ServiceMetrics()

    audit = AuditLog(
        options.audit, clock, tls=options.tls, listeners=(metrics.take_entry, recorder.take_entry, log_decision)
    )
    verifier = GrantVerifier(options.tls, options.grant_memory)
    grants = GrantFiles(options.grants, node, verifier, options.flat_terrain, audit.refused_grant)
    identified = asyncio.Event()
    autopilot, components = _connect(
        options, url, identified, recorder=recorder, grants=grants, audit=audit, clock=clock
    )
    control = components.control
    monitor = components.monitor
    poi_missions = components.poi_missions
    audit.append("started", {"node": node, "autopilot": url})
    grants.listen(lambda old, new: _record_grant(audit, old, new))
    grants.listen(lambda _old, _new: recorder.take_grants([grant.spec for grant in grants.active.values()]))
    grants.scan()
    create_handlers = partial(
        MobilityHandlers,
        components.service,
        control,
        components.streams,
        grants=grants,
        node=node,
        clock=clock,
        on_passenger=poi_missions.passenger_called,
        fixed_camera=partial(_fixed_camera, description),
        recording_problem=lambda: recorder.problem,
        on_contact=control.contact.report,
    )
    handlers = create_handlers()

    register = partial(mobility_pb2_grpc.add_MobilityServiceServicer_to_server, handlers)
    calls = serve_grpc("mobility", options.listen, tls, register, handlers.admission, node=node)
    running = [autopilot.run(), grants.run(), monitor.run(), monitor.record(), poi_missions.run(), calls]
    if options.gateway_socket is not None:
        gateway = GatewaySocket(
            options.gateway_socket,
            create_handlers(interface="mavlink"),
            autopilot,
            DECISIONS.delivered,
            options.gateway_user,
        )
        running.append(gateway.run())
    running.append(_watch_description(description, url, identified, fixed_link=bool(options.autopilot)))
    stopped = asyncio.Event()
    running.append(_stop(stop, components.supervisor, stopped))
    metrics.add_callback(
        partial(common_metrics, BackgroundReader(tls.expires_s), grants, audit, lambda: recorder.problem)
    )
    metrics.add_callback(partial(flight_metrics, control, components.supervisor))
    try:
        async with serve_metrics(options.metrics, metrics.collect):
            await run_until(stopped, *running)
    finally:
        control.close()
    log.info("mobility: stopped, the autopilot's failsafe brings a flying drone home")
    await audit.close()
    await recorder.close()


async def _stop(stop: asyncio.Event, supervisor: Supervisor, stopped: asyncio.Event) -> None:
    """Set `stopped` when the vehicle is ready for the end of the service, after `stop` was set."""
    await stop.wait()
    await supervisor.stop()
    stopped.set()


def _record_grant(audit: AuditLog, old: Any, new: Any) -> None:
    grant = new or old
    change = "changed"
    if old is None:
        change = "added"
    elif new is None:
        change = "removed"
    audit.append("grant", {"change": change, "identity": grant.identity, "name": grant.name, "key": grant.key})
