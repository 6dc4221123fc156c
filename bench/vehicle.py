"""The simulated vehicle beside the measured figures of a real ArduCopter, and what it costs to run.

    uv run python bench/vehicle.py [--quick] [--json FILE]

Motion is measured in lockstep (simulated seconds); processor time and memory of the real process at its default step,
idle and with every stream at 4 Hz while it hovers.
"""

from __future__ import annotations

import argparse
import io
import json
import math
import os
import select
import socket
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from fractus_cluster.ports import free_port
from fractus_runtime.mavlink_codec import Endpoint
from fractus_vehicle.earth import Place
from fractus_vehicle.readiness import arming_refusals
from fractus_vehicle.simulation import Simulation, formation
from fractus_vehicle.state import CONTROL_STEP_S, VehicleConfig
from pymavlink.dialects.v20 import ardupilotmega as mavlink

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "component"))
from vehicle_pilot import Pilot

START = Place.from_degrees(48.2, 16.37, 150.0)


@dataclass(frozen=True, slots=True)
class Claim:
    """One figure: ours, what it is compared with, and whether the target holds."""

    name: str
    ours: float
    theirs: float | None
    unit: str
    target: str
    holds: bool

    def as_json(self) -> dict[str, object]:
        """The claim as the benchmarks' common format has it."""
        ratio = None if not self.theirs else round(self.ours / self.theirs, 3)
        return {
            "name": self.name,
            "ours": round(self.ours, 3),
            "theirs": self.theirs,
            "unit": self.unit,
            "ratio": ratio,
            "target": self.target,
            "holds": self.holds,
        }


def near(name: str, ours: float, theirs: float, unit: str) -> Claim:
    """A figure of the real vehicle that must hold within 20 %."""
    return Claim(name, ours, theirs, unit, "within 20 %", abs(ours / theirs - 1.0) <= 0.2)


def at_most(name: str, ours: float, limit: float, unit: str) -> Claim:
    """A cost with a ceiling."""
    return Claim(name, ours, None, unit, f"< {limit:g}", ours < limit)


def motion() -> list[Claim]:
    """Takeoff, a leg of 50 m, and the way home, as the real one was measured."""
    simulation = Simulation([VehicleConfig(start=START, ready_after_s=2.0)])
    pilot = Pilot(simulation, simulation.crafts[0])
    vehicle = simulation.crafts[0].vehicle.state
    climb_s = pilot.take_off(10.0)
    pilot.fly_on(6.0)
    pilot.go_to(50.0, 0.0, 10.0)
    peak = 0.0
    begun = simulation.time_s
    while math.hypot(vehicle.body.north - 50.0, vehicle.body.east) > 1.0:
        pilot.step()
        peak = max(peak, math.hypot(vehicle.body.vn, vehicle.body.ve))
    leg_s = simulation.time_s - begun
    pilot.fly_on(6.0)
    pilot.command(mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH)
    home_s = pilot.wait(lambda: not vehicle.armed, 120.0)
    return [
        near("takeoff to 9.5 m", climb_s, 9.5, "s"),
        near("50 m leg to within 1 m", leg_s, 9.3, "s"),
        near("peak speed of the leg", peak, 8.4, "m/s"),
        near("return to launch until disarmed", home_s, 49.0, "s"),
    ]


def memory_and_start() -> list[Claim]:
    """The parameter list, the time until ready, and whether one seed gives one log."""
    simulation = Simulation([VehicleConfig(start=START)])
    pilot = Pilot(simulation, simulation.crafts[0])
    pilot.send("PARAM_REQUEST_LIST", {"target_system": 1, "target_component": 1})
    begun = simulation.time_s
    listed = 0
    count = len(simulation.crafts[0].vehicle.state.params)
    while listed < count:
        listed += sum(message.name == "PARAM_VALUE" for message in pilot.step())
    list_s = simulation.time_s - begun
    pilot.mode(mavlink.COPTER_MODE_GUIDED)
    ready_s = begun + pilot.wait(lambda: not arming_refusals(simulation.crafts[0].vehicle.state), 60.0)
    logs = [_log(seed) for seed in (3, 3, 4)]
    differs = sum(a != b for a, b in zip(logs[0], logs[1], strict=False)) + abs(len(logs[0]) - len(logs[1]))
    return [
        near("parameters", count, 1397, ""),
        near("whole parameter list", list_s, 0.62, "s"),
        near("ready to arm in GUIDED", ready_s, 41.0, "s"),
        Claim("control steps per second", 1.0 / CONTROL_STEP_S, None, "Hz", ">= 100", CONTROL_STEP_S <= 0.01),
        Claim("bytes that differ, one seed", differs, None, "B", "0", differs == 0 and logs[0] != logs[2]),
    ]


def _log(seed: int) -> bytes:
    """The tlog of a windy flight."""
    file = io.BytesIO()
    parameters = {"SIM_WIND_SPD": 5.0, "SIM_WIND_TURB": 2.0}
    simulation = Simulation([VehicleConfig(start=START, ready_after_s=2.0, seed=seed, parameters=parameters)])
    simulation.crafts[0].record(file)
    pilot = Pilot(simulation, simulation.crafts[0])
    pilot.take_off(10.0)
    pilot.go_to(20.0, 10.0, 12.0)
    pilot.fly_on(20.0)
    return file.getvalue()


