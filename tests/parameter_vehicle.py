"""Fake autopilot that responds to the parameter protocol as ArduPilot does, over a link that loses random frames."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Collection, Mapping

from fractus_runtime.mavlink_codec import Message, message
from fractus_services.mobility.mavlink.ardupilot import ARDUCOPTER
from fractus_services.mobility.mavlink.mavlink_autopilot import MavlinkAutopilot
from pymavlink.dialects.v20 import ardupilotmega as mavlink

BY_NAME = 65535
"""Parameter index in responses to requests by name, and in reports of a change."""

MOVEMENT = {
    "WPNAV_ACCEL": 250.0, "PSC_POSXY_P": 1.0, "WPNAV_ACCEL_Z": 100.0, "PSC_JERK_XY": 5.0, "RTL_ALT": 1500.0, "RTL_SPEED": 0.0,
    "RTL_CLIMB_MIN": 0.0, "WPNAV_SPEED": 1000.0, "FENCE_ENABLE": 0.0, "FENCE_AUTOENABLE": 0.0, "FENCE_TYPE": 7.0, "FENCE_ALT_MAX": 100.0,
    "FENCE_MARGIN": 2.0, "FENCE_ACTION": 1.0, "FENCE_OPTIONS": 0.0, "ANGLE_MAX": 3000.0, "PSC_ANGLE_MAX": 0.0,
}  # fmt: skip
"""Parameters of the motion of a vehicle, with the names before release 4.7."""

FAILSAFES = {
    "SYSID_MYGCS": 244.0, "FS_GCS_ENABLE": 1.0, "FS_GCS_TIMEOUT": 5.0, "GUID_TIMEOUT": 1.0, "BATT_FS_CRT_ACT": 1.0,
    "BATT_FS_LOW_ACT": 2.0, "FS_EKF_ACTION": 1.0, "SRTL_POINTS": 0.0, "RTL_ALT_TYPE": 0.0, "RTL_ALT_FINAL": 0.0,
    "RALLY_LIMIT_KM": 2.0**-10, "RTL_CONE_SLOPE": 3.0, "GUID_OPTIONS": 0.0, "FS_EKF_THRESH": 0.8,
}  # fmt: skip
"""Failsafe parameters that permit arming, for a vehicle that records no path."""

_SPELT_4_7 = {
    "SYSID_MYGCS": ("MAV_GCS_SYSID", 1.0), "WPNAV_ACCEL": ("WP_ACC", 0.01), "PSC_POSXY_P": ("PSC_NE_POS_P", 1.0),
    "WPNAV_ACCEL_Z": ("WP_ACC_Z", 0.01), "PSC_JERK_XY": ("PSC_NE_JERK", 1.0), "RTL_ALT": ("RTL_ALT_M", 0.01),
    "WPNAV_SPEED": ("WP_SPD", 0.01), "RTL_SPEED": ("RTL_SPEED_MS", 0.01), "RTL_CLIMB_MIN": ("RTL_CLIMB_MIN_M", 0.01),
    "RTL_ALT_FINAL": ("RTL_ALT_FINAL_M", 0.01), "ANGLE_MAX": ("ATC_ANGLE_MAX", 0.01),
}  # fmt: skip
"""Names of ArduCopter 4.7 for parameters of 4.6, with the factor of their values."""


def as_release_4_7(values: Mapping[str, float]) -> dict[str, float]:
    """Return parameters of ArduCopter 4.6 under the names and in the units of 4.7."""
    renamed = {name: _SPELT_4_7.get(name, (name, 1.0)) for name in values}
    return {name: values[old] * factor for old, (name, factor) in renamed.items()} | {"MAV_GCS_SYSID_HI": 0.0}


def parameter_responses(
    values: dict[str, float],
    outgoing: Message,
    fixed: Collection[str] = (),
    hidden: Collection[str] = (),
    *,
    errors: bool = False,
) -> list[Message]:
    """Return the responses of a vehicle to a parameter message.

    Args:
        values: Parameters of the vehicle. PARAM_SET changes them.
        outgoing: Received message.
        fixed: Parameters that cannot be set.
        hidden: Parameters that are missing in the list.
        errors: True to answer with PARAM_ERROR, as ArduCopter does from 4.7 on.
    """
    listed = [name for name in values if name not in hidden]

    def value(name: str, index: int = BY_NAME) -> Message:
        return message(
            "PARAM_VALUE", param_id=name.encode(), param_value=values[name], param_count=len(listed), param_index=index
        )

    if outgoing.name == "PARAM_REQUEST_LIST":
        return [value(name, index) for index, name in enumerate(listed)]
    if outgoing.name not in {"PARAM_REQUEST_READ", "PARAM_SET"}:
        return []
    index = outgoing.values.get("param_index", -1)
    if isinstance(index, int) and index >= 0:
        return [value(listed[index], index)] if index < len(listed) else []
    name = outgoing.text("param_id")
    refusal = message("PARAM_ERROR", param_id=name.encode(), param_index=-1, error=mavlink.MAV_PARAM_ERROR_READ_ONLY)
    if name not in values:
        absent = refusal._replace(values={**refusal.values, "error": mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST})
        return [absent] if errors else []
    if outgoing.name == "PARAM_SET" and name in fixed:
        return [value(name), refusal] if errors else [value(name)]
    if outgoing.name == "PARAM_SET":
        values[name] = outgoing.real("param_value")
    return [value(name)]


class ParameterVehicle(MavlinkAutopilot):
    """Fake autopilot that has only parameters.

    Args:
        values: Parameters of the vehicle.
        fixed: Parameters that cannot be set.
        hidden: Parameters that are missing in the list.
        loss: Share of frames lost in each direction.
        seed: Seed of the lost frames.
        delay_s: Time from a request to its response.
        errors: True to answer with PARAM_ERROR, as ArduCopter does from 4.7 on.
    """

    def __init__(
        self,
        values: Mapping[str, float],
        fixed: Collection[str] = (),
        hidden: Collection[str] = (),
        *,
        loss: float = 0.0,
        seed: int = 0,
        delay_s: float = 0.0,
        errors: bool = False,
    ) -> None:
        super().__init__("tcp:nowhere:1", ARDUCOPTER)
        self.target = (1, 1)
        self.values = dict(values)
        self.fixed = fixed
        self.hidden = hidden
        self.loss = loss
        self.delay_s = delay_s
        self.errors = errors
        self.received_names: list[str] = []
        self._random = random.Random(seed)

    def send(self, outgoing: Message) -> None:
        self.received_names.append(outgoing.name)
        if self._is_lost():
            return
        for response in parameter_responses(self.values, outgoing, self.fixed, self.hidden, errors=self.errors):
            if not self._is_lost():
                asyncio.get_running_loop().call_later(self.delay_s, self.take, response)

    def _is_lost(self) -> bool:
        return self._random.random() < self.loss
