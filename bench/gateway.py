"""Added latency and processor time of the gateway for MAVLink programs, against MAVProxy in the same run.

A program sends velocities, and the other end notes when each of them arrives. For the gateway, the frames pass `fractus
gateway connect`, mutual TLS and `fractus gateway serve`, and arrive as calls at a socket in the place of the mobility
service, which accepts each call at once. For MAVProxy, they arrive as frames at a socket in the place of the autopilot.
The latency of the gateway therefore includes decoding, its decision and encoding of the call, but not the judgement.

`--frames` then sends random frames, most of them intact, to one connection of the gateway in this process. No frame
causes an exception, each resulting call is one that programs may make, and the memory of the process stays bounded.
"""

from __future__ import annotations

import asyncio
import contextlib
import struct
import sys
import tempfile
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "unit"))

from fractus_cli.standalone import StandalonePki
from fractus_cluster.ports import free_port
from fractus_core.api.names import component_identity
from fractus_proto.v1 import gateway_pb2, mobility_pb2, types_pb2
from fractus_runtime.mavlink_codec import Endpoint, Parser
from gateway_frames import check_call, frames
from google.rpc import status_pb2
from harness import Processes, Progress, Report, cpu_s, memory_mb, parser, quantile
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from test_gateway_session import World

NODE = "bench"
LATENCY_HZ = 50.0
LOAD_HZ = 1000.0
VELOCITY_ONLY = 0b110111000111
_LENGTH = struct.Struct(">I")

Send = Callable[[bytes], None]


class Arrivals:
    """Times at which velocities were sent and arrived. The north component of a velocity contains its number."""

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._sent_s: dict[int, float] = {}
        self.latencies_s: list[float] = []

    def frame(self, endpoint: Endpoint, number: int) -> bytes:
        """Return a velocity with this number, and note the time."""
        values = {"type_mask": VELOCITY_ONLY, "coordinate_frame": mavlink.MAV_FRAME_LOCAL_NED, "target_system": 1}
        frame = endpoint.encode("SET_POSITION_TARGET_LOCAL_NED", values | {"vx": number / 1024})
        self._sent_s[number] = self._loop.time()
        return frame

    def arrived(self, north_mps: float) -> None:
        """Note the arrival of a velocity."""
        sent_s = self._sent_s.pop(round(north_mps * 1024), None)
        if sent_s is not None:
            self.latencies_s.append(self._loop.time() - sent_s)


def heartbeat() -> bytes:
    """Return a heartbeat of a vehicle that flies in GUIDED."""
    values = {"type": 2, "autopilot": 3, "base_mode": 217, "custom_mode": 4, "system_status": 4, "mavlink_version": 3}
    return Endpoint(1, 1).encode("HEARTBEAT", values)


