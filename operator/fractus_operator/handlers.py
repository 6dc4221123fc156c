"""kopf handlers of Applications: the daemon that follows an Application, and its teardown before deletion."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import os
import ssl
from collections.abc import Awaitable, Callable
from typing import Any, Protocol, cast

import kopf

from fractus_operator.kinds import APPLICATION, Key
from fractus_operator.labels import FINALIZER
from fractus_operator.store import KubeError

_RETRY_S = 5.0


class Controller(Protocol):
    """The controller behind the handlers."""

    async def follow(self, key: Key, stopped: Callable[[], bool]) -> None:
        """Reconcile an Application until it is deleted or `stopped` returns True."""

    async def teardown(self, key: Key, uid: str) -> None:
        """Delete the objects of an Application before the Application is deleted."""


async def operator(
    applications: Controller,
    oldest_contact_s: Callable[[], float],
    health: str,
    stop: asyncio.Event | None,
    end_background: Callable[[], Awaitable[None]],
) -> None:
    """Run kopf with the handlers of Applications until it is stopped.

    Args:
        applications: The controller behind the handlers.
        oldest_contact_s: Returns the seconds since the last message of the watch that has been silent for longest.
        health: URL of the liveness endpoint.
        stop: Event that stops kopf. Signals stop it as well.
        end_background: Ends all other tasks. Called after the last handler has ended. If other tasks still run then,
            kopf waits five seconds for them, and no other operator can become the leader in this time.
    """
    registry = kopf.OperatorRegistry()
    settings = kopf.OperatorSettings()
    _configure(settings)
    _register(registry, applications, oldest_contact_s)

    @kopf.on.cleanup(registry=registry, id="end_background")
    async def cleanup(**_: object) -> None:
        """End all other tasks."""
        await end_background()

    await kopf.operator(
        registry=registry, settings=settings, clusterwide=True, liveness_endpoint=health, stop_flag=stop
    )


def _register(registry: kopf.OperatorRegistry, applications: Controller, oldest_contact_s: Callable[[], float]) -> None:
    group, version = APPLICATION.api_version.split("/")

    @kopf.on.login(registry=registry, retries=3)
    def login(**kwargs: Any) -> kopf.ConnectionInfo | None:
        """Return the credentials that the store uses. kopf calls this function again when they expire."""
        info = _with_address(kopf.login_with_service_account(**kwargs)) or kopf.login_with_kubeconfig(**kwargs)
        return KopfConnection(**{f.name: getattr(info, f.name) for f in dataclasses.fields(info)}) if info else None

    @kopf.on.probe(registry=registry, id="oldest_contact_s")
    async def probe_watches(**_: object) -> float:
        """Return the seconds since the last message of the most silent watch, for the liveness endpoint.

        This function is a coroutine, because kopf runs plain functions in a thread without an event loop.
        """
        return round(oldest_contact_s(), 1)

    # kopf stores the progress in an annotation that has the id of the handler as its name. The default id of a nested function
    # is not a valid name, and one failure would then make the Application undeletable. Therefore the ids are explicit.
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
        """Reconcile an Application whenever one of its inputs changes."""
        # kopf cancels the daemon at each deletion, and would log a warning about a cancelled daemon.
        with contextlib.suppress(asyncio.CancelledError):
            await applications.follow((namespace or "", name), lambda: bool(stopped))

    @kopf.on.delete(group, version, APPLICATION.plural, id="teardown", registry=registry, backoff=_RETRY_S)
    async def application_deleted(namespace: str | None, name: str, uid: str, **_: object) -> None:
        """Delete the objects of an Application before the Application is deleted."""
        try:
            await applications.teardown((namespace or "", name), uid)
        except KubeError as error:
            raise kopf.TemporaryError(str(error), delay=_RETRY_S) from error


class KopfConnection(kopf.ConnectionInfo):
    """Credentials of kopf that accept API server certificates without an authority key identifier.

    Python 3.13 refuses such certificates by default. kubectl and `fractus_runtime.kubernetes` accept them.
    """

    def as_ssl_context(self) -> ssl.SSLContext:
        """Return the TLS context of kopf without strict verification of X.509 extensions."""
        context: ssl.SSLContext = super().as_ssl_context()
        context.verify_flags &= ~ssl.VERIFY_X509_STRICT
        return context


def _with_address(info: kopf.ConnectionInfo | None) -> kopf.ConnectionInfo | None:
    """Return the connection with the IP address of the API server instead of its name, so that no DNS is needed."""
    host = os.environ.get("KUBERNETES_SERVICE_HOST")
    port = os.environ.get("KUBERNETES_SERVICE_PORT")
    if info is None or host is None or port is None:
        return info
    if ":" in host:
        host = f"[{host}]"
    return dataclasses.replace(info, server=f"https://{host}:{port}")


class InMemoryProgress(kopf.AnnotationsProgressStorage):
    """Progress of failed handlers, stored in memory and also written to annotations.

    The change of an annotation wakes kopf. The annotations are never read. Users who may edit an Application could otherwise
    skip or delay its teardown by writing them. After a restart of the operator, handlers are retried at once.
    """

    def __init__(self, prefix: str) -> None:
        super().__init__(prefix=prefix)
        self._records: dict[tuple[str, kopf.HandlerId], kopf.ProgressRecord] = {}

    def fetch(self, *, key: kopf.HandlerId, body: kopf.Body) -> kopf.ProgressRecord | None:
        """Return the record of a handler."""
        return self._records.get((_uid(body), key))

    def store(self, *, key: kopf.HandlerId, record: kopf.ProgressRecord, body: kopf.Body, patch: kopf.Patch) -> None:
        """Store the record of a handler."""
        # Annotations cannot contain None values. A record with such values would differ from the stored one each time, and
        # kopf would wait for the event of a patch that changes nothing, and not for the time of the next attempt.
        kept = {name: value for name, value in record.items() if value is not None}
        self._records[_uid(body), key] = cast(kopf.ProgressRecord, kept)
        super().store(key=key, record=record, body=body, patch=patch)

    def purge(self, *, key: kopf.HandlerId, body: kopf.Body, patch: kopf.Patch) -> None:
        """Delete the record of a handler that succeeded."""
        self._records.pop((_uid(body), key), None)
        super().purge(key=key, body=body, patch=patch)


def _uid(body: kopf.Body) -> str:
    return str(body["metadata"].get("uid", ""))


class _NoDiffBase(kopf.DiffBaseStorage):
    """Storage that never reports a difference between the last handled object and the current object.

    No handler uses the difference, and storing it in an annotation would cost a write.
    """

    def fetch(self, *, body: kopf.Body) -> kopf.BodyEssence:
        """Return the current object as the last handled one."""
        return self.build(body=body)

    def store(self, **_: object) -> None:
        """Store nothing."""


def _configure(settings: kopf.OperatorSettings) -> None:
    """Set the names that kopf writes to objects, disable its Events, and set timeouts of its watches."""
    settings.persistence.finalizer = FINALIZER
    settings.persistence.progress_storage = InMemoryProgress("kopf.fractus.dev")
    settings.persistence.diffbase_storage = _NoDiffBase()
    settings.posting.enabled = False
    settings.peering.standalone = True
    settings.scanning.disabled = True
    settings.watching.server_timeout = 240
    settings.watching.client_timeout = 300
    settings.watching.connect_timeout = 15
    settings.networking.request_timeout = 30
    settings.background.cancellation_polling = 5
    settings.process.ultimate_exiting_timeout = 10
