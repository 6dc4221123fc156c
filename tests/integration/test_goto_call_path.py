"""Limit the call path of one `Goto`: the functions of this repository between the SDK call and the first byte sent.

The number of files and functions is the amount that an engineer has to read to follow one call. It must not grow.
"""

from __future__ import annotations

import ast
import asyncio
import contextvars
import functools
import socket
import sys
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

from fractus.drone import Mobility
from fractus.environment import Endpoint
from fractus_core.api.names import node_server_name
from fractus_services.mobility.rpc.server import run
from fractus_services.options import MobilityOptions
from mobility_rig import DRIVER, FRAME, NODE, Rig, altitude_limit, fence, grant

MAX_FILES = 38
MAX_FUNCTIONS = 126  # the timing of telemetry changes the number by a few

REPOSITORY = Path(__file__).resolve().parents[2]
VALUE_METHODS = frozenset({"__init__", "__new__", "__post_init__", "__eq__", "__hash__", "__bool__", "__len__"})
FOLDERS = ("agent", "core", "proto", "runtime", "sdk", "services")

_traced: contextvars.ContextVar[bool] = contextvars.ContextVar("traced", default=False)


class CallPath:
    """Records the functions of this repository that one call runs, up to its first byte on the MAVLink link.

    A function counts if it runs in a task that was created during the recording: the SDK call, gRPC's task of the
    handler, and tasks and threads that these start. Earlier tasks, such as heartbeats and telemetry, do not
    count. Comprehensions, lambdas and nested functions count as part of the function that contains them.

    Properties, constructors and other special methods of values do not count, because a reader does not follow data
    access.
    """

    def __init__(self) -> None:
        self._called: dict[tuple[str, str], None] = {}
        self.sent = asyncio.Event()
        self._earlier = asyncio.all_tasks()
        self._ours: dict[CodeType, tuple[str, str] | None] = {}

    def start(self) -> None:
        """Begin to record."""
        threading.setprofile(self._profile)
        sys.setprofile(self._profile)

    def stop(self) -> None:
        """End the recording."""
        sys.setprofile(None)
        threading.setprofile(None)  # type: ignore[arg-type]

    @property
    def functions(self) -> list[tuple[str, str]]:
        """Files and names of the functions, in the order of the path."""
        return [(file, name) for file, name in self._called if not _accesses_data(file, name)]

    @property
    def files(self) -> list[str]:
        """The files of the functions, in the order of the path."""
        return list(dict.fromkeys(file for file, _ in self.functions))

    def _profile(self, frame: FrameType, event: str, arg: Any) -> None:
        if self.sent.is_set():
            return
        if event == "call":
            function = self._function(frame.f_code)
            if function is not None and self._counts():
                self._called.setdefault(function)
        elif event == "c_call" and _sends(arg) and self._counts():
            self.sent.set()

    def _counts(self) -> bool:
        """Return True if the current function runs in a task of the call, or in a thread that such a task started."""
        if _traced.get():
            return True
        try:
            task = asyncio.current_task()
        except RuntimeError:
            return False
        if task is None or task in self._earlier:
            return False
        _traced.set(True)
        return True

    def _function(self, code: CodeType) -> tuple[str, str] | None:
        if code not in self._ours:
            self._ours[code] = self._locate(code)
        return self._ours[code]

    def _locate(self, code: CodeType) -> tuple[str, str] | None:
        path = Path(code.co_filename)
        if not path.is_relative_to(REPOSITORY):
            return None
        relative = path.relative_to(REPOSITORY)
        if relative.parts[0] not in FOLDERS:
            return None
        return str(relative), code.co_qualname.partition(".<locals>")[0]


def _accesses_data(file: str, function: str) -> bool:
    name = function.rpartition(".")[2]
    return name == "<lambda>" or name in VALUE_METHODS or function in _properties(file)


@functools.cache
def _properties(file: str) -> frozenset[str]:
    """Return the qualified names of the properties that a source file defines."""
    return frozenset(
        f"{node.name}.{method.name}"
        for node in ast.walk(ast.parse((REPOSITORY / file).read_text()))
        if isinstance(node, ast.ClassDef)
        for method in node.body
        if isinstance(method, ast.FunctionDef)
        for decorator in method.decorator_list
        if isinstance(decorator, ast.Name) and decorator.id in {"property", "cached_property"}
    )


def _sends(function: Any) -> bool:
    """Return True for `socket.send`. It is a call of the MAVLink link, because gRPC does not use Python's sockets."""
    return function.__name__ == "send" and isinstance(getattr(function, "__self__", None), socket.socket)


@asynccontextmanager
async def serving(rig: Rig) -> AsyncIterator[None]:
    """Run the mobility service in this process and event loop."""
    options = MobilityOptions(
        grants=rig.grants,
        tls=rig.tls,
        state=rig.directory / "state",
        audit=rig.audit,
        node=NODE,
        node_object=rig.directory / "none.json",
        description=rig.directory / "none.yaml",
        listen=rig.address,
        lock_timeout=5.0,
        recordings=None,
        recordings_mb=0,
        metrics="",
        autopilot=rig.link,
        driver_grace=15.0,
        boarding=60.0,
        flat_terrain=False,
    )
    stop = asyncio.Event()
    service = asyncio.create_task(run(options, stop))
    try:
        yield
    finally:
        stop.set()
        await service


def endpoint(rig: Rig) -> Endpoint:
    """Store the driver's certificate and return the address of the service."""
    folder = rig.directory / "driver-tls"
    folder.mkdir()
    key, certificate = rig.authority.issue(DRIVER)
    for name, data in (("tls.key", key), ("tls.crt", certificate), ("ca.crt", rig.authority.pem)):
        (folder / name).write_bytes(data)
    return Endpoint(rig.address, node_server_name(NODE), folder)


async def record(call: Callable[[], Any]) -> CallPath:
    """Start a motion, record the call path to its first byte on the link, and wait for the end of the motion."""
    path = CallPath()

    async def fly() -> None:
        await call()

    path.start()
    try:
        flying = asyncio.create_task(fly())
        async with asyncio.timeout(10):
            await path.sent.wait()
    finally:
        path.stop()
    await flying
    return path


async def test_goto_call_path_stays_within_its_limits(rig: Rig) -> None:
    rig.write_grant(grant(altitude_limit(2, 30), fence("no-fly", "exclusion", "ignore", -60, -10, -40, 10)))
    rig.start_vehicle(2.0)
    async with serving(rig), Mobility(endpoint(rig)) as drone, drone.control():
        await drone.arm()
        await drone.takeoff(8)
        await rig.until(lambda drone: abs(drone.velocity.down_mps) < 0.05, description="hover")
        lat, lon = FRAME.latlon(0, 8)
        path = await record(lambda: drone.goto(lat, lon, 8))
    for file, function in path.functions:
        print(f"{file}: {function}")
    print(f"{len(path.files)} files, {len(path.functions)} functions")
    assert len(path.files) <= MAX_FILES
    assert len(path.functions) <= MAX_FUNCTIONS