class FakeMobility:
    """Socket in the place of the mobility service: it grants control, and accepts each velocity."""

    def __init__(self, arrivals: Arrivals) -> None:
        self._arrivals = arrivals
        self._tasks: set[asyncio.Task[None]] = set()
        self.granted = asyncio.Event()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve the connection of an instance."""
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError, asyncio.CancelledError):
            while True:
                (length,) = _LENGTH.unpack(await reader.readexactly(_LENGTH.size))
                request = gateway_pb2.GatewayRequest.FromString(await reader.readexactly(length))
                if request.WhichOneof("request") == "call":
                    self._take(request.id, request.call, writer)

    def _take(self, number: int, call: gateway_pb2.GatewayCall, writer: asyncio.StreamWriter) -> None:
        match call.method:
            case "SetVelocity":
                self._arrivals.arrived(mobility_pb2.SetVelocityRequest.FromString(call.request).velocity.north_mps)
                allowed = types_pb2.Decision(action=types_pb2.Decision.ACTION_ALLOW)
                self._answer(writer, number, mobility_pb2.SetVelocityResponse(decision=allowed))
            case "GetControl":
                state = mobility_pb2.ControlEvent.STATE_GRANTED
                self._answer(writer, number, mobility_pb2.ControlEvent(state=state), last=False)
                self.granted.set()
            case "ListParameters":
                self._answer(writer, number, gateway_pb2.ParameterList(values={"WPNAV_SPEED": 500.0}))
            case "SubscribeVehicle":
                task = asyncio.get_running_loop().create_task(self._report(number, writer))
                self._tasks.add(task)
            case _:
                self._answer(writer, number, None)

    async def _report(self, number: int, writer: asyncio.StreamWriter) -> None:
        while not writer.is_closing():
            self._answer(writer, number, gateway_pb2.VehicleFrames(frames=heartbeat()), last=False)
            await asyncio.sleep(1.0)

    @staticmethod
    def _answer(writer: asyncio.StreamWriter, number: int, message: Any, *, last: bool = True) -> None:
        responses = []
        if message is not None:
            responses.append(gateway_pb2.GatewayResponse(id=number, message=message.SerializeToString()))
        if last:
            responses.append(gateway_pb2.GatewayResponse(id=number, status=status_pb2.Status().SerializeToString()))
        for response in responses:
            data = response.SerializeToString()
            writer.write(_LENGTH.pack(len(data)) + data)


@contextlib.asynccontextmanager
async def gateway(processes: Processes, directory: Path, arrivals: Arrivals) -> AsyncIterator[tuple[Send, list[int]]]:
    """Start the gateway and a sidecar, and yield a program's connection and the ids of both processes."""
    pki = StandalonePki.create(directory / "pki")
    identity = component_identity("default", "app", "Program", "program")
    socket = directory / "gateway.sock"
    mobility = FakeMobility(arrivals)
    server = await asyncio.start_unix_server(mobility.serve, socket)
    address = f"127.0.0.1:{free_port()}"
    port = free_port()
    fractus = [sys.executable, "-m", "fractus_cli", "gateway"]
    pids = [
        processes.start(
            "gateway", *fractus, "serve", "--tls", pki.node(NODE), "--mobility-socket", socket, "--listen", address,
            "--state", directory / "state", "--audit", directory / "audit.jsonl",
        ),
        processes.start(
            "sidecar", *fractus, "connect", "--gateway", address, "--node", NODE, "--tls", pki.component(identity),
            "--tcp", port, "--udp", free_port(),
        ),
    ]  # fmt: skip
    await asyncio.to_thread(processes.wait_for_log, "gateway", "gateway: serving")
    await asyncio.to_thread(processes.wait_for_log, "sidecar", "waiting for MAVLink programs")
    _, writer = await asyncio.open_connection("127.0.0.1", port)
    beating = asyncio.get_running_loop().create_task(_beat(writer.write))
    async with asyncio.timeout(30.0):
        await mobility.granted.wait()
    try:
        yield writer.write, pids
    finally:
        beating.cancel()
        writer.close()
        server.close()


