"""Fuzz sequences of calls to the mobility service, from callers with and without a Grant, in virtual time.

No handler fails, the vehicle moves only after a call of its driver, and it stays inside its operation area and outside the zone. The
same holds with other messages on its link, and when Grants are revoked.
"""

from __future__ import annotations

import asyncio
import functools
import logging
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import atheris
import grpc

# Import the simulation before the fuzzer instruments modules. Instrumentation would make it several times slower.
from mobility_world import World, spec, touring, zone

with atheris.instrument_imports(include=["fractus_services.mobility.rpc", "fractus_services.grpc_server"]):
    from fractus_services.mobility.rpc.handlers import MobilityHandlers
from fractus_core.api.names import node_identity
from fractus_proto.v1 import mobility_pb2, mobility_pb2_grpc
from fractus_runtime.mavlink_codec import message_class
from mavlink_frames import MESSAGE_CLASSES, frame_v2
from virtual_time import fly
from wire import DEADLINES_S, STRANGE, Context, Registry, called, certificate, request

FOLDER = Path(tempfile.mkdtemp())
NODE = "drone-1"
WALL = (-40.0, 25.0, 40.0, 40.0)
AREA_M = 200.0
NEAR_M = 2.0
METHODS = (
    "Arm", "Disarm", "Takeoff", "Land", "SetSpeed", "GetSpeed", "SetVelocity", "Goto", "Hover", "GetPosition",
    "ReturnToLaunch", "PointGimbal",
)  # fmt: skip
_SERVICES = [{"service": "mobility", "methods": METHODS}]
DRIVER = spec(zone("wall", "ignore", *WALL), services=_SERVICES)
PASSENGER = spec(**{"class": "passenger", "control": None, "controlPoints": [], "instance": "app-viewer"})
TOURIST = touring(zone("wall", "ignore", *WALL), tour=((30.0, 10.0),), instance="app-tourist")
WAITS_S = [0.0, 0.1, 0.5, 2.0]
TYPES = {
    method.name: getattr(mobility_pb2, method.input_type.name)
    for method in mobility_pb2.DESCRIPTOR.services_by_name["MobilityService"].methods
}
NAMES = sorted(TYPES)
VEHICLE_MESSAGES = [
    "HEARTBEAT", "GLOBAL_POSITION_INT", "EXTENDED_SYS_STATE", "SYS_STATUS", "HOME_POSITION", "ATTITUDE", "GPS_RAW_INT",
    "EKF_STATUS_REPORT", "STATUSTEXT", "COMMAND_ACK", "PARAM_VALUE", "TIMESYNC", "MISSION_REQUEST_INT", "MISSION_ACK",
]  # fmt: skip
OTHER_SENDERS = [(255, 190), (1, 154), (1, 191), (2, 1), (244, 191), (0, 0)]
"""Source ids of other senders: ground station, gimbal, companion, another vehicle, the service itself, id 0."""
logging.disable(logging.CRITICAL)


@functools.cache
def of(identity: str, days: int = 36500) -> bytes:
    """Return the certificate of a caller, from a cache."""
    return certificate(identity, days=days)


