"""Events of Applications about their direct links: the link is up or down, and which path the traffic takes."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime

from fractus_core.api.grants import ApplicationReference
from fractus_core.api.names import shortened

from fractus_operator.kinds import APPLICATION, DIRECT_LINK, Body, Key
from fractus_operator.store import Informer, Store
from fractus_operator.work_queue import WorkQueue

LINK_EVENT_PERIOD_S = 10.0
"""Minimum time between two reports of one link by Events, in seconds.

If the link changes more often, the next Events contain its current state and the number of changes.
"""


@dataclass(frozen=True, slots=True)
class LinkReport:
    """The part of the reported state of a DirectLink on which Events depend."""

    application: ApplicationReference
    drone: str
    node: str
    up: bool
    direct: bool
    switches: int
    message: str


def parse_link_report(body: Body) -> LinkReport:
    """Parse the reported state of a DirectLink."""
    spec = body["spec"]
    status = body.get("status") or {}
    return LinkReport(
        application=ApplicationReference.model_validate(spec["application"]),
        drone=spec["drone"],
        node=spec["node"],
        up=status.get("phase") == "Up",
        direct=status.get("traffic") == "direct",
        switches=status.get("switches") or 0,
        message=status.get("message") or "",
    )


def link_changes(posted: LinkReport, current: LinkReport) -> Iterator[tuple[str, str]]:
    """Return reason and message of each Event for the changes since the last Events, in their order.

    Args:
        posted: State of the link at the last Events.
        current: Current state of the link.
    """
    details = f": {current.message}" if current.message else ""
    changes = current.switches - posted.switches
    if changes > 1:
        details += f" (changed {changes} times since the last Event)"
    events = []
    if current.up != posted.up:
        if current.up:
            events.append(("LinkUp", f"{current.drone} is linked to {current.node}{details}"))
        else:
            events.append(("LinkDown", f"{current.drone} is no longer linked to {current.node}{details}"))
    if current.direct != posted.direct:
        if current.direct:
            events.append(
                ("TrafficDirect", f"calls of {current.drone} take the direct link to {current.node}{details}")
            )
        else:
            message = f"calls of {current.drone} take the cloud path instead of the link to {current.node}{details}"
            events.append(("TrafficCloud", message))
    # Traffic leaves a link before the link goes down.
    yield from events if current.up else reversed(events)


class LinkEventRecorder:
    """Creates the Events. The state at the start of the operator has no Event, because the previous operator posted it.

    Attributes:
        informer: Informer of DirectLinks. The caller runs it.
        work_queue: Queue of links with pending Events. The caller runs it.
    """

    def __init__(self, store: Store, clock: Callable[[], datetime]) -> None:
        self.informer = Informer(store, DIRECT_LINK, parse_link_report, self.changed)
        self.work_queue = WorkQueue("link event", self.reconcile)
        self._store = store
        self._clock = clock
        self._current: dict[Key, LinkReport] = {}
        self._posted: dict[Key, tuple[LinkReport, float]] = {}

    def changed(self, key: Key, old: LinkReport | None, new: LinkReport | None) -> None:
        """Handle a change of a link."""
        if new is None:
            self._current.pop(key, None)
            self._posted.pop(key, None)
            return
        self._current[key] = new
        if old is None or old.application != new.application:
            self._posted[key] = (new, float("-inf"))
        else:
            self.work_queue.add(key)

    async def reconcile(self, key: Key) -> None:
        """Create the pending Events of a link, or schedule them for the end of the minimum time."""
        current = self._current.get(key)
        posted, posted_s = self._posted.get(key, (None, 0.0))
        if current is None or posted is None or (current.up, current.direct) == (posted.up, posted.direct):
            return
        loop = asyncio.get_running_loop()
        wait_s = posted_s + LINK_EVENT_PERIOD_S - loop.time()
        if wait_s > 0:
            loop.call_later(wait_s, self.work_queue.add, key)
            return
        self._posted[key] = (current, loop.time())
        now = self._clock()
        namespace = current.application.namespace
        name = current.application.name
        for reason, message in link_changes(posted, current):
            await self._store.create_event(
                APPLICATION.header(name, namespace, uid=current.application.uid),
                reason=reason,
                message=message,
                warning=False,
                name=shortened(f"{name}.{int(now.timestamp()):x}.{reason.lower()}.{current.node}", 253),
                now=now,
            )
