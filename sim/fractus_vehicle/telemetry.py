"""Sending of telemetry on links: streams, parameters and default rates."""

from __future__ import annotations

from fractus_services.mavlink_server.channel import PARAMETERS_PER_TICK, Channel
from fractus_services.mavlink_server.stream_groups import ALL_GROUPS, GROUPS

from fractus_vehicle.state import VehicleState
from fractus_vehicle.streams import BUILDERS

MAX_RATE_HZ = 100.0


def send(v: VehicleState, channel: Channel, name: str) -> bool:
    """Send a telemetry message on one link. Return False if the message has no data now."""
    builder = BUILDERS.get(name)
    values = None if builder is None else builder(v)
    if values is None:
        return False
    channel.send(name, values)
    return True


def send_on_all(v: VehicleState, name: str) -> None:
    """Send a telemetry message on every link."""
    for channel in v.channels:
        send(v, channel, name)


def serve(v: VehicleState, channel: Channel) -> None:
    """Send all due stream messages, and the next part of a requested parameter list, on one link."""
    for name in channel.due(v.time_s):
        send(v, channel, name)
    for _ in range(min(PARAMETERS_PER_TICK, len(channel.parameters))):
        send_parameter(v, channel, "", channel.parameters.popleft())


def send_parameter(v: VehicleState, channel: Channel, name: str, index: int, shown_index: int | None = None) -> None:
    """Send PARAM_VALUE by name or index, if the parameter exists."""
    entry = v.params.find(name, index)
    if entry is None:
        return
    shown, row, at = entry
    channel.send(
        "PARAM_VALUE",
        {
            "param_id": shown.encode("ascii"),
            "param_value": v.params[row.name],
            "param_type": row.wire_type,
            "param_count": len(v.params),
            "param_index": at if shown_index is None else shown_index,
        },
    )


def attach(v: VehicleState, channel: Channel) -> None:
    """Open a link with HEARTBEAT at 1 Hz and the streams of its SRn_ parameters."""
    v.channels.append(channel)
    channel.set_default("HEARTBEAT", 1.0)
    for group in ALL_GROUPS:
        _set_default_rate(v, channel, group)


def follow_rate(v: VehicleState, parameter: str) -> None:
    """Apply a changed SRn_ parameter to its links."""
    for channel in v.channels:
        for group in ALL_GROUPS:
            if parameter == f"SR{channel.port}_{GROUPS[group][0]}":
                _set_default_rate(v, channel, group)


def _set_default_rate(v: VehicleState, channel: Channel, group: int) -> None:
    label, names = GROUPS[group]
    rate_hz = 0.0 if channel.port is None else v.params[f"SR{min(channel.port, 6)}_{label}"]
    if rate_hz > 0.0:
        for name in names:
            channel.set_default(name, 1.0 / min(rate_hz, MAX_RATE_HZ))
