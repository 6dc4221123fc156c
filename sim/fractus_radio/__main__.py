"""Command `fractus-radio LAYOUT`: carry frames between the nodes of a layout until terminated."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
from pathlib import Path

import click
from fractus_core.geo import LocalFrame
from pydantic import ValidationError

from fractus_radio.follower import Follower, parse_address
from fractus_radio.layout import Layout, NetworkEntry, Place, StationEntry, mac_address
from fractus_radio.medium import Medium, Position, Station
from fractus_radio.propagation import Propagation
from fractus_radio.radio import Radio
from fractus_radio.shared_network import Member, SharedNetwork
from fractus_radio.taps import Tap
from fractus_radio.uplink import Uplink

REAL_TIME_PRIORITY = 10
HIGHEST = -20


class Frame:
    """Local frame in metres (east, north, up) around the origin of a layout."""

    def __init__(self, origin: Place) -> None:
        self._ground = LocalFrame(origin.lat, origin.lon)
        self._alt = origin.alt

    def position(self, lat: float, lon: float, alt: float) -> Position:
        """Convert degrees and metres above mean sea level to the local frame."""
        east, north = self._ground.xy(lat, lon)
        return east, north, alt - self._alt


def make_radio(layout: Layout) -> tuple[Radio, list[Follower]]:
    """Create the radio of a layout with all its devices, and a follower for each vehicle that carries a station.

    Raises:
        OSError: A device cannot be created.
        ValueError: The address of a vehicle is invalid.
    """
    range_m = max((entry.range_m for entry in layout.stations), default=1.0)
    radio = Radio(Medium(Propagation.reaching(range_m, fading=layout.fading), layout.seed), layout.control)
    frame = Frame(layout.origin)
    followers = []
    for entry in layout.stations:
        position = frame.position(entry.place.lat, entry.place.lon, entry.place.alt)
        station = Station(position, entry.address, reach=entry.range_m / range_m)
        radio.add_station(entry.name, Tap(entry.namespace, entry.device, entry.address), station)
        if entry.vehicle is not None:
            followers.append(_follower(entry, entry.vehicle, station, frame))
    for uplink in layout.uplinks:
        near, far = (Tap(end.namespace, end.device, None) for end in (uplink.near, uplink.far))
        up, down = (Uplink(uplink.rate_bps, uplink.delay_s) for _ in range(2))
        radio.add_uplink(uplink.name, (near, far), (up, down))
    for number, network in enumerate(layout.networks):
        followers += _add_network(radio, network, frame, layout.seed + number)
    return radio, followers


def _add_network(radio: Radio, entry: NetworkEntry, frame: Frame, seed: int) -> list[Follower]:
    """Add a simple network, and return the followers of its moving members."""
    network = SharedNetwork(
        range_m=entry.range_m, loss=entry.loss, delay_s=entry.delay_s, rate_bps=entry.rate_bps, seed=seed
    )
    taps = {}
    followers = []
    for each in entry.members:
        place = each.place
        address = mac_address(f"{entry.name} {each.name}")
        member = network.add(
            each.name, address, None if place is None else frame.position(place.lat, place.lon, place.alt)
        )
        taps[each.name] = Tap(each.namespace, each.device, address)
        if each.vehicle is not None:
            followers.append(_member_follower(each.vehicle, member, frame))
    radio.add_network(network, taps)
    return followers


def _member_follower(vehicle: str, member: Member, frame: Frame) -> Follower:
    def moved(lat: float, lon: float, alt: float) -> None:
        member.position = frame.position(lat, lon, alt)

    return Follower(Path("/proc/self/ns/net"), parse_address(vehicle), moved)


def _follower(entry: StationEntry, vehicle: str, station: Station, frame: Frame) -> Follower:
    def moved(lat: float, lon: float, alt: float) -> None:
        station.position = frame.position(lat, lon, alt)

    return Follower(entry.namespace, parse_address(vehicle), moved)


@click.command()
@click.argument("layout", type=click.Path(path_type=Path, dir_okay=False, exists=True))
def radio(layout: Path) -> None:
    """Carry frames between the nodes of a LAYOUT file over the simulated air, uplinks and networks."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    try:
        carrier, followers = make_radio(Layout.model_validate_json(layout.read_bytes()))
    except (ValidationError, ValueError, OSError) as error:
        raise click.ClickException(f"{layout}: {error}") from error
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: sys.exit(0))
    for follower in followers:
        follower.start()
    # Without real-time priority, frames would wait for the CPU of a busy machine longer than for their transmission.
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(REAL_TIME_PRIORITY))
    except OSError:  # the control group may forbid real-time scheduling
        with contextlib.suppress(OSError):
            os.nice(HIGHEST)
    try:
        while True:
            carrier.step()
    finally:
        carrier.close()


def main() -> None:
    """Entry point of `fractus-radio`."""
    radio.main(args=sys.argv[1:], prog_name="fractus-radio")


if __name__ == "__main__":
    main()
