"""Simulation of several vehicles with a common time: receive, advance, forward and record."""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from typing import BinaryIO

from fractus_runtime.mavlink_codec import Message
from fractus_services.mavlink_server.channel import Channel
from fractus_services.mavlink_server.stream_groups import ALL_GROUPS, GROUPS

from fractus_vehicle.dispatch import dispatch
from fractus_vehicle.plans import restore
from fractus_vehicle.state import CONTROL_STEP_S, VehicleConfig
from fractus_vehicle.vehicle import Vehicle

# Messages about a link itself, which are never forwarded.
_LINK_LOCAL = frozenset({"RADIO_STATUS", "RADIO", "SETUP_SIGNING"})


class Craft:
    """A vehicle with its links. The links stay open when the vehicle reboots."""

    def __init__(self, config: VehicleConfig) -> None:
        self.config = config
        self.vehicle = Vehicle(config)
        self._recorder: BinaryIO | None = None

    def open(self, name: str, port: int | None = None) -> Channel:
        """Open a link and return its channel. `port` selects the SRn_ parameters of its default streams."""
        channel = Channel(self.config.sysid, name=name, port=port)
        key = self.vehicle.signing_key
        if key is not None:
            channel.set_signing(key, signing_clock(self.vehicle.state.unix_us))
        self.vehicle.attach(channel)
        return channel

    def close(self, channel: Channel) -> None:
        """Close a link."""
        if channel in self.vehicle.state.channels:
            self.vehicle.detach(channel)

    def receive(self, channel: Channel, data: bytes) -> None:
        """Handle bytes received on a link."""
        for message in channel.receive(data):
            if self._recorder is not None:
                self._log(message.frame)
            self._route(channel, message)
            dispatch(self.vehicle, message, channel)

    def _route(self, source: Channel, message: Message) -> None:
        """Forward a message to the links on which its target has sent messages, like ArduPilot."""
        if len(self.vehicle.state.channels) < 2 or message.name in _LINK_LOCAL or message.sysid == self.config.sysid:
            return
        system = message.integer("target_system") if message.has("target_system") else 0
        component = message.integer("target_component") if message.has("target_component") else 0
        if system == self.config.sysid and component in (0, self.vehicle.state.compid):
            return
        for channel in self.vehicle.state.channels:
            if channel is not source and (
                any(system in (0, peer) and component in (0, part) for peer, part in channel.peers)
            ):
                channel.forward(message.frame)

    def step(self) -> None:
        """Advance by one control step."""
        self.vehicle.step()
        if self.vehicle.reboot_requested:
            self._reboot()

    def _reboot(self) -> None:
        """Restart the vehicle at its position. Keep parameters, plans and the signing key."""
        old = self.vehicle.state
        key = self.vehicle.signing_key
        place = replace(old.true_place, alt_m=self.config.start.alt_m)
        heading_deg = math.degrees(old.body.euler()[2]) % 360.0
        self.vehicle = Vehicle(
            replace(
                self.config,
                start=place,
                depot=old.config.depot or old.config.start,
                heading_deg=heading_deg,
                parameters=old.params.changes(),
            )
        )
        self.vehicle.signing_key = key
        restore(self.vehicle.state, old)
        for channel in old.channels:
            channel.streams.clear()
            channel.parameters.clear()
            self.vehicle.attach(channel)

    def _log(self, frame: bytes) -> None:
        if self._recorder is not None:
            self._recorder.write(struct.pack(">Q", self.vehicle.state.unix_us) + frame)

    def record(self, file: BinaryIO, rate_hz: float = 4.0) -> None:
        """Record a tlog with all received messages and, at `rate_hz`, all stream messages."""
        self._recorder = file
        channel = Channel(self.config.sysid, name="recorder", tap=self._log, discard=True)
        self.vehicle.attach(channel)
        for group in ALL_GROUPS:
            for name in GROUPS[group][1]:
                channel.set_interval(name, 1.0 / rate_hz)


def signing_clock(unix_us: int) -> int:
    """Convert Unix time to MAVLink signing time: units of 10 µs since 1 January 2015."""
    return (unix_us - 1_420_070_400_000_000) // 10


class Simulation:
    """A fleet of vehicles with a common time."""

    def __init__(self, configs: list[VehicleConfig]) -> None:
        self.crafts = [Craft(config) for config in configs]
        self.ticks = 0

    @property
    def time_s(self) -> float:
        """Simulated time since the start in seconds."""
        return self.ticks * CONTROL_STEP_S

    def step(self) -> None:
        """Advance every vehicle by one control step."""
        self.ticks += 1
        for craft in self.crafts:
            craft.step()

    def quiet_steps(self, most: int) -> int:
        """Return the number of steps until the next stream message is due, from 1 to `most`.

        STATUSTEXTs are not considered.
        """
        quiet_s = min(
            (
                channel.next_send_s - craft.vehicle.state.time_s
                for craft in self.crafts
                for channel in craft.vehicle.state.channels
            ),
            default=math.inf,
        )
        return math.ceil(min(max(quiet_s / CONTROL_STEP_S - 1e-3, 1.0), most))

    def advance(self, duration_s: float) -> None:
        """Advance by a duration in seconds."""
        for _ in range(round(duration_s / CONTROL_STEP_S)):
            self.step()


def formation(config: VehicleConfig, count: int, spacing_m: float) -> list[VehicleConfig]:
    """Return the configurations of `count` vehicles in a row to the east, with consecutive system ids."""
    return [
        replace(
            config,
            sysid=config.sysid + at,
            start=config.start.offset(0.0, at * spacing_m),
            store=config.store.with_name(f"{config.store.stem}-{config.sysid + at}{config.store.suffix}")
            if config.store is not None and count > 1
            else config.store,
        )
        for at in range(count)
    ]
