"""Tells of direct links in Events of their Applications: a link is up or ended, traffic takes it or the cloud path."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime

from fractus_core.api.grants import ApplicationReference
from fractus_core.api.names import shortened

from fractus_operator.cluster.kinds import APPLICATION, DIRECT_LINK, Body, Key
from fractus_operator.cluster.store import Reflector, Store
from fractus_operator.reconcile.worklist import Worklist

PERIOD_S = 10.0
"""Seconds between what is told of one link at least: of one that comes and goes, only how it is then, and how often it went."""


@dataclass(frozen=True, slots=True)
class LinkReport:
    """What the agents say of a DirectLink, as far as Events tell of it."""

    application: ApplicationReference
    drone: str
    node: str
    up: bool
    direct: bool
    switches: int
    message: str


def read_report(body: Body) -> LinkReport:
    """The report in a DirectLink."""
    spec, status = body["spec"], body.get("status") or {}
    return LinkReport(
        application=ApplicationReference.model_validate(spec["application"]),
        drone=spec["drone"],
        node=spec["node"],
        up=status.get("phase") == "Up",
        direct=status.get("traffic") == "direct",
        switches=status.get("switches") or 0,
        message=status.get("message") or "",
    )


def news(told: LinkReport, now: LinkReport) -> Iterator[tuple[str, str]]:
    """Reason and sentence of each Event that leads from what was told to how a link is now, in the order of what happened."""
    why = f": {now.message}" if now.message else ""
    often = now.switches - told.switches
    if often > 1:
        why += f" (it has changed {often} times since the last Event)"
    link = [("LinkUp", f"{now.drone} is linked to {now.node}{why}")]
    if not now.up:
        link = [("LinkDown", f"{now.drone} is not linked to {now.node} any more{why}")]
    traffic = [("TrafficDirect", f"calls of {now.drone} take the direct link to {now.node}{why}")]
    if not now.direct:
        traffic = [("TrafficCloud", f"calls of {now.drone} take the cloud path, not the link to {now.node}{why}")]
    link, traffic = (link if now.up != told.up else []), (traffic if now.direct != told.direct else [])
    yield from [*link, *traffic] if now.up else [*traffic, *link]


class LinkEvents:
    """Posts the Events; what an operator finds when it starts was told by the one before.

    Attributes:
        reflector: follows DirectLinks; run it.
        worklist: posts what is due; run it.
    """

    def __init__(self, store: Store, clock: Callable[[], datetime]) -> None:
        self.reflector = Reflector(store, DIRECT_LINK, read_report, self.changed)
        self.worklist = Worklist("link event", self.tell)
        self._store = store
        self._clock = clock
        self._now: dict[Key, LinkReport] = {}
        self._told: dict[Key, tuple[LinkReport, float]] = {}

    def changed(self, key: Key, old: LinkReport | None, new: LinkReport | None) -> None:
        """Take what agents report of a link."""
        if new is None:
            self._now.pop(key, None)
            self._told.pop(key, None)
            return
        self._now[key] = new
        if old is None or old.application != new.application:
            self._told[key] = (new, float("-inf"))
        else:
            self.worklist.add(key)

    async def tell(self, key: Key) -> None:
        """Post what is new of a link, or see to it that it is posted once it is due."""
        now, (told, told_s) = self._now.get(key), self._told.get(key, (None, 0.0))
        if now is None or told is None or (now.up, now.direct) == (told.up, told.direct):
            return
        loop = asyncio.get_running_loop()
        wait_s = told_s + PERIOD_S - loop.time()
        if wait_s > 0:
            loop.call_later(wait_s, self.worklist.add, key)
            return
        self._told[key] = (now, loop.time())
        moment = self._clock()
        namespace, name = now.application.namespace, now.application.name
        for reason, message in news(told, now):
            await self._store.record_event(
                APPLICATION.header(name, namespace, uid=now.application.uid),
                reason=reason,
                message=message,
                warning=False,
                name=shortened(f"{name}.{int(moment.timestamp()):x}.{reason.lower()}.{now.node}", 253),
                now=moment,
            )
