"""A vehicle's parameters as ArduPilot tells them, over a link that loses frames by chance in both directions."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Collection, Mapping

from fractus_runtime.mavlink_codec import Message, message
from fractus_services.mobility.mavlink.ardupilot import ARDUCOPTER
from fractus_services.mobility.mavlink.mavlink_autopilot import MavlinkAutopilot

BY_NAME = 65535
"""The index in answers to names, and in the news of a change."""

MOVEMENT = {
    "WPNAV_ACCEL": 250.0, "PSC_POSXY_P": 1.0, "WPNAV_ACCEL_Z": 100.0, "PSC_JERK_XY": 5.0, "RTL_ALT": 1500.0, "RTL_SPEED": 0.0,
    "RTL_CLIMB_MIN": 0.0, "WPNAV_SPEED": 1000.0, "FENCE_ENABLE": 0.0, "FENCE_AUTOENABLE": 0.0, "FENCE_TYPE": 7.0, "FENCE_ALT_MAX": 100.0,
    "FENCE_MARGIN": 2.0, "FENCE_ACTION": 1.0, "FENCE_OPTIONS": 0.0, "ANGLE_MAX": 3000.0, "PSC_ANGLE_MAX": 0.0,
}  # fmt: skip
"""What tells how a vehicle moves, as releases before 4.7 spell it."""

FAILSAFES = {
    "SYSID_MYGCS": 244.0, "FS_GCS_ENABLE": 1.0, "FS_GCS_TIMEOUT": 5.0, "GUID_TIMEOUT": 1.0, "BATT_FS_CRT_ACT": 1.0,
    "BATT_FS_LOW_ACT": 2.0, "FS_EKF_ACTION": 1.0, "SRTL_POINTS": 0.0, "RTL_ALT_TYPE": 0.0, "RTL_ALT_FINAL": 0.0,
    "RALLY_LIMIT_KM": 2.0**-10, "RTL_CONE_SLOPE": 3.0, "GUID_OPTIONS": 0.0, "FS_EKF_THRESH": 0.8,
}  # fmt: skip
"""Failsafes that hold, of a vehicle that does not remember its path."""


def told(
    values: dict[str, float], outgoing: Message, fixed: Collection[str] = (), hidden: Collection[str] = ()
) -> list[Message]:
    """What a vehicle answers to a question about its parameters.

    Args:
        values: its parameters; changed by PARAM_SET.
        outgoing: the question.
        fixed: those that it does not let anyone set.
        hidden: those that it leaves out of its list.
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
    if name in values and name not in fixed and outgoing.name == "PARAM_SET":
        values[name] = outgoing.real("param_value")
    return [value(name)] if name in values else []


class ParameterVehicle(MavlinkAutopilot):
    """An autopilot that only has parameters.

    Args:
        values: its parameters.
        fixed: those that cannot be set.
        hidden: those that are not in its list.
        loss: share of the frames that are lost each way.
        seed: of what is lost.
        delay_s: from the question to the answer.
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
    ) -> None:
        super().__init__("tcp:nowhere:1", ARDUCOPTER)
        self.target = (1, 1)
        self.values = dict(values)
        self.fixed = fixed
        self.hidden = hidden
        self.loss = loss
        self.delay_s = delay_s
        self.asked: list[str] = []
        self._random = random.Random(seed)

    def send(self, outgoing: Message) -> None:
        self.asked.append(outgoing.name)
        if self._lose():
            return
        for answer in told(self.values, outgoing, self.fixed, self.hidden):
            if not self._lose():
                asyncio.get_running_loop().call_later(self.delay_s, self.take, answer)

    def _lose(self) -> bool:
        return self._random.random() < self.loss
