"""Layout file of a radio: stations, their positions, uplinks, and simple networks."""

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
        """MAC address of the station."""
        return mac_address(self.name)


def mac_address(name: str) -> bytes:
    """Return a locally administered MAC address that is derived from a name."""
    return b"\x02" + hashlib.sha256(name.encode()).digest()[:5]


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


class MemberEntry(_Value):
    """A member of a simple network.

    Attributes:
        name: Name of the node.
        namespace: Network namespace of the node.
        device: Network device in the namespace. If it does not exist, the radio creates it.
        place: Position, or initial position of a moving node. None: the range does not apply to this node.
        vehicle: MAVLink server (`tcp:HOST:PORT`, in the namespace of the radio) of the vehicle that carries the node, if any.
    """

    name: str
    namespace: Path
    device: Annotated[str, Field(max_length=15)]
    place: Place | None = None
    vehicle: str | None = None


class NetworkEntry(_Value):
    """A simple network with the same properties between all its members.

    Attributes:
        name: Name of the network.
        range_m: Maximum distance between members, metres. None: unlimited.
        loss: Share of frames that are lost.
        delay_s: Delay in seconds.
        rate_bps: Bits per second that each member can send.
        members: Members.
    """

    name: str
    range_m: Positive | None = None
    loss: Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)] = 0.0
    delay_s: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    rate_bps: Positive = 1e9
    members: tuple[MemberEntry, ...] = ()


class Layout(_Value):
    """Configuration of a radio.

    Attributes:
        control: Path of the command socket.
        origin: Origin of the metric positions in commands.
        fading: Shape of Nakagami fading. None: no fading, so that no frame arrives beyond the range.
        seed: Random seed of fading and of losses.
    """

    control: Path
    origin: Place = Place(lat=0.0, lon=0.0)
    fading: Positive | None = None
    seed: int = 1
    stations: tuple[StationEntry, ...] = ()
    uplinks: tuple[UplinkEntry, ...] = ()
    networks: tuple[NetworkEntry, ...] = ()