class Flight:
    """A vehicle, its service and the callers."""

    def __init__(self, data_provider: atheris.FuzzedDataProvider) -> None:
        self._data_provider = data_provider
        self._running: list[asyncio.Task[Any]] = []
        self._driven = False

    async def fly(self) -> None:
        """Make the calls, and then check the flight."""
        data_provider = self._data_provider
        # Most flights are short, because long flights take a hundred times longer.
        waits_s = WAITS_S if not data_provider.ConsumeIntInRange(0, 7) else WAITS_S[:1]
        async with World(FOLDER, step_s=0.2) as world:
            active = world.grants.put(DRIVER)
            known = [active, world.grants.put(PASSENGER, "m2")]
            toured = not data_provider.ConsumeIntInRange(0, 7)
            if toured:
                known.append(world.grants.put(TOURIST, "m3"))
            chains = [(of(grant.identity),) for grant in known]
            node = (of(node_identity(NODE)),)
            chains += [*STRANGE, (of(active.identity, 1),), node]
            handlers = MobilityHandlers(
                world.service, world.control, world.streams, grants=world.grants, node=NODE, clock=time.time,  # type: ignore[arg-type]
                on_passenger=world.poi_missions.passenger_called,
            )  # fmt: skip
            registry = Registry(handlers.admission)
            mobility_pb2_grpc.add_MobilityServiceServicer_to_server(handlers, registry)
            in_flight = not data_provider.ConsumeIntInRange(0, 7)
            if in_flight:
                self._driven = True
                await world.up(active, 3.0)
            spoofed = await self._calls(world, registry, chains, waits_s)
            for task in self._running:
                task.cancel()
            for outcome in await asyncio.gather(*self._running, return_exceptions=True):
                if isinstance(outcome, Exception):
                    raise outcome
            for task in world._tasks:
                if task.done() and not task.cancelled() and task.exception() is not None:
                    raise AssertionError("a task of the service failed") from task.exception()
            if spoofed:
                return
            assert self._driven or toured or not world.plane.vehicle.armed, (
                "the vehicle is armed without a call of a driver"
            )
            for x, y, _ in world.plane.trace:
                assert max(abs(x), abs(y)) < AREA_M + NEAR_M, (x, y)
                assert not (WALL[0] + NEAR_M < x < WALL[2] - NEAR_M and WALL[1] + NEAR_M < y < WALL[3] - NEAR_M), (x, y)

    async def _calls(
        self, world: World, registry: Registry, chains: list[tuple[bytes, ...]], waits_s: list[float]
    ) -> bool:
        """Make up to twelve calls. Return True if the noise may contain messages with the vehicle's source id."""
        data_provider = self._data_provider
        spoofed = False
        for _ in range(12):
            if not data_provider.remaining_bytes():
                break
            if not data_provider.ConsumeIntInRange(0, 9):
                spoofed = self._send_noise(world) or spoofed
                continue
            if not data_provider.ConsumeIntInRange(0, 15) and world.grants.active:
                world.grants.remove(data_provider.PickValueInList(list(world.grants.active.values())))
                continue
            name = data_provider.PickValueInList(NAMES)
            which = data_provider.ConsumeIntInRange(0, 4 * len(chains) - 1)
            chain = chains[which if which < len(chains) else 0]
            self._driven = self._driven or chain == chains[0]
            deadline_s = data_provider.PickValueInList(DEADLINES_S) if data_provider.ConsumeBool() else DEADLINES_S[0]
            context = Context(chain, deadline_s)
            call = _checked_call(
                registry.handlers[name], request(data_provider, TYPES[name]), context, of_node=chain == chains[-1]
            )
            self._running.append(asyncio.ensure_future(call))
            await asyncio.sleep(data_provider.PickValueInList(waits_s))
        return spoofed

    def _send_noise(self, world: World) -> bool:
        """Send arbitrary bytes on the link. Return True if they may contain a message with the vehicle's source id."""
        data_provider = self._data_provider
        if not data_provider.ConsumeIntInRange(0, 7):
            world.plane._received(data_provider.ConsumeBytes(data_provider.ConsumeIntInRange(0, 300)))
            return True
        kind = (
            message_class(data_provider.PickValueInList(VEHICLE_MESSAGES))
            if data_provider.ConsumeBool()
            else data_provider.PickValueInList(MESSAGE_CLASSES)
        )
        source = (
            data_provider.PickValueInList(OTHER_SENDERS)
            if data_provider.ConsumeBool()
            else world.plane.target or (1, 1)
        )
        payload = data_provider.ConsumeBytes(kind.unpacker.size)
        world.plane._received(frame_v2(kind, payload or b"\0", source=source))
        return source not in OTHER_SENDERS


async def _checked_call(handler: grpc.RpcMethodHandler, body: bytes, context: Context, *, of_node: bool) -> None:
    """Make a call. Check that only the node receives the outcome of missions."""
    await called(handler, body, context)
    for message in context.written:
        assert of_node or not getattr(message, "missions", None), "the reply contains another component's mission"


def fuzz_one(data: bytes) -> None:
    """Run one flight."""
    fly(Flight(atheris.FuzzedDataProvider(data)).fly)


if __name__ == "__main__":
    atheris.Setup(sys.argv, fuzz_one)
    atheris.Fuzz()
