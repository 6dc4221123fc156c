"""Leader election: only the process that holds a Lease acts, so that two processes never act at the same time.

The election of the official client uses the wall clock, allows five minutes for a request, and ends at the first refused
connection. For a moment, two processes can be its leader.
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
from fractus_runtime.kubernetes.objects import Body, Key, Kind, version_of

log = logging.getLogger(__name__)

LEASE = Kind("coordination.k8s.io/v1", "Lease", "leases", namespaced=True)
_RENEWALS = 5
_HELD_SHARE = 0.7
_RETRY_S = 1.0
_RETRIES = 20
_RESPONSE_SHARE = _HELD_SHARE / 2
"""Maximum time of a response, as a share of the duration of the Lease.

After a stalled response, one retry fits before the Lease is lost.
"""


class LostLease(Exception):
    """The Lease was lost. The state in memory may be wrong, so the process must restart.

    Another process has acted since this process last held the Lease, or the API server was restored to an earlier
    state.
    """


class Lease:
    """A Lease of coordination.k8s.io, held by one process at a time.

    Another process takes the Lease only after the Lease did not change for its whole duration, by the clock of that process.
    The holder acts only for a part of the duration, counted from before its request. So the clocks need not agree, and a
    holder that was frozen does not act any more.

    A version of the Lease that decreases shows that the API server was restored to an earlier state. After a restore, watches
    would continue from versions that do not exist yet, and report nothing until the API server reaches these versions.

    Args:
        client: The API server, with separate connections, so that no burst of requests delays a renewal.
        key: Namespace and name of the Lease.
        identity: Identity of this process. A restarted process with the same identity continues to hold the Lease.
        duration_s: Seconds after the last renewal until another process may act.
        time: Monotonic seconds that continue while the process is frozen.
    """

    def __init__(self, client: Client, key: Key, identity: str, duration_s: float, time: Callable[[], float]) -> None:
        self._client = client
        self._namespace, self._name = key
        self._identity = identity
        self._duration_s = duration_s
        self._time = time
        self._until = float("-inf")
        self._last_state: tuple[object, ...] = ()
        self._changed_at_s = 0.0
        self._transitions: int | None = None
        self._version = 0
        self._acquired = asyncio.Event()

    @property
    def left_s(self) -> float:
        """Seconds for which this process may still act. 0 if it does not hold the Lease."""
        return max(self._until - self._time(), 0.0)

    async def held(self) -> None:
        """Wait until this process may act."""
        while not self.left_s:
            self._acquired.clear()
            await self._acquired.wait()

    async def run(self) -> None:
        """Take the Lease and renew it until cancelled. Then release it.

        Raises:
            LostLease: Another process has held the Lease since this process held it, or the API server was restored.
        """
        try:
            while True:
                requested_s = self._time()
                # The pause is so short that there is time for another attempt after a failed renewal.
                pause_s = min(_RETRY_S, self._duration_s / _RETRIES)
                try:
                    async with asyncio.timeout(_RESPONSE_SHARE * self._duration_s):
                        taken = await self._acquire()
                    if taken:
                        self._hold(requested_s)
                    pause_s = self._duration_s / _RENEWALS if taken else min(_RETRY_S, self._duration_s / _RENEWALS)
                except KubeError as error:
                    log.info("lease: not renewed (error=%s)", error)
                except TimeoutError:
                    log.info("lease: not renewed (error=no response in %.1f s)", _RESPONSE_SHARE * self._duration_s)
                await asyncio.sleep(pause_s)
        finally:
            await self._release()

    def _hold(self, requested_s: float) -> None:
        if not self.left_s:
            log.info("lease: became leader (identity=%s)", self._identity)
        self._until = requested_s + _HELD_SHARE * self._duration_s
        self._acquired.set()

    async def _acquire(self) -> bool:
        """Take or renew the Lease, if this process holds it or it is free. Return True on success.

        Raises:
            LostLease: Another process has held the Lease since this process held it, or the API server was restored.
            KubeError: The API server refused the request, or did not respond.
        """
        try:
            body = await self._client.get(LEASE, self._name, self._namespace)
        except NotFound:
            body = LEASE.header(self._name, self._namespace)
        self._check_history(body)
        spec = body.get("spec") or {}
        if self._transitions is not None and spec.get("leaseTransitions") != self._transitions:
            raise LostLease(
                f"{spec.get('holderIdentity') or 'another process'} has acted since {self._identity} last held the Lease"
            )
        if (spec.get("holderIdentity") or "") not in ("", self._identity) and not self._expired(body):
            return False
        renewed = self._renewed(body)
        write = self._client.replace if spec else self._client.create
        try:
            self._version = version_of(await write(LEASE, renewed))
        except Conflict:
            return False
        self._transitions = int(renewed["spec"]["leaseTransitions"])
        return True

    def _check_history(self, body: Body) -> None:
        """Check that the API server was not restored to a state from before the last renewal by this process.

        Raises:
            LostLease: The API server was restored to an earlier state.
        """
        if 0 < version_of(body) < self._version:
            raise LostLease(
                f"the version of the Lease went back from {self._version} to {version_of(body)}, as after a restore of the API"
                f" server: the state of {self._identity} is no longer valid"
            )

    def _expired(self, body: Body) -> bool:
        """Return True if another process holds the Lease and has not renewed it for its duration."""
        spec = body.get("spec") or {}
        now = self._time()
        state = (spec.get("holderIdentity"), spec.get("renewTime"))
        if state != self._last_state:
            if self._last_state[:1] != state[:1]:
                log.info("lease: waiting for the leader to end (leader=%s)", spec.get("holderIdentity"))
            self._last_state = state
            self._changed_at_s = now
        return now - self._changed_at_s > max(self._duration_s, float(spec.get("leaseDurationSeconds") or 0))

    def _renewed(self, body: Body, *, free: bool = False) -> Body:
        now = datetime.now(UTC)
        spec = body.get("spec") or {}
        holds = spec.get("holderIdentity") == self._identity
        renewed = {
            **spec,
            "holderIdentity": "" if free else self._identity,
            "leaseDurationSeconds": max(1, round(timedelta(seconds=self._duration_s).total_seconds())),
            "renewTime": now.strftime("%Y-%m-%dT%H:%M:%S.%fZ"),
        }
        if not holds and not free:
            renewed["acquireTime"] = renewed["renewTime"]
            renewed["leaseTransitions"] = int(spec.get("leaseTransitions") or 0) + 1
        return {**body, "spec": renewed}

    async def _release(self) -> None:
        """Release the Lease, so that the next process can act at once. No write of this process may be in progress.

        The holder is read from the API server, because a renewal without a response may have taken effect.
        """
        self._until = float("-inf")
        try:
            async with asyncio.timeout(2.0):
                body = await self._client.get(LEASE, self._name, self._namespace)
                if (body.get("spec") or {}).get("holderIdentity") == self._identity:
                    await self._client.replace(LEASE, self._renewed(body, free=True))
        except (KubeError, TimeoutError) as error:
            log.info("lease: not released (error=%s)", error)


class LeaseThread:
    """A Lease that is renewed in a separate thread and event loop, so that a busy caller delays no renewal.

    Args:
        connect: Creates the client, in that thread.
        key: Namespace and name of the Lease.
        identity: Identity of this process.
        duration_s: Seconds after the last renewal until another process may act.
        time: Monotonic seconds that continue while the process is frozen.
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
        """Seconds for which this process may still act. 0 if it does not hold the Lease. Thread-safe."""
        return self._lease.left_s if self._lease is not None else 0.0

    async def held(self) -> None:
        """Wait until this process may act for the first time."""
        await self._acquired.wait()

    async def run(self) -> None:
        """Take the Lease and renew it until cancelled. Release it before returning.

        Raises:
            LostLease: Another process has held the Lease since this process held it, or the API server was restored.
            Unconfigured: There are no credentials.
        """
        caller = asyncio.get_running_loop()
        stop = asyncio.Event()
        cancelled = threading.Event()
        loops: list[asyncio.AbstractEventLoop] = []

        async def keep() -> None:
            loops.append(asyncio.get_running_loop())
            if cancelled.is_set():
                return
            async with contextlib.aclosing(await self._connect()) as client:
                self._lease = lease = Lease(client, *self._rest)

                async def report_acquired() -> None:
                    await lease.held()
                    caller.call_soon_threadsafe(self._acquired.set)

                parts = [asyncio.create_task(part) for part in (lease.run(), stop.wait(), report_acquired())]
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
            if loops and not thread.done():
                loops[0].call_soon_threadsafe(stop.set)
            await asyncio.gather(thread, return_exceptions=True)
            raise
