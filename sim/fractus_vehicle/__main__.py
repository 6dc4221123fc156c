"""Command `fractus-vehicle`: run simulated ArduCopters over real links, in real time or faster."""

from __future__ import annotations

import contextlib
import math
import signal
import sys
import time
from pathlib import Path

import click

from fractus_vehicle.earth import Place
from fractus_vehicle.estimator import FULL_START_S
from fractus_vehicle.links import Hub, LinkError, LinkSpec
from fractus_vehicle.lockstep import LockstepServer, run_lockstep
from fractus_vehicle.params import ParameterValueError, UnknownParameterError
from fractus_vehicle.simulation import Simulation, formation
from fractus_vehicle.state import CONTROL_STEP_S, REPEATABLE_EPOCH_US, VehicleConfig

DEFAULT_LISTEN = "tcp:127.0.0.1:5760"
MAX_SYSID = 250
MAX_BATCH = 25
MAX_NAP = 4
MAX_LAG_S = 1.0
MIN_SLEEP_S = 0.001


class _Stop:
    """Signal handler that records a stop request."""

    def __init__(self) -> None:
        self.requested = False

    def __call__(self, *_: object) -> None:
        self.requested = True


def run(simulation: Simulation, hub: Hub, speedup: float, stop: _Stop, until_s: float | None = None) -> None:
    """Keep simulated time at `speedup` times real time (0: as fast as possible) until stopped.

    A wake-up costs more than a step, and clients cannot observe the steps between two messages. The loop therefore
    sleeps until a message is due (at most `MAX_NAP` steps) or arrives, and then runs the missed steps together. A
    received message takes effect in the step in which it arrived. The response is sent in the next step.
    """
    wall_0 = time.monotonic()
    time_0 = simulation.time_s
    woken = False
    nap = 1
    while not stop.requested and (until_s is None or simulation.time_s < until_s):
        if speedup > 0.0:
            behind = time_0 + (time.monotonic() - wall_0) * speedup - simulation.time_s
            steps = min(int(behind / CONTROL_STEP_S + 1e-6), MAX_BATCH)
            if behind > MAX_LAG_S * max(speedup, 1.0):
                wall_0 = time.monotonic()
                time_0 = simulation.time_s
        else:
            steps = 1
        for _ in range(steps - 1):
            simulation.step()
        hub.poll()
        if steps:
            simulation.step()
        if not woken or steps >= nap:
            hub.flush()
        if speedup > 0.0:
            next_step = wall_0 + (simulation.time_s + CONTROL_STEP_S - time_0) / speedup
            now = time.monotonic()
            nap = 1 if woken or now >= next_step or speedup < 1.0 else simulation.quiet_steps(MAX_NAP)
            wake = next_step + (nap - 1) * CONTROL_STEP_S / speedup
            woken = nap > 1 and hub.wait(wake - now)
            ahead = wake - time.monotonic()
            if ahead > 0.0 and not woken:
                time.sleep(ahead if nap > 1 else max(ahead, MIN_SLEEP_S))


def _place(_context: click.Context, _option: click.Parameter, text: str) -> Place:
    try:
        lat, lon, alt = (float(part) for part in text.split(","))
    except ValueError as error:
        raise click.BadParameter("expected LAT,LON,ALT_AMSL") from error
    if not (abs(lat) <= 90.0 and abs(lon) <= 180.0 and abs(alt) < 10_000.0):
        raise click.BadParameter("latitude, longitude or altitude out of range")
    return Place.from_degrees(lat, lon, alt)


def _finite(_context: click.Context, _option: click.Parameter, value: float | None) -> float | None:
    if value is not None and not math.isfinite(value):
        raise click.BadParameter("expected a finite number")
    return value


def _wind(_context: click.Context, _option: click.Parameter, text: str | None) -> dict[str, float]:
    if text is None:
        return {}
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError as error:
        raise click.BadParameter("expected SPEED,DIR[,TURBULENCE]") from error
    if not 1 <= len(numbers) <= 3 or not all(math.isfinite(number) for number in numbers):
        raise click.BadParameter("expected SPEED,DIR[,TURBULENCE]")
    speed, direction, turbulence = [*numbers, 0.0, 0.0][:3]
    if not 0.0 <= speed < 60.0 or not 0.0 <= turbulence < 30.0:
        raise click.BadParameter("wind speed must be in [0, 60) m/s and turbulence in [0, 30) m/s")
    return {"SIM_WIND_SPD": speed, "SIM_WIND_DIR": direction % 360.0, "SIM_WIND_TURB": turbulence}


def _parameters(_context: click.Context, _option: click.Parameter, texts: tuple[str, ...]) -> dict[str, float]:
    values: dict[str, float] = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            values[name.strip()] = float(value)
        except ValueError as error:
            raise click.BadParameter(f"{text!r}: expected NAME=VALUE") from error
    return values