@contextlib.asynccontextmanager
async def mavproxy(processes: Processes, directory: Path, arrivals: Arrivals) -> AsyncIterator[tuple[Send, list[int]]]:
    """Start MAVProxy, and yield a program's connection and the id of the process."""
    port = free_port()
    out = free_port()
    connected = asyncio.Event()

    async def autopilot(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        beating = asyncio.get_running_loop().create_task(_beat(writer.write, heartbeat()))
        parse = Parser()
        with contextlib.suppress(ConnectionError, asyncio.CancelledError):
            while data := await reader.read(4096):
                for message in parse.feed(data):
                    if message.name == "SET_POSITION_TARGET_LOCAL_NED":
                        arrivals.arrived(message.real("vx"))
        beating.cancel()

    class Program(asyncio.DatagramProtocol):
        address: tuple[str, int] | None = None

        def connection_made(self, transport: asyncio.DatagramTransport) -> None:  # type: ignore[override]
            self.transport = transport

        def datagram_received(self, _data: bytes, address: Any) -> None:
            self.address = address
            connected.set()

        def send(self, data: bytes) -> None:
            self.transport.sendto(data, self.address)

    server = await asyncio.start_server(autopilot, "127.0.0.1", port)
    transport, program = await asyncio.get_running_loop().create_datagram_endpoint(
        Program, local_addr=("127.0.0.1", out)
    )
    command = [
        Path(sys.executable).with_name("mavproxy.py"), f"--master=tcp:127.0.0.1:{port}", f"--out=udp:127.0.0.1:{out}",
        "--non-interactive", "--daemon", "--state-basedir", directory,
    ]  # fmt: skip
    pid = processes.start("mavproxy", sys.executable, *command, HOME=str(directory), MPLBACKEND="agg")
    async with asyncio.timeout(60.0):
        await connected.wait()
    beating = asyncio.get_running_loop().create_task(_beat(program.send))
    await asyncio.sleep(3.0)
    try:
        yield program.send, [pid]
    finally:
        beating.cancel()
        transport.close()
        server.close()


async def _beat(send: Send, frame: bytes | None = None) -> None:
    program = Endpoint(255, 190)
    while True:
        send(frame if frame is not None else program.encode("HEARTBEAT", {"type": 6, "autopilot": 8}))
        await asyncio.sleep(1.0)


async def paced(send: Send, arrivals: Arrivals, rate_hz: float, seconds: float) -> int:
    """Send velocities at a constant rate, and return their number."""
    loop = asyncio.get_running_loop()
    program = Endpoint(255, 190)
    begun_s = loop.time()
    sent = 0
    while (now_s := loop.time() - begun_s) < seconds:
        # At most 8 frames at once, so that a pause of this process does not become a burst.
        for _ in range(min(int(now_s * rate_hz) - sent + 1, 8)):
            send(arrivals.frame(program, sent))
            sent += 1
        await asyncio.sleep(max(begun_s + sent / rate_hz - loop.time(), 0.0))
    return sent


Open = Callable[[Processes, Path, Arrivals], contextlib.AbstractAsyncContextManager[tuple[Send, list[int]]]]


async def measured(open_path: Open, seconds: float) -> tuple[list[float], float, int]:
    """Return latencies in seconds, processor time in percent of a core at full rate, and the number of sent messages per second."""
    arrivals = Arrivals()
    with tempfile.TemporaryDirectory() as name, Processes(Path(name)) as processes:
        async with open_path(processes, Path(name), arrivals) as (send, pids):
            await paced(send, arrivals, LATENCY_HZ, 2.0)
            arrivals.latencies_s.clear()
            await paced(send, arrivals, LATENCY_HZ, seconds)
            latencies_s = list(arrivals.latencies_s)
            arrivals.latencies_s.clear()
            before_s = [cpu_s(pid) for pid in pids]
            sent = await paced(send, arrivals, LOAD_HZ, seconds)
            used_s = sum(cpu_s(pid) - before for pid, before in zip(pids, before_s, strict=True))
            processes.check()
    return latencies_s, 100 * used_s / seconds, round(sent / seconds)


def fuzzed(seed: int, count: int) -> tuple[int, float]:
    """Send random frames to a connection. Return the number of calls, and the growth of this process in megabytes."""
    world = World()
    progress = Progress(count)
    calls = 0
    before_mb = 0.0
    for number, frame in enumerate(frames(seed, count)):
        for call in world.session.receive(frame, world.now):
            check_call(call)
            calls += 1
            world.session.finish(
                call, mavlink.MAV_RESULT_ACCEPTED if calls % 2 else mavlink.MAV_RESULT_DENIED, "text", world.now
            )
        world.now += 0.001
        if number % 20 == 0:
            assert {(message.sysid, message.compid) for message in world.sent()} <= {(1, 1)}
            world.session.take_refusals()
            world.verdicts.clear()
        if number == count // 10:
            before_mb = memory_mb()["resident"]
        if number % 100_000 == 0:
            progress.show(number, f"{calls:,} calls")
    progress.show(count, f"{calls:,} calls")
    return calls, memory_mb()["resident"] - before_mb


def main() -> int:
    arguments = parser(__doc__, quick="measure for 4 s each, and send 20,000 frames")
    arguments.add_argument("--seconds", type=float, default=30.0, help="duration of each measurement")
    arguments.add_argument("--frames", type=int, default=10_000_000, help="number of random frames")
    arguments.add_argument("--seed", type=int, default=1, help="seed of the random frames")
    options = arguments.parse_args()
    if not Path(sys.executable).with_name("mavproxy.py").exists():
        raise SystemExit("bench: MAVProxy is missing; install it into this environment (uv pip install MAVProxy)")
    seconds = 4.0 if options.quick else options.seconds
    ours_s, ours_cpu, ours_hz = asyncio.run(measured(gateway, seconds))
    theirs_s, theirs_cpu, theirs_hz = asyncio.run(measured(mavproxy, seconds))
    report = Report("gateway", options)
    for name, share in (("p50", 0.5), ("p99", 0.99)):
        report.add(name, 1e3 * quantile(ours_s, share), 1e3 * quantile(theirs_s, share), count=len(ours_s))
    report.add("cpu", ours_cpu, theirs_cpu, sent=ours_hz, sent_to_mavproxy=theirs_hz)
    count = 20_000 if options.quick else options.frames
    calls, growth_mb = fuzzed(options.seed, count)
    report.add("growth", growth_mb, frames=count, calls=calls)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
