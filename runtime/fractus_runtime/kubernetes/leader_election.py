"""Leader election: only the process that holds a Lease acts, so that two that overlap for a moment never both do.

The official client's election goes by the wall clock, gives a request five minutes, and ends with the first refused connection;
this one never lets two act at once.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
from collections.abc import Awaitable, Callable
from datetime import UTC, datetime, timedelta

from fractus_runtime.kubernetes.client import Client
from fractus_runtime.kubernetes.errors import Conflict, KubeError, NotFound
from fractus_runtime.kubernetes.objects import Body, Key, Kind

logger = logging.getLogger(__name__)

LEASE = Kind("coordination.k8s.io/v1", "Lease", "leases", namespaced=True)
_RENEWALS = 5
_HELD_SHARE = 0.7
_RETRY_S = 1.0
_RETRIES = 20
_ANSWER_SHARE = _HELD_SHARE / 2
"""How much of the duration an answer may take: one that stalls leaves time to ask again before the Lease is lost."""


class LostLease(Exception):
    """What this operator remembers may be wrong, and it must start again.

    Another one has acted since it last did, or the API server has gone back to an earlier state, as of a backup.
    """


class Lease:
    """A Lease of coordination.k8s.io, held by one operator at a time.

    Another operator takes it only after it has seen it unchanged for its whole duration, by its own clock; the holder counts
    as such for a part of that, from before it asked. So clocks need not agree, and a holder that was frozen knows better.

    The Lease is also what tells that the API server has gone back: its version, as that of every object, only grows. Watches would
    go on from versions that are yet to come, and tell of nothing until then.

    Args:
        client: The API server, through connections of its own: no burst of other requests keeps a renewal waiting.
        key: Namespace and name of the Lease.
        identity: Who asks; a process that is started again under the same identity goes on where it was.
        duration_s: How long no other process may act after the holder was last heard of.
        time: Monotonic seconds, which go on while the process is frozen.
    """

    def __init__(self, client: Client, key: Key, identity: str, duration_s: float, time: Callable[[], float]) -> None:
        self._client = client
        self._namespace, self._name = key
        self._identity = identity
        self._duration_s = duration_s
        self._time = time
        self._until = float("-inf")
        self._seen: tuple[object, ...] = ()
        self._seen_at = 0.0
        self._transitions: int | None = None
        self._version = 0
        self._acquired = asyncio.Event()

    @property
    def left_s(self) -> float:
        """Seconds for which this operator may still act; none where it does not hold the Lease."""
        return max(self._until - self._time(), 0.0)

    async def held(self) -> None:
        """Wait until this operator may act."""
        while not self.left_s:
            self._acquired.clear()
            await self._acquired.wait()

    async def run(self) -> None:
        """Take the Lease and keep it, until cancelled; it is given back then.

        Raises:
            LostLease: another operator has held it since, or it is one of an earlier time.
        """
        try:
            while True:
                asked = self._time()
                # After a renewal that came to nothing, whether it stalled or was refused, there is time for one more.
                pause_s = min(_RETRY_S, self._duration_s / _RETRIES)
                try:
                    async with asyncio.timeout(_ANSWER_SHARE * self._duration_s):
                        taken = await self._ask()
                    if taken:
                        self._hold(asked)
                    pause_s = self._duration_s / _RENEWALS if taken else min(_RETRY_S, self._duration_s / _RENEWALS)
                except KubeError as error:
                    logger.info("lease: not renewed: %s", error)
                except TimeoutError:
                    logger.info("lease: not renewed: no answer in %.1f s", _ANSWER_SHARE * self._duration_s)
                await asyncio.sleep(pause_s)
        finally:
            await self._give_back()

    def _hold(self, asked: float) -> None:
        if not self.left_s:
            logger.info("lease: became leader (identity=%s)", self._identity)
        self._until = asked + _HELD_SHARE * self._duration_s
        self._acquired.set()

    async def _ask(self) -> bool:
        """Take or renew the Lease, if it is ours or free.

        Raises:
            LostLease: another operator has held it since, or it is one of an earlier time.
            KubeError: the API server did not take it.
        """
        try:
            body = await self._client.get(LEASE, self._name, self._namespace)
        except NotFound:
            body = LEASE.header(self._name, self._namespace)
        self._check_history(body)
        spec = body.get("spec") or {}
        if self._transitions is not None and spec.get("leaseTransitions") != self._transitions:
            raise LostLease(
                f"{spec.get('holderIdentity') or 'another operator'} has acted since {self._identity} last did"
            )
        if (spec.get("holderIdentity") or "") not in ("", self._identity) and not self._expired(body):
            return False
        wanted = self._wanted(body)
        write = self._client.replace if spec else self._client.create
        try:
            self._version = _version(await write(LEASE, wanted))
        except Conflict:
            return False
        self._transitions = int(wanted["spec"]["leaseTransitions"])
        return True

    def _check_history(self, body: Body) -> None:
        """Check that a Lease which this operator has held is not one of an earlier time.

        Raises:
            LostLease: it is.
        """
        if 0 < _version(body) < self._version:
            raise LostLease(
                f"the API server has gone back to version {_version(body)} of the Lease from {self._version}, as after a"
                f" restore: what {self._identity} knows is of another history"
            )

    def _expired(self, body: Body) -> bool:
        """Whether a Lease of another process has not changed for its duration, as far as this process has seen."""
        spec = body.get("spec") or {}
        now, state = self._time(), (spec.get("holderIdentity"), spec.get("renewTime"))
        if state != self._seen:
            if self._seen[:1] != state[:1]:
                logger.info("lease: waiting for the leader to end (leader=%s)", spec.get("holderIdentity"))
            self._seen, self._seen_at = state, now
        return now - self._seen_at > max(self._duration_s, float(spec.get("leaseDurationSeconds") or 0))

    def _wanted(self, body: Body, *, free: bool = False) -> Body:
        now = datetime.now(UTC)
        spec = body.get("spec") or {}
        ours = spec.get("holderIdentity") == self._identity
        wanted = {
            **spec,
            "holderIdentity": "" if free else self._identity,
            "leaseDurationSeconds": max(1, round(timedelta(seconds=self._duration_s).total_seconds())),
            "renewTime": now.strftime("%Y-%m-%dT%H:%M:%S.%fZ"),
        }
        if not ours and not free:
            wanted["acquireTime"] = wanted["renewTime"]
            wanted["leaseTransitions"] = int(spec.get("leaseTransitions") or 0) + 1
        return {**body, "spec": wanted}

    async def _give_back(self) -> None:
        """Let the next one begin at once; called when nothing of ours is under way any more.

        Whose Lease it is the API server tells: it may have taken a renewal whose answer never came.
        """
        self._until = float("-inf")
        try:
            async with asyncio.timeout(2.0):
                body = await self._client.get(LEASE, self._name, self._namespace)
                if (body.get("spec") or {}).get("holderIdentity") == self._identity:
                    await self._client.replace(LEASE, self._wanted(body, free=True))
        except (KubeError, TimeoutError) as error:
            logger.info("lease: not released: %s", error)


def _version(body: Body) -> int:
    """The version of an object as a number, which grows; 0 where it is none."""
    version = str(body["metadata"].get("resourceVersion", ""))
    return int(version) if version.isdecimal() else 0


class LeaseThread:
    """A Lease that is kept in a thread with an event loop of its own: what keeps the caller's loop busy delays no renewal.

    Args:
        connect: Makes the client, in that thread.
        key: Namespace and name of the Lease.
        identity: Who asks.
        duration_s: How long no other process may act after the holder was last heard of.
        time: Monotonic seconds, which go on while the process is frozen.
    """

    def __init__(
        self,
        connect: Callable[[], Awaitable[Client]],
        key: Key,
        identity: str,
        duration_s: float,
        time: Callable[[], float],
    ) -> None:
        self._connect = connect
        self._rest = (key, identity, duration_s, time)
        self._lease: Lease | None = None
        self._acquired = asyncio.Event()

    @property
    def left_s(self) -> float:
        """Seconds for which this process may still act; none where it does not hold the Lease. Any thread may ask."""
        return self._lease.left_s if self._lease is not None else 0.0

    async def held(self) -> None:
        """Wait until this process may act for the first time."""
        await self._acquired.wait()

    async def run(self) -> None:
        """Take the Lease and keep it, until cancelled; it is given back then, before this returns.

        Raises:
            LostLease: another process has held it since, or it is one of an earlier time.
            Unconfigured: there are no credentials.
        """
        caller, stop, cancelled = asyncio.get_running_loop(), asyncio.Event(), threading.Event()
        inside: list[asyncio.AbstractEventLoop] = []

        async def keep() -> None:
            inside.append(asyncio.get_running_loop())
            if cancelled.is_set():
                return
            async with contextlib.aclosing(await self._connect()) as client:
                self._lease = lease = Lease(client, *self._rest)

                async def tell() -> None:
                    await lease.held()
                    caller.call_soon_threadsafe(self._acquired.set)

                parts = [asyncio.create_task(part) for part in (lease.run(), stop.wait(), tell())]
                try:
                    await asyncio.wait(parts[:2], return_when=asyncio.FIRST_COMPLETED)
                    if not stop.is_set():
                        parts[0].result()
                finally:
                    for part in parts:
                        part.cancel()
                    await asyncio.gather(*parts, return_exceptions=True)

        thread = asyncio.ensure_future(asyncio.to_thread(asyncio.run, keep()))
        try:
            await asyncio.shield(thread)
        except asyncio.CancelledError:
            cancelled.set()
            if inside and not thread.done():
                inside[0].call_soon_threadsafe(stop.set)
            await asyncio.gather(thread, return_exceptions=True)
            raise
