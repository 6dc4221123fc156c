"""How the vehicle speaks on its links: streams, texts, parameters, and what a new link hears by default."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from fractus_vehicle.channel import PARAMETERS_PER_TICK, Channel
from fractus_vehicle.mav import VERSION_TEXT, Severity
from fractus_vehicle.streams import ALL_GROUPS, BUILDERS, GROUPS

if TYPE_CHECKING:
    from fractus_mavlink import Value

    from fractus_vehicle.vehicle import Vehicle

TEXT_CHUNK = 50
HIGHEST_RATE_HZ = 100.0


class Voice:
    """The speaking side of one vehicle."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle

    def broadcast(self, name: str, values: Mapping[str, Value]) -> None:
        """Send a message on every link."""
        for channel in self._vehicle.channels:
            channel.send(name, values)

    def say(self, severity: Severity, text: str) -> None:
        """Send a STATUSTEXT on every link, in chunks when it is long."""
        data = text.encode("ascii", "replace")
        number = 1 + self._vehicle.ticks % 65000 if len(data) > TEXT_CHUNK else 0
        for at in range(0, max(len(data), 1), TEXT_CHUNK):
            self.broadcast(
                "STATUSTEXT",
                {
                    "severity": int(severity),
                    "text": data[at : at + TEXT_CHUNK],
                    "id": number,
                    "chunk_seq": at // TEXT_CHUNK,
                },
            )

    def banner(self) -> None:
        """Say what this is."""
        self.say(Severity.INFO, VERSION_TEXT)
        self.say(Severity.INFO, "Frame: QUAD/X")

    def send(self, channel: Channel, name: str) -> bool:
        """Send one of the telemetry messages on one link; False when there is no such message now."""
        builder = BUILDERS.get(name)
        values = None if builder is None else builder(self._vehicle)
        if values is None:
            return False
        channel.send(name, values)
        return True

    def serve(self, channel: Channel) -> None:
        """Send what is due on a link: its streams, and a part of the parameter list it asked for."""
        for name in channel.due(self._vehicle.time_s):
            self.send(channel, name)
        for _ in range(min(PARAMETERS_PER_TICK, len(channel.parameters))):
            self.send_parameter(channel, "", channel.parameters.popleft())

    def send_parameter(self, channel: Channel, name: str, index: int, shown_index: int | None = None) -> bool:
        """Send PARAM_VALUE by name or index; False when there is no such parameter."""
        params = self._vehicle.params
        found = params.find(name, index)
        if found is None:
            return False
        shown, row, at = found
        channel.send(
            "PARAM_VALUE",
            {
                "param_id": shown.encode("ascii"),
                "param_value": params[row.name],
                "param_type": row.wire_type,
                "param_count": len(params),
                "param_index": at if shown_index is None else shown_index,
            },
        )
        return True

    def attach(self, channel: Channel) -> None:
        """Open a link: HEARTBEAT at 1 Hz and silence otherwise, unless SR parameters ask for streams."""
        self._vehicle.channels.append(channel)
        channel.set_interval("HEARTBEAT", 1.0)
        for group in ALL_GROUPS:
            self._set_default_rate(channel, group)

    def detach(self, channel: Channel) -> None:
        """Close a link."""
        self._vehicle.channels.remove(channel)
        transfers = self._vehicle.plans.transfers
        if transfers.upload is not None and transfers.upload.channel is channel:
            transfers.upload = None

    def follow_rate(self, parameter: str) -> None:
        """Apply a changed SRn_ parameter to the links it is about."""
        for channel in self._vehicle.channels:
            for group in ALL_GROUPS:
                if parameter == f"SR{channel.port}_{GROUPS[group][0]}":
                    self._set_default_rate(channel, group)

    def _set_default_rate(self, channel: Channel, group: int) -> None:
        label, names = GROUPS[group]
        rate_hz = 0.0 if channel.port is None else self._vehicle.params[f"SR{min(channel.port, 6)}_{label}"]
        if rate_hz > 0.0:
            for name in names:
                channel.set_interval(name, 1.0 / min(rate_hz, HIGHEST_RATE_HZ))
