"""Matching of acknowledgements to commands: COMMAND_ACK contains the command id only, not which transmission it answers."""

from __future__ import annotations

import asyncio
import logging
import math
from collections import deque

from fractus_runtime.mavlink_codec import Message
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.mobility.mavlink.timing import Timing

log = logging.getLogger(__name__)

ACK_TIMEOUT_S = 0.7
MAX_ACK_TIMEOUT_S = 3.0
SLACK_S = 0.2
"""An acknowledgement may be slower than the slowest recent answer by this time."""

MAX_OPEN = 16
"""Remembered transmissions of one command, so that a vehicle without acknowledgements cannot fill the memory."""

Answer = asyncio.Future[int]


class Acknowledgements:
    """Transmissions that are not acknowledged yet, by command.

    A command that was sent twice is acknowledged twice, and the second acknowledgement must not count for the next command with the
    same id. Links preserve the order, so each acknowledgement is assigned to the oldest transmission that can still be answered
    according to the measured delay of the link.

    Args:
        sysid: System id of the sender of the commands. Acknowledgements for other systems are ignored.
        timing: Delays of the link; receives the delay of each acknowledgement.
    """

    def __init__(self, sysid: int, timing: Timing) -> None:
        self._sysid = sysid
        self._timing = timing
        self._sent: dict[int, deque[tuple[float, Answer]]] = {}
        self._latest: dict[int, Answer] = {}
        self._last: tuple[bytes, float] = b"", -math.inf

    @property
    def timeout_s(self) -> float:
        """Time after which a transmission counts as lost."""
        return max(ACK_TIMEOUT_S, min(self._timing.answer_s + SLACK_S, MAX_ACK_TIMEOUT_S))

    def _answerable_s(self, now: float) -> float:
        """Return for how long a transmission can still be answered.

        A short time without answers means that the link is becoming slow. After a longer time the link was interrupted, and what was
        sent is lost.
        """
        takes_s = max(self._timing.answer_s, min(self._timing.silence_s(now), MAX_ACK_TIMEOUT_S))
        return max(ACK_TIMEOUT_S, takes_s + SLACK_S)

    def sent(self, command: int, answer: Answer, now: float) -> None:
        """Record that a command is being sent, for the first time or again.

        Args:
            command: MAV_CMD.
            answer: Future that receives the result of this or another transmission of the same command.
            now: Monotonic seconds.
        """
        self._sent.setdefault(command, deque(maxlen=MAX_OPEN)).append((now, answer))
        self._latest[command] = answer

    def overtaken(self, command: int, answer: Answer) -> bool:
        """Return True if another command with the same id was sent after the command of this answer."""
        return self._latest.get(command, answer) is not answer

    def take(self, acknowledgement: Message, now: float) -> None:
        """Assign an acknowledgement to its transmission and set the result."""
        if acknowledgement.integer("target_system") not in {0, self._sysid} or self._is_duplicate(acknowledgement, now):
            return
        command = acknowledgement.integer("command")
        result = acknowledgement.integer("result")
        transmissions = self._sent.setdefault(command, deque(maxlen=MAX_OPEN))
        # Keep the last transmission: when the link becomes slow, its answer arrives before the new delay is measured.
        while len(transmissions) > 1 and now - transmissions[0][0] > self._answerable_s(now):
            transmissions.popleft()
        if not transmissions:
            log.debug("commands: unexpected acknowledgement (command=%d, result=%d)", command, result)
            return
        sent_at, answer = transmissions.popleft()
        # The acknowledgement of an abandoned command measures the link as well.
        self._timing.acknowledged(sent_at, now)
        if result == mavlink.MAV_RESULT_IN_PROGRESS:
            transmissions.appendleft((now, answer))  # the final acknowledgement follows
        elif answer.done():
            log.debug("commands: acknowledgement of an earlier transmission (command=%d, result=%d)", command, result)
        else:
            answer.set_result(result)

    def _is_duplicate(self, acknowledgement: Message, now: float) -> bool:
        """Return True if the network delivered the last acknowledgement again. Frames contain sequence numbers."""
        frame, at = self._last
        self._last = acknowledgement.frame, now
        return frame != b"" and frame == acknowledgement.frame and now - at < ACK_TIMEOUT_S

    def forget(self) -> None:
        """Drop all transmissions, because the connection broke."""
        self._sent.clear()
