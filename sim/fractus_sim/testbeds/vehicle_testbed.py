"""Experiment mode vehicles: simulated autopilots in this process, or external autopilots over TCP."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

from fractus_cluster.ports import free_port
from fractus_vehicle.earth import Place
from fractus_vehicle.links import Hub, LinkError, LinkSpec
from fractus_vehicle.params import UnknownParameterError
from fractus_vehicle.simulation import Craft, Simulation
from fractus_vehicle.state import CONTROL_STEP_S, REPEATABLE_EPOCH_US, VehicleConfig

from fractus_sim.errors import ExperimentError
from fractus_sim.experiment.definition import Experiment, Program, VehicleSetup
from fractus_sim.testbeds.ground_station import ChannelLink, Link, Station, TcpLink
from fractus_sim.testbeds.link_tap import LinkTap
from fractus_sim.testbeds.local_processes import Processes
from fractus_sim.testbeds.testbed import Moment, Testbed, program_command
from fractus_sim.testbeds.tlog import TlogWriter

STEPS_PER_TICK = 2
MAX_BEHIND_S = 1.0
"""Maximum delay of this process, in real time, that the simulation makes up for. After a longer delay, it stays behind."""

CONNECT_S = 20.0


class VehicleTestbed(Testbed):
    """Simulated vehicles in this process, or running autopilots, without services."""

    def __init__(self, experiment: Experiment, folder: Path, base: Path, report: Callable[[str], None]) -> None:
        super().__init__(experiment, folder, base, report)
        self._logs = folder / "logs"
        self._programs = Processes(self._logs)
        self.processes = self._programs
        self._hub = self.keep(Hub())
        self._simulation = Simulation([])
        self._program_links: dict[str, str] = {}
        self._taps: dict[str, list[LinkTap]] = {}
        self._pace = experiment.pace
        self._behind_s = 0.0
        self._last_wall_s = 0.0

    def set_up(self) -> None:
        """Create the vehicles and their links.

        Raises:
            ExperimentError: A parameter is unknown, or a running autopilot does not respond.
        """
        self._logs.mkdir(parents=True, exist_ok=True)
        for setup in self.experiment.setups():
            if setup.entry.connection is not None:
                self._attach_autopilot(setup)
            else:
                self._create_vehicle(setup)
        self.at_end(self._programs.stop_all)
        self._last_wall_s = time.monotonic()

    def tick(self) -> Moment:
        """Advance by 20 ms, in real time unless in lockstep."""
        if not self._pace:
            for _ in range(STEPS_PER_TICK):
                self._simulation.step()
            return Moment(self._simulation.time_s, REPEATABLE_EPOCH_US + round(self._simulation.time_s * 1e6))
        self._hub.poll()
        now_s = time.monotonic()
        self._behind_s = min(self._behind_s + (now_s - self._last_wall_s) * self._pace, MAX_BEHIND_S * self._pace)
        self._last_wall_s = now_s
        while self._behind_s >= CONTROL_STEP_S:
            self._behind_s -= CONTROL_STEP_S
            self._simulation.step()
        self._hub.flush()
        time.sleep(STEPS_PER_TICK * CONTROL_STEP_S / max(self._pace, 1.0))
        return Moment(self._simulation.time_s, time.time_ns() // 1000)

    def begin(self, program: Program | None = None) -> None:
        """Start a program, or all programs."""
        for each in self.experiment.programs if program is None else (program,):
            link = self._program_links[each.name]
            environment = {**os.environ, "PYTHONUNBUFFERED": "1", "FRACTUS_VEHICLE": link, **each.environment}
            self._programs.start(each.name, program_command(each), environment, self.base)

    @property
    def required_flights(self) -> list[str]:
        """Vehicles that programs fly."""
        flown = {p.vehicle for p in self.experiment.programs}
        return [s.name for s in self.experiment.setups() if s.name in flown and not s.entry.task]

    def set_link(self, vehicle: str, *, connected: bool) -> None:
        """Cut or restore the links of the ground station and the programs."""
        self.pilots[vehicle].cut = not connected
        for tap in self._taps.get(vehicle, ()):
            tap.set_link(connected=connected)

    def _create_vehicle(self, setup: VehicleSetup) -> None:
        try:
            craft = Craft(self._vehicle_config(setup))
        except UnknownParameterError as error:
            raise ExperimentError(f"{setup.name}: the autopilot has no parameter {error.args[0]}") from None
        self._simulation.crafts.append(craft)
        self._connect_stations(setup, ChannelLink(craft, "station"), ChannelLink(craft, "observer"))
        if not self._pace:
            return
        self.endpoints[setup.name] = self._open_endpoint(craft)
        for program in self.experiment.programs:
            if program.vehicle == setup.name:
                self._program_links[program.name] = self._insert_tap(
                    setup.name, program.name, self._open_endpoint(craft)
                )

    def _attach_autopilot(self, setup: VehicleSetup) -> None:
        connection = setup.entry.connection or ""
        _, host, port = connection.split(":")
        links = [TcpLink.connect(host, int(port), CONNECT_S) for _ in range(2)]
        self._connect_stations(setup, links[0], links[1])
        self.endpoints[setup.name] = connection
        for program in self.experiment.programs:
            if program.vehicle == setup.name:
                self._program_links[program.name] = connection

    def _connect_stations(self, setup: VehicleSetup, pilot: Link, observer: Link) -> None:
        log = self.keep(TlogWriter(self._logs / f"{setup.name}.tlog"))
        has_program = any(program.vehicle == setup.name for program in self.experiment.programs)
        station = Station(pilot, setup.system_id, log, sends_heartbeats=not has_program)
        self.pilots[setup.name] = self.keep(station)
        self.observe(setup, observer)

    def _open_endpoint(self, craft: Craft) -> str:
        link = f"tcp:127.0.0.1:{free_port()}"
        try:
            self._hub.open(LinkSpec.parse(link), craft, 1)
        except LinkError as error:
            raise ExperimentError(str(error)) from None
        return link

    def _insert_tap(self, vehicle: str, program: str, link: str) -> str:
        port = free_port()
        tap = LinkTap.between(
            port, ("127.0.0.1", int(link.rpartition(":")[2])), self._logs / f"{vehicle}-{program}.tlog"
        )
        self._taps.setdefault(vehicle, []).append(self.keep(tap))
        return f"tcp:127.0.0.1:{port}"

    def _vehicle_config(self, setup: VehicleSetup) -> VehicleConfig:
        home = setup.home
        wind = self.experiment.wind
        entry = setup.entry
        if home is None:
            raise ExperimentError(f"{setup.name} has no start position; set `home`")
        wind_parameters = {"SIM_WIND_SPD": wind.speed, "SIM_WIND_DIR": wind.direction, "SIM_WIND_TURB": wind.turbulence}
        return VehicleConfig(
            start=Place.from_degrees(home.lat, home.lon, home.alt),
            heading_deg=entry.heading,
            sysid=setup.system_id,
            seed=self.experiment.seed,
            ready_after_s=entry.ready_after,
            parameters={**wind_parameters, **entry.parameters},
            epoch_us=time.time_ns() // 1000 if self._pace else REPEATABLE_EPOCH_US,
        )