@click.command()
@click.option(
    "--listen",
    "links",
    multiple=True,
    metavar="LINK",
    help="MAVLink connection: tcp:HOST:PORT, udpin:HOST:PORT, udpout:HOST:PORT, serial:DEVICE[:BAUD] or pty:PATH; "
    f"repeatable.  [default: {DEFAULT_LISTEN}]",
)
@click.option(
    "--home",
    callback=_place,
    default="-35.3632621,149.1652374,584.0",
    show_default=True,
    metavar="LAT,LON,ALT_AMSL",
    help="Start position.",
)
@click.option("--heading", "heading_deg", type=float, default=0.0, callback=_finite, help="Start heading, degrees.")
@click.option("--sysid", type=click.IntRange(1, MAX_SYSID), default=1, help="MAVLink system id.")
@click.option(
    "--speedup",
    type=click.FloatRange(0.0),
    default=1.0,
    callback=_finite,
    help="Factor of simulated to real time; 0: as fast as possible.",
)
@click.option("--seed", type=int, default=1, help="Random seed of all noise.")
@click.option(
    "--param",
    "parameters",
    multiple=True,
    callback=_parameters,
    metavar="NAME=VALUE",
    help="Set a parameter; repeatable.",
)
@click.option(
    "--wind",
    callback=_wind,
    metavar="SPEED,DIR[,TURB]",
    help="Wind: speed and turbulence in m/s, direction of origin in degrees.",
)
@click.option(
    "--ready-after",
    type=click.FloatRange(0.1),
    default=FULL_START_S,
    show_default=True,
    callback=_finite,
    help="Seconds until ready to arm. A shorter time speeds up the whole startup sequence.",
)
@click.option(
    "--count", type=click.IntRange(1, 200), default=1, help="Number of vehicles, with consecutive ports and system ids."
)
@click.option(
    "--spacing",
    type=click.FloatRange(-1000.0, 1000.0),
    default=10.0,
    callback=_finite,
    help="Distance between vehicles to the east, metres.",
)
@click.option(
    "--charge",
    type=click.FloatRange(0.0, 6000.0),
    default=0.0,
    show_default=True,
    callback=_finite,
    help="Percent per minute by which the battery charges while the vehicle is disarmed within 20 m of its start position.",
)
@click.option(
    "--throttle",
    type=click.IntRange(900, 2100),
    default=1000,
    show_default=True,
    help="Throttle stick position of the RC transmitter, microseconds; 1500 holds the altitude in LOITER.",
)
@click.option("--store", type=click.Path(path_type=Path), help="File for changed parameters, read at startup.")
@click.option(
    "--tlog",
    type=click.Path(path_type=Path),
    help="Record a tlog of both directions (with --count, one per vehicle: NAME-SYSID).",
)
@click.option(
    "--lockstep",
    metavar="HOST:PORT",
    help="Advance time only on request of a TCP client. Each line of the client contains a number of 10 ms steps; the reply is the total.",
)
@click.option("--duration", type=float, callback=_finite, help="Exit after this many simulated seconds.")
def vehicle(
    *,
    links: tuple[str, ...],
    home: Place,
    heading_deg: float,
    sysid: int,
    speedup: float,
    seed: int,
    parameters: dict[str, float],
    wind: dict[str, float],
    ready_after: float,
    count: int,
    spacing: float,
    charge: float,
    throttle: int,
    store: Path | None,
    tlog: Path | None,
    lockstep: str | None,
    duration: float | None,
) -> None:
    """Simulate ArduCopter-compatible vehicles that speak MAVLink 2."""
    if sysid + count - 1 > MAX_SYSID:
        raise click.ClickException(f"--sysid {sysid} with --count {count}: system ids must not exceed {MAX_SYSID}")
    stop = _Stop()
    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)
    config = VehicleConfig(
        start=home,
        charge_percent_per_min=charge,
        heading_deg=heading_deg,
        sysid=sysid,
        seed=seed,
        ready_after_s=ready_after,
        parameters=parameters | wind,
        store=store,
        throttle_us=throttle,
        epoch_us=REPEATABLE_EPOCH_US if lockstep else int(time.time() * 1e6),
    )
    with contextlib.ExitStack() as stack:
        hub = Hub()
        opened = list[tuple[int, str]]()
        stack.callback(hub.close)
        try:
            simulation = Simulation(formation(config, count, spacing))
            for at, craft in enumerate(simulation.crafts):
                specs = [LinkSpec.parse(text).shifted(at) for text in links or (DEFAULT_LISTEN,)]
                for port, spec in enumerate(specs):
                    hub.open(spec, craft, port)
                opened.append((craft.config.sysid, " ".join(map(str, specs))))
                if tlog is not None:
                    name = tlog if count == 1 else tlog.with_stem(f"{tlog.stem}-{craft.config.sysid}")
                    craft.record(stack.enter_context(name.open("wb")))
            lockstep_server = None if lockstep is None else LockstepServer(hub, *_address(lockstep))
        except (LinkError, ParameterValueError, OSError) as error:
            raise click.ClickException(str(error)) from error
        except UnknownParameterError as error:
            raise click.ClickException(f"unknown parameter {error.args[0]}") from error
        for number, where in opened:
            click.echo(f"vehicle {number} ready for connections on {where}", err=True)
        if lockstep_server is not None:
            run_lockstep(simulation, hub, lockstep_server, lambda: stop.requested)
        else:
            run(simulation, hub, speedup, stop, duration)


def _address(text: str) -> tuple[str, int]:
    host, colon, port = text.rpartition(":")
    if not colon or not port.isdigit() or not 0 < int(port) < 65536:
        raise click.BadParameter(f"--lockstep {text!r}: expected HOST:PORT")
    return host or "127.0.0.1", int(port)


def main() -> None:
    """Entry point of `fractus-vehicle`."""
    vehicle.main(args=sys.argv[1:], prog_name="fractus-vehicle")


if __name__ == "__main__":
    main()