def speed(flight_s: float) -> list[Claim]:
    """How much faster than real time one and fifty flying vehicles run, in time of one core (others may use it, too)."""
    claims = []
    for count, name in ((1, "one flying vehicle, times real time"), (50, "50 flying vehicles, times real time")):
        configs = formation(VehicleConfig(start=START, ready_after_s=2.0), count, 10.0)
        simulation = Simulation(configs)
        pilots = [Pilot(simulation, craft) for craft in simulation.crafts]
        for pilot in pilots:
            pilot.craft.vehicle.state.params.assign("DISARM_DELAY", 0)
            pilot.channel.streams.clear()
        simulation.advance(2.5)
        for pilot in pilots:
            pilot.send(
                "COMMAND_LONG",
                _order(
                    pilot,
                    mavlink.MAV_CMD_DO_SET_MODE,
                    mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED,
                    mavlink.COPTER_MODE_GUIDED,
                ),
            )
            pilot.send("COMMAND_LONG", _order(pilot, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0))
            pilot.send("COMMAND_LONG", _order(pilot, mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 10.0))
            pilot.channel.take()
        simulation.advance(6.0)
        begun = time.process_time()
        simulation.advance(flight_s / (1 if count == 1 else 20))
        rate = flight_s / (1 if count == 1 else 20) / (time.process_time() - begun)
        flying = sum(not craft.vehicle.state.landed for craft in simulation.crafts)
        floor = 20.0 if count == 1 else 1.0
        claims.append(Claim(name, rate, None, "x", f">= {floor:g}", rate >= floor and flying == count))
    return claims


def _order(pilot: Pilot, command: int, *params: float) -> dict[str, float]:
    values: dict[str, float] = {f"param{at}": float(value) for at, value in enumerate(params, start=1)}
    return values | {"target_system": pilot.craft.config.sysid, "target_component": 1, "command": command}


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _memory_mb(pid: int) -> float:
    return int(Path(f"/proc/{pid}/status").read_text(encoding="ascii").split("VmRSS:")[1].split()[0]) / 1024


class Link:
    """A bare TCP client."""

    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=5.0)
        self.endpoint = Endpoint(255, mavlink.MAV_COMP_ID_MISSIONPLANNER)

    def send(self, name: str, **values: float) -> None:
        """Send one message to the vehicle."""
        target: dict[str, float] = {"target_system": 1, "target_component": 1}
        self.socket.sendall(self.endpoint.encode(name, target | values))

    def read(self, duration_s: float, until: str = "") -> int:
        """Read for a time, or until a message of that name; returns how many came."""
        count = 0
        end = time.monotonic() + duration_s
        while time.monotonic() < end:
            if not select.select([self.socket], [], [], max(0.0, end - time.monotonic()))[0]:
                break
            messages = self.endpoint.decode(self.socket.recv(65536))
            count += len(messages)
            if any(message.name == until for message in messages):
                break
        return count


def process(duration_s: float) -> list[Claim]:
    """Processor time, memory, stream rate and acknowledgement time of the process in real time."""
    port = free_port()
    command = [sys.executable, "-m", "fractus_vehicle", "--listen", f"tcp:127.0.0.1:{port}", "--ready-after", "1"]
    child = subprocess.Popen([*command, "--param", "DISARM_DELAY=0"], stderr=subprocess.PIPE, text=True)
    assert child.stderr is not None
    try:
        child.stderr.readline()
        link = Link(port)
        link.read(2.0)
        before = _cpu_s(child.pid)
        link.read(duration_s)
        idle = (_cpu_s(child.pid) - before) / duration_s * 100.0
        link.send("REQUEST_DATA_STREAM", req_message_rate=4, start_stop=1)
        for values in (
            {
                "command": mavlink.MAV_CMD_DO_SET_MODE,
                "param1": mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED,
                "param2": mavlink.COPTER_MODE_GUIDED,
            },
            {"command": mavlink.MAV_CMD_COMPONENT_ARM_DISARM, "param1": 1},
            {"command": mavlink.MAV_CMD_NAV_TAKEOFF, "param7": 20},
        ):
            link.send("COMMAND_LONG", **values)
            link.read(1.0, until="COMMAND_ACK")
        link.read(15.0)
        before = _cpu_s(child.pid)
        rate = link.read(duration_s) / duration_s
        flying = (_cpu_s(child.pid) - before) / duration_s * 100.0
        waits = []
        for at in range(100):
            link.read(0.0037 * (1 + at % 5))
            begun = time.perf_counter()
            link.send("COMMAND_LONG", command=mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, param1=1)
            link.read(1.0, until="COMMAND_ACK")
            waits.append((time.perf_counter() - begun) * 1000.0)
        return [
            near("messages per second, every stream at 4 Hz", rate, 107.0, "1/s"),
            near("acknowledgement, median", sorted(waits)[50], 5.8, "ms"),
            at_most("processor, on the ground", idle, 3.0, "% of a core"),
            at_most("processor, flying, every stream at 4 Hz", flying, 3.0, "% of a core"),
            at_most("resident memory", _memory_mb(child.pid), 80.0, "MB"),
        ]
    finally:
        child.terminate()
        child.wait(10)


def main() -> None:
    """Measure and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    claims = (
        motion()
        + memory_and_start()
        + speed(20.0 if arguments.quick else 120.0)
        + process(5.0 if arguments.quick else 20.0)
    )
    width = max(len(claim.name) for claim in claims)
    for claim in claims:
        theirs = "" if claim.theirs is None else f"real {claim.theirs:g}"
        verdict = "holds" if claim.holds else "MISSED"
        print(f"{claim.name:<{width}}  {claim.ours:9.2f} {claim.unit:<12} {theirs:<12} {claim.target:<12} {verdict}")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps({"claims": [claim.as_json() for claim in claims]}, indent=2) + "\n")


if __name__ == "__main__":
    main()
