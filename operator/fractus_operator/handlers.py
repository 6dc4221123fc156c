"""The kopf handlers: an Application's life from its first sight to its finalizer."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import os
from collections.abc import Callable
from typing import Any, Protocol, cast

import kopf

from fractus_operator.cluster.kinds import APPLICATION, Key
from fractus_operator.cluster.labels import FINALIZER
from fractus_operator.cluster.store import KubeError

_RETRY_S = 5.0


class Service(Protocol):
    """The service behind the handlers."""

    async def follow(self, key: Key, stopped: Callable[[], bool]) -> None:
        """Keep an application where its spec wants it, until it is deleted or this is stopped."""

    async def teardown(self, key: Key, uid: str) -> None:
        """Take an application down before its object is removed."""


async def operator(
    applications: Service, silence_s: Callable[[], float], health: str, stop: asyncio.Event | None
) -> None:
    """Run kopf with the handlers of Applications until it is told to stop.

    Args:
        applications: The service behind the handlers.
        silence_s: For how long the quietest watch has heard nothing.
        health: URL that the liveness endpoint listens on.
        stop: Set it to end the operator; signals do so as well.
    """
    registry, settings = kopf.OperatorRegistry(), kopf.OperatorSettings()
    _configure(settings)
    _register(registry, applications, silence_s)
    await kopf.operator(
        registry=registry, settings=settings, clusterwide=True, liveness_endpoint=health, stop_flag=stop
    )


def _register(registry: kopf.OperatorRegistry, applications: Service, silence_s: Callable[[], float]) -> None:
    group, version = APPLICATION.api_version.split("/")

    @kopf.on.login(registry=registry, retries=3)
    def login(**kwargs: Any) -> kopf.ConnectionInfo | None:
        """Use the credentials that the store uses; called again when they expire."""
        return _by_address(kopf.login_with_service_account(**kwargs)) or kopf.login_with_kubeconfig(**kwargs)

    @kopf.on.probe(registry=registry, id="silence_s")
    async def silence(**_: object) -> float:
        """Tell, at the liveness endpoint, for how long the quietest watch has heard nothing.

        A coroutine, because kopf runs plain functions in a thread, which has no loop whose clock to read.
        """
        return round(silence_s(), 1)

    # With ids of our own: kopf notes progress under them in annotations, and those it makes up for nested functions are no
    # names that the API server takes, so that one failure would leave an application undeletable.
    @kopf.daemon(
        group,
        version,
        APPLICATION.plural,
        id="follow",
        registry=registry,
        backoff=_RETRY_S,
        cancellation_timeout=5.0,
    )
    async def application(namespace: str | None, name: str, stopped: kopf.DaemonStopped, **_: object) -> None:
        """Keep an application where its spec wants it: reconcile, then wait for an input to change."""
        # Cancelling is how kopf ends it at each deletion; it would log a warning if that came through.
        with contextlib.suppress(asyncio.CancelledError):
            await applications.follow((namespace or "", name), lambda: bool(stopped))

    @kopf.on.delete(group, version, APPLICATION.plural, id="teardown", registry=registry, backoff=_RETRY_S)
    async def application_deleted(namespace: str | None, name: str, uid: str, **_: object) -> None:
        """Take an application down before its object is removed."""
        try:
            await applications.teardown((namespace or "", name), uid)
        except KubeError as error:
            raise kopf.TemporaryError(str(error), delay=_RETRY_S) from error


def _by_address(info: kopf.ConnectionInfo | None) -> kopf.ConnectionInfo | None:
    """The API server by its address, as the store has it: no DNS is needed to start."""
    host, port = os.environ.get("KUBERNETES_SERVICE_HOST"), os.environ.get("KUBERNETES_SERVICE_PORT")
    if info is None or host is None or port is None:
        return info
    return dataclasses.replace(info, server=f"https://{f'[{host}]' if ':' in host else host}:{port}")


class Progress(kopf.AnnotationsProgressStorage):
    """Remembers which handlers failed, and when they are tried again.

    It is noted in annotations, whose changes wake kopf, but never read from them: who may edit an Application can write them, and
    would skip its teardown or put it off indefinitely. An operator that starts tries at once.
    """

    def __init__(self, prefix: str) -> None:
        super().__init__(prefix=prefix)
        self._known: dict[tuple[str, kopf.HandlerId], kopf.ProgressRecord] = {}

    def fetch(self, *, key: kopf.HandlerId, body: kopf.Body) -> kopf.ProgressRecord | None:
        """What this operator knows of a handler."""
        return self._known.get((_uid(body), key))

    def store(self, *, key: kopf.HandlerId, record: kopf.ProgressRecord, body: kopf.Body, patch: kopf.Patch) -> None:
        """Remember a handler."""
        # As annotations would give it back, without what is None: what compares unequal is stored at every look, and kopf then
        # waits for the event of a patch that changes nothing instead of for the time of the next try.
        kept = {name: value for name, value in record.items() if value is not None}
        self._known[_uid(body), key] = cast(kopf.ProgressRecord, kept)
        super().store(key=key, record=record, body=body, patch=patch)

    def purge(self, *, key: kopf.HandlerId, body: kopf.Body, patch: kopf.Patch) -> None:
        """Forget a handler that is done."""
        self._known.pop((_uid(body), key), None)
        super().purge(key=key, body=body, patch=patch)


def _uid(body: kopf.Body) -> str:
    return str(body["metadata"].get("uid", ""))


class _Unchanged(kopf.DiffBaseStorage):
    """Tells kopf that nothing changed: no handler uses the difference, and its annotation would cost a write."""

    def fetch(self, *, body: kopf.Body) -> kopf.BodyEssence:
        """What was handled last: what is there."""
        return self.build(body=body)

    def store(self, **_: object) -> None:
        """Nothing is kept."""


def _configure(settings: kopf.OperatorSettings) -> None:
    """Set kopf up: our names on objects, no Events of its own, watches that cannot go silent."""
    settings.persistence.finalizer = FINALIZER
    settings.persistence.progress_storage = Progress("kopf.fractus.dev")
    settings.persistence.diffbase_storage = _Unchanged()
    settings.posting.enabled = False
    settings.peering.standalone = True
    settings.scanning.disabled = True
    settings.watching.server_timeout = 240
    settings.watching.client_timeout = 300
    settings.watching.connect_timeout = 15
    settings.networking.request_timeout = 30
    settings.background.cancellation_polling = 5
    settings.process.ultimate_exiting_timeout = 10
