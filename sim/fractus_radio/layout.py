"""Layout file of a radio: stations, their positions, and uplinks."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class _Value(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Place(_Value):
    """A position: degrees (WGS 84) and metres above mean sea level."""

    lat: float
    lon: float
    alt: float = 0.0


class StationEntry(_Value):
    """A station on the air.

    Attributes:
        name: Name of the station in commands.
        namespace: Network namespace of the node, such as /run/netns/NAME.
        device: Name of the network device that the radio creates in the namespace.
        range_m: Radio range in metres.
        place: Position, or initial position of a moving station.
        vehicle: MAVLink server (`tcp:HOST:PORT`, in the namespace) of the vehicle that carries the station, if any.
    """

    name: str
    namespace: Path
    device: Annotated[str, Field(max_length=15)]
    range_m: Positive
    place: Place
    vehicle: str | None = None

    @property
    def address(self) -> bytes:
        """MAC address: locally administered, derived from the name."""
        return b"\x02" + hashlib.sha256(self.name.encode()).digest()[:5]


class EndEntry(_Value):
    """One end of an uplink: a persistent TAP device that already exists."""

    namespace: Path
    device: str


class UplinkEntry(_Value):
    """A mobile uplink. Rate and delay apply to each direction.

    Attributes:
        name: Name of the uplink in commands.
        near: End at the node.
        far: Remote end.
        rate_bps: Bits per second.
        delay_s: Delay in seconds.
    """

    name: str
    near: EndEntry
    far: EndEntry
    rate_bps: Positive
    delay_s: Annotated[float, Field(ge=0, allow_inf_nan=False)]


class Layout(_Value):
    """Configuration of a radio.

    Attributes:
        control: Path of the command socket.
        origin: Origin of the metric positions in commands.
        fading: Shape of Nakagami fading. None: no fading, so that no frame arrives beyond the range.
        seed: Random seed of fading.
    """

    control: Path
    origin: Place = Place(lat=0.0, lon=0.0)
    fading: Positive | None = None
    seed: int = 1
    stations: tuple[StationEntry, ...] = ()
    uplinks: tuple[UplinkEntry, ...] = ()
