"""The file that describes a radio: who is on the air where, and which uplinks there are."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class _Value(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Place(_Value):
    """A point: degrees (WGS 84), and metres above mean sea level."""

    lat: float
    lon: float
    alt: float = 0.0


class StationEntry(_Value):
    """A node on the air.

    Attributes:
        name: By which commands name it.
        namespace: Its network namespace, such as /run/netns/NAME.
        device: Name of its device there, which the radio makes.
        range_m: How far it reaches.
        place: Where it stands, or stands first.
        vehicle: MAVLink server in its namespace, `tcp:HOST:PORT`, of the vehicle that carries it; None for none.
    """

    name: str
    namespace: Path
    device: Annotated[str, Field(max_length=15)]
    range_m: Positive
    place: Place
    vehicle: str | None = None

    @property
    def address(self) -> bytes:
        """Its MAC address: a locally administered one that follows from its name."""
        return b"\x02" + hashlib.sha256(self.name.encode()).digest()[:5]


class EndEntry(_Value):
    """A persistent TAP device that is there already: an end of an uplink."""

    namespace: Path
    device: str


class UplinkEntry(_Value):
    """A mobile uplink; rate and delay hold each way.

    Attributes:
        name: By which commands name it.
        near: The node's end.
        far: The other end.
        rate_bps: Bits a second.
        delay_s: Seconds.
    """

    name: str
    near: EndEntry
    far: EndEntry
    rate_bps: Positive
    delay_s: Annotated[float, Field(ge=0, allow_inf_nan=False)]


class Layout(_Value):
    """A radio.

    Attributes:
        control: Path of the socket for commands.
        origin: Of the metres in which commands give positions.
        fading: Shape of Nakagami fading; None for a hard edge.
        seed: Of fading.
    """

    control: Path
    origin: Place = Place(lat=0.0, lon=0.0)
    fading: Positive | None = None
    seed: int = 1
    stations: tuple[StationEntry, ...] = ()
    uplinks: tuple[UplinkEntry, ...] = ()
