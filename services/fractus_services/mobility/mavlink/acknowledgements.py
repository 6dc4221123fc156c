"""Which sending of a command an acknowledgement answers: COMMAND_ACK names the command alone."""

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
"""How much later than the slowest answer of late an acknowledgement may come."""

MAX_OPEN = 16
"""Sendings of one command that are remembered: a vehicle that acknowledges none must not fill the memory."""

Answer = asyncio.Future[int]


class Acknowledgements:
    """Sendings that are not acknowledged yet, by command.

    A command that was sent twice is acknowledged twice, and the second answer is not that of the next command of its kind. Links
    keep the order, so each answer goes to the oldest sending that can still be answered by the measured delay of the link.

    Args:
        sysid: the system that commands; others get their own answers.
        timing: how long answers take; is told how long these did.
    """

    def __init__(self, sysid: int, timing: Timing) -> None:
        self._sysid = sysid
        self._timing = timing
        self._sent: dict[int, deque[tuple[float, Answer]]] = {}
        self._latest: dict[int, Answer] = {}
        self._last: tuple[bytes, float] = b"", -math.inf

    @property
    def timeout_s(self) -> float:
        """After what time a sending is taken for lost."""
        return max(ACK_TIMEOUT_S, min(self._timing.answer_s + SLACK_S, MAX_ACK_TIMEOUT_S))

    def _answerable_s(self, now: float) -> float:
        """For what time a sending can be answered.

        Where no answer came for some time, the link gets slow just now; after a longer time it was cut, and what was sent is lost.
        """
        takes_s = max(self._timing.answer_s, min(self._timing.silence_s(now), MAX_ACK_TIMEOUT_S))
        return max(ACK_TIMEOUT_S, takes_s + SLACK_S)

    def sent(self, command: int, answer: Answer, now: float) -> None:
        """A command is sent, for the first time or again.

        Args:
            command: which.
            answer: gets the result, of this sending or another one of the same command.
            now: monotonic seconds.
        """
        self._sent.setdefault(command, deque(maxlen=MAX_OPEN)).append((now, answer))
        self._latest[command] = answer

    def overtaken(self, command: int, answer: Answer) -> bool:
        """Whether another command of the kind was sent after the one that this answer is for."""
        return self._latest.get(command, answer) is not answer

    def take(self, acknowledgement: Message, now: float) -> None:
        """Hand the result on to those that wait for it."""
        if acknowledgement.integer("target_system") not in {0, self._sysid} or self._doubled(acknowledgement, now):
            return
        command, result = acknowledgement.integer("command"), acknowledgement.integer("result")
        sendings = self._sent.setdefault(command, deque(maxlen=MAX_OPEN))
        # The last one is kept: when the link gets slow, its answer comes before the delay is measured.
        while len(sendings) > 1 and now - sendings[0][0] > self._answerable_s(now):
            sendings.popleft()
        if not sendings:
            log.debug("commands: an acknowledgement that answers nothing (command=%d, result=%d)", command, result)
            return
        sent_at, answer = sendings.popleft()
        # That of a command which was given up measures the link as well.
        self._timing.acknowledged(sent_at, now)
        if result == mavlink.MAV_RESULT_IN_PROGRESS:
            sendings.appendleft((now, answer))  # the final answer is still to come
        elif answer.done():
            log.debug("commands: an acknowledgement of an earlier sending (command=%d, result=%d)", command, result)
        else:
            answer.set_result(result)

    def _doubled(self, acknowledgement: Message, now: float) -> bool:
        """Whether a network delivers the frame of the last acknowledgement once more: frames are numbered."""
        (frame, at), self._last = self._last, (acknowledgement.frame, now)
        return frame != b"" and frame == acknowledgement.frame and now - at < ACK_TIMEOUT_S

    def forget(self) -> None:
        """The link broke: what was sent on it is not answered any more."""
        self._sent.clear()
