"""Vehicle parameters: ArduCopter's names, defaults and types, with changed values."""

from __future__ import annotations

import functools
import math
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from pymavlink.dialects.v20 import ardupilotmega as mavlink

RANGES = {
    "INT8": (-128.0, 127.0),
    "INT16": (-32768.0, 32767.0),
    "INT32": (-2147483648.0, 2147483647.0),
    "REAL32": (-3.4028234e38, 3.4028234e38),
}
WIRE_TYPES = {
    "INT8": mavlink.MAV_PARAM_TYPE_INT8,
    "INT16": mavlink.MAV_PARAM_TYPE_INT16,
    "INT32": mavlink.MAV_PARAM_TYPE_INT32,
    "REAL32": mavlink.MAV_PARAM_TYPE_REAL32,
}
"""MAV_PARAM_TYPE that PARAM_VALUE reports for each type of the table."""
# Names of later ArduCopter releases for the same parameters.
ALIASES = {
    "MAV_GCS_SYSID": "SYSID_MYGCS",
    "MAV_SYSID": "SYSID_THISMAV",
    **{f"SIM_GPS1_GLTCH_{axis}": f"SIM_GPS_GLITCH_{axis}" for axis in "XYZ"},
}
# Item counts and the system id. Unlike on a real autopilot, clients cannot change them.
READ_ONLY = frozenset({"MIS_TOTAL", "FENCE_TOTAL", "RALLY_TOTAL", "SYSID_THISMAV"})
# Tolerance for rounding errors, which is added to a value before its truncation to an integer.
ROUNDING = 0.01


@dataclass(frozen=True, slots=True)
class Parameter:
    """A row of the parameter table: name, default and type."""

    name: str
    default: float
    kind: str

    @property
    def wire_type(self) -> int:
        """MAV_PARAM_TYPE for PARAM_VALUE."""
        return WIRE_TYPES[self.kind]

    def coerce(self, value: float) -> float:
        """Convert a value to this type: limit it to the range and truncate integers.

        Raises:
            ParameterValueError: The value is NaN.
        """
        if math.isnan(value):
            raise ParameterValueError(f"parameter {self.name}: the value must be a number")
        low, high = RANGES[self.kind]
        value = min(max(value, low), high)
        if self.kind == "REAL32":
            rounded: float = struct.unpack("<f", struct.pack("<f", value))[0]
            return rounded
        return float(int(value + math.copysign(ROUNDING, value)))


@functools.cache
def table() -> tuple[Parameter, ...]:
    """Return all parameters in list order."""
    text = resources.files(__package__).joinpath("parameters.txt").read_text(encoding="ascii")
    rows = (line.split() for line in text.splitlines() if line)
    return tuple(Parameter(name, float(default), kind) for name, default, kind in rows)


@functools.cache
def _index() -> dict[str, int]:
    return {parameter.name: at for at, parameter in enumerate(table())}


def canonical(name: str) -> str:
    """Return the name of a parameter in this release. The given name may be in lower case, or the name in a later release."""
    upper = name.upper()
    return ALIASES.get(upper, upper)


class UnknownParameterError(KeyError):
    """A parameter name that this vehicle does not have."""


class ParameterValueError(ValueError):
    """An invalid parameter value, or a parameter file that cannot be read."""


def _stored(path: Path) -> Iterator[tuple[str, float]]:
    """Parse a file of changed parameters.

    A line in any other format is an error. The file may then belong to another program and must not be overwritten.
    """
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except UnicodeDecodeError as error:
        raise ParameterValueError(f"{path}: not a parameter file (expected one NAME,VALUE per line)") from error
    for number, line in enumerate(lines, start=1):
        name, _, text = line.partition(",")
        try:
            yield name, float(text)
        except ValueError as error:
            raise ParameterValueError(f"{path}, line {number}: expected NAME,VALUE") from error


class Parameters(Mapping[str, float]):
    """Current values by name."""

    def __init__(self, overrides: Mapping[str, float] | None = None, store: Path | None = None) -> None:
        self._values = {parameter.name: parameter.coerce(parameter.default) for parameter in table()}
        self._store = store
        self._watchers: list[Callable[[str], None]] = []
        self._erased: set[str] = set()
        if store is not None and store.exists():
            for stored, value in _stored(store):
                if stored in self._values:
                    self._values[stored] = table()[_index()[stored]].coerce(value)
        for name, value in (overrides or {}).items():
            self.assign(name, value)

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def __len__(self) -> int:
        return len(self._values)

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def watch(self, watcher: Callable[[str], None]) -> None:
        """Call `watcher` with the name of each changed parameter."""
        self._watchers.append(watcher)

    def assign(self, name: str, value: float) -> float:
        """Set a parameter, even if it is read-only for clients, and return the stored value.

        Raises:
            UnknownParameterError: The parameter does not exist.
            ParameterValueError: The value is NaN.
        """
        name = canonical(name)
        index = _index().get(name)
        if index is None:
            raise UnknownParameterError(name)
        self._values[name] = table()[index].coerce(value)
        for watcher in self._watchers:
            watcher(name)
        return self._values[name]

    def set(self, name: str, value: float) -> bool:
        """Set a parameter for a client. Return False if it is unknown or read-only, or the value is not finite."""
        name = canonical(name)
        if name not in self._values or name in READ_ONLY or not math.isfinite(value):
            return False
        self.assign(name, value)
        self._erased.discard(name)
        self._save()
        return True

    def erase(self) -> None:
        """Erase the stored changes. Current values stay until the next boot."""
        self._erased = set(self._values) - READ_ONLY
        self._save()

    def changes(self) -> dict[str, float]:
        """Return the parameters that the next boot restores: stored values that differ from their defaults."""
        return {
            row.name: self._values[row.name]
            for row in table()
            if row.name not in self._erased and self._values[row.name] != row.coerce(row.default)
        }

    def find(self, name: str, index: int = -1) -> tuple[str, Parameter, int] | None:
        """Find a parameter by index, or by name if the index is negative.

        Returns:
            Requested name, table row and index, or None.
        """
        if index >= 0:
            if index >= len(table()):
                return None
            row = table()[index]
            return row.name, row, index
        at = _index().get(canonical(name))
        return None if at is None else (name, table()[at], at)

    def _save(self) -> None:
        if self._store is None:
            return
        text = "".join(f"{name},{value:.9g}\n" for name, value in self.changes().items())
        scratch = self._store.with_suffix(".new")
        scratch.write_text(text, encoding="ascii")
        scratch.replace(self._store)
