"""The simulated vehicle against measurements of a real ArduCopter, and its cost.

Motion is measured in lockstep, in simulated seconds. Processor time and memory are measured on a vehicle process that
runs in real time with its default step, first idle on the ground, then hovering with every stream at 4 Hz.
"""

from __future__ import annotations

import io
import math
import select
import socket
import statistics
import sys
import tempfile
import time
from pathlib import Path

from fractus_cluster.ports import free_port
from fractus_runtime.mavlink_codec import Endpoint
from fractus_vehicle.earth import Place
from fractus_vehicle.readiness import arming_refusals
from fractus_vehicle.simulation import Simulation, formation
from fractus_vehicle.state import CONTROL_STEP_S, VehicleConfig
from pymavlink.dialects.v20 import ardupilotmega as mavlink

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "component"))
from harness import Processes, Report, cpu_s, memory_mb, parser, wait_until
from vehicle_pilot import Pilot

START = Place.from_degrees(48.2, 16.37, 150.0)
GUIDED = (
    mavlink.MAV_CMD_DO_SET_MODE, (mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, mavlink.COPTER_MODE_GUIDED)
)  # fmt: skip
ARM = (mavlink.MAV_CMD_COMPONENT_ARM_DISARM, (1.0,))


def takeoff(altitude_m: float) -> tuple[int, tuple[float, ...]]:
    """Return the command of a takeoff and its parameters."""
    return mavlink.MAV_CMD_NAV_TAKEOFF, (0, 0, 0, 0, 0, 0, altitude_m)


def command(sysid: int, number: int, parameters: tuple[float, ...]) -> dict[str, float]:
    """Return the fields of a COMMAND_LONG."""
    values = {f"param{place}": float(value) for place, value in enumerate(parameters, start=1)}
    return values | {"target_system": sysid, "target_component": 1, "command": number}


def measure_motion(report: Report) -> None:
    """Measure takeoff, a leg of 50 m and the return flight. The real vehicle flew the same."""
    simulation = Simulation([VehicleConfig(start=START, ready_after_s=2.0)])
    pilot = Pilot(simulation, simulation.crafts[0])
    vehicle = simulation.crafts[0].vehicle.state
    report.add("takeoff", pilot.take_off(10.0), 9.5)
    pilot.fly_on(6.0)
    pilot.go_to(50.0, 0.0, 10.0)
    peak_mps = 0.0
    begun_s = simulation.time_s
    while math.hypot(vehicle.body.north - 50.0, vehicle.body.east) > 1.0:
        pilot.step()
        peak_mps = max(peak_mps, math.hypot(vehicle.body.vn, vehicle.body.ve))
    report.add("leg", simulation.time_s - begun_s, 9.3)
    report.add("peak", peak_mps, 8.4)
    pilot.fly_on(6.0)
    pilot.command(mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH)
    report.add("return", pilot.wait(lambda: not vehicle.armed, 120.0), 49.0)


def measure_start(report: Report) -> None:
    """Measure the parameter list and the time until the vehicle is ready. Check that equal seeds give equal logs."""
    simulation = Simulation([VehicleConfig(start=START)])
    pilot = Pilot(simulation, simulation.crafts[0])
    vehicle = simulation.crafts[0].vehicle.state
    pilot.send("PARAM_REQUEST_LIST", {"target_system": 1, "target_component": 1})
    begun_s = simulation.time_s
    listed = 0
    while listed < len(vehicle.params):
        listed += sum(message.name == "PARAM_VALUE" for message in pilot.step())
    report.add("parameters", len(vehicle.params), 1397)
    report.add("parameter_list", simulation.time_s - begun_s, 0.62)
    pilot.mode(mavlink.COPTER_MODE_GUIDED)
    report.add("ready", begun_s + pilot.wait(lambda: not arming_refusals(vehicle), 60.0), 41.0)
    report.add("steps", 1.0 / CONTROL_STEP_S)
    first, second, other = (log_of_flight(seed) for seed in (3, 3, 4))
    differences = sum(a != b for a, b in zip(first, second, strict=False)) + abs(len(first) - len(second))
    report.add("repeatable", differences, valid=first != other)


def log_of_flight(seed: int) -> bytes:
    """Return the telemetry log of a flight in wind."""
    file = io.BytesIO()
    parameters = {"SIM_WIND_SPD": 5.0, "SIM_WIND_TURB": 2.0}
    simulation = Simulation([VehicleConfig(start=START, ready_after_s=2.0, seed=seed, parameters=parameters)])
    simulation.crafts[0].record(file)
    pilot = Pilot(simulation, simulation.crafts[0])
    pilot.take_off(10.0)
    pilot.go_to(20.0, 10.0, 12.0)
    pilot.fly_on(20.0)
    return file.getvalue()


