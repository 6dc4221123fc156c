"""Parameters as a program sees them: one list with consecutive indices. Only WPNAV_SPEED and RTL_ALT may be written."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from fractus_runtime.mavlink_codec import Message, Value
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.gateway.translate import Request, Untranslatable, set_speed

SPEED_PARAMETER = "WPNAV_SPEED"
"""Horizontal speed of legs in cm/s. A write sets the speed of the mobility service."""

RETURN_ALTITUDE_PARAMETER = "RTL_ALT"
"""Altitude of return flights above home in cm. A write applies to the returns that the program requests."""

MAX_RETURN_ALTITUDE_CM = 100_000.0

DEFAULT_SPEED_CMS = 1000.0
"""Value of WPNAV_SPEED until the vehicle has reported it."""


@dataclass(slots=True)
class ParameterView:
    """Parameters of one instance.

    Attributes:
        values: Values by name, in the order of the indices that the program sees.
        loaded: True if the vehicle's parameters are known. Until then, a request for the list waits, because programs
            rely on the number of parameters in the first PARAM_VALUE.
        return_altitude_m: Written altitude of return flights above home; None if the program has written none.
    """

    values: dict[str, float] = field(default_factory=lambda: {SPEED_PARAMETER: DEFAULT_SPEED_CMS})
    loaded: bool = False
    return_altitude_m: float | None = None

    def replace(self, values: Mapping[str, float]) -> None:
        """Set the vehicle's parameters."""
        self.values = {SPEED_PARAMETER: DEFAULT_SPEED_CMS, **dict(sorted(values.items()))}
        if self.return_altitude_m is not None:
            self.values[RETURN_ALTITUDE_PARAMETER] = self.return_altitude_m * 100.0
        self.loaded = True

    def find(self, message: Message) -> int | None:
        """Return the index of the parameter that PARAM_REQUEST_READ or PARAM_SET selects; None if there is none."""
        index = message.integer("param_index") if message.has("param_index") else -1
        names = list(self.values)
        if index >= 0:
            return index if index < len(names) else None
        name = message.text("param_id")
        return names.index(name) if name in self.values else None

    def report(self, index: int) -> Mapping[str, Value]:
        """Return the fields of PARAM_VALUE for an index."""
        name, value = list(self.values.items())[index]
        return {
            "param_id": name.encode(),
            "param_value": value,
            "param_type": mavlink.MAV_PARAM_TYPE_REAL32,
            "param_count": len(self.values),
            "param_index": index,
        }

    def write(self, name: str, value: float) -> Request | None:
        """Return the call for a write; None if no call is necessary.

        Raises:
            Untranslatable: The parameter must not be written, or the value is invalid.
        """
        present = self.values.get(name)
        if present is not None and math.isclose(present, value, rel_tol=1e-6):
            return None
        if name == RETURN_ALTITUDE_PARAMETER:
            if not 0.0 <= value <= MAX_RETURN_ALTITUDE_CM:
                raise Untranslatable(f"{name} must be 0 to {MAX_RETURN_ALTITUDE_CM:.0f} cm, not {value:g}")
            self.return_altitude_m = value / 100.0
            self.values[name] = value
            return None
        if name != SPEED_PARAMETER:
            names = f"{SPEED_PARAMETER} and {RETURN_ALTITUDE_PARAMETER}"
            raise Untranslatable(f"{name} may not be written by a program; only {names} may")
        return set_speed(value / 100.0)