def measure_speed(report: Report, flight_s: float) -> None:
    """Measure simulated time per processor time for one and for fifty flying vehicles."""
    for count, claim, duration_s in ((1, "speed_one", flight_s), (50, "speed_fifty", flight_s / 20)):
        configs = formation(VehicleConfig(start=START, ready_after_s=2.0), count, 10.0)
        simulation = Simulation(configs)
        pilots = [Pilot(simulation, craft) for craft in simulation.crafts]
        for pilot in pilots:
            pilot.craft.vehicle.state.params.assign("DISARM_DELAY", 0)
            pilot.channel.streams.clear()
        simulation.advance(2.5)
        for pilot in pilots:
            for number, parameters in (GUIDED, ARM, takeoff(10.0)):
                pilot.send("COMMAND_LONG", command(pilot.craft.config.sysid, number, parameters))
            pilot.channel.take()
        simulation.advance(6.0)
        begun_s = time.process_time()
        simulation.advance(duration_s)
        rate = duration_s / (time.process_time() - begun_s)
        flying = sum(not craft.vehicle.state.landed for craft in simulation.crafts)
        report.add(claim, rate, valid=flying == count)


class Link:
    """A TCP connection to the vehicle."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=5.0)
        self._endpoint = Endpoint(255, mavlink.MAV_COMP_ID_MISSIONPLANNER)

    def send(self, name: str, values: dict[str, float]) -> None:
        """Send one message to the vehicle."""
        self._socket.sendall(self._endpoint.encode(name, {"target_system": 1, "target_component": 1} | values))

    def read(self, duration_s: float, until: str = "") -> int:
        """Read for some seconds, or until a message with the name `until` arrives. Return the number of messages."""
        count = 0
        end_s = time.monotonic() + duration_s
        while time.monotonic() < end_s:
            if not select.select([self._socket], [], [], max(0.0, end_s - time.monotonic()))[0]:
                break
            messages = self._endpoint.decode(self._socket.recv(65536))
            count += len(messages)
            if any(message.name == until for message in messages):
                break
        return count


def measure_process(report: Report, duration_s: float) -> None:
    """Measure processor time, memory, message rate and acknowledgement time of a vehicle process in real time."""
    port = free_port()
    link = f"tcp:127.0.0.1:{port}"
    options = ["--listen", link, "--ready-after", "1", "--param", "DISARM_DELAY=0"]
    with tempfile.TemporaryDirectory() as directory, Processes(Path(directory)) as processes:
        pid = processes.start("vehicle", sys.executable, "-m", "fractus_vehicle", *options)
        wait_until(lambda: bool(processes.log("vehicle")), "the vehicle", timeout_s=20.0)
        vehicle = Link(port)
        vehicle.read(2.0)
        before_s = cpu_s(pid)
        vehicle.read(duration_s)
        report.add("cpu_ground", (cpu_s(pid) - before_s) / duration_s * 100.0)
        vehicle.send("REQUEST_DATA_STREAM", {"req_message_rate": 4, "start_stop": 1})
        for number, parameters in (GUIDED, ARM, takeoff(20.0)):
            vehicle.send("COMMAND_LONG", command(1, number, parameters))
            vehicle.read(1.0, until="COMMAND_ACK")
        vehicle.read(15.0)
        before_s = cpu_s(pid)
        report.add("messages", vehicle.read(duration_s) / duration_s, 107.0)
        report.add("cpu_flying", (cpu_s(pid) - before_s) / duration_s * 100.0)
        waits_ms = []
        for number in range(100):
            vehicle.read(0.0037 * (1 + number % 5))
            begun_s = time.perf_counter()
            vehicle.send("COMMAND_LONG", command(1, mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, (1.0,)))
            vehicle.read(1.0, until="COMMAND_ACK")
            waits_ms.append((time.perf_counter() - begun_s) * 1000.0)
        report.add("acknowledgement", statistics.median(waits_ms), 5.8)
        report.add("memory", memory_mb(pid)["resident"])


def main() -> int:
    options = parser(__doc__, quick="shorter flights").parse_args()
    report = Report("vehicle", options)
    measure_motion(report)
    measure_start(report)
    measure_speed(report, 20.0 if options.quick else 120.0)
    measure_process(report, 5.0 if options.quick else 20.0)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
