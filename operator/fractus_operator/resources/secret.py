"""Client certificates of instances, in Secrets that the operator may write and delete but not read.

The public part of a certificate is an annotation of the Deployment of its instance. So the operator's token gives access to
no Secret except that of the certificate authority.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timedelta
from http import HTTPStatus
from typing import Literal

from fractus_core.api import Application, component_identity
from fractus_core.api.plans import PlannedInstance
from fractus_core.identity.authority import Authority

from fractus_operator import kinds, labels
from fractus_operator.kinds import SECRET, Body, Key, key_of
from fractus_operator.labels import CERTIFICATE_ANNOTATION, label_key, owned_object, secret_name
from fractus_operator.pods import PodView
from fractus_operator.store import Conflict, KubeError, NotFound, Store

logger = logging.getLogger(__name__)

SecretWrite = Literal["new", "renewed", "lost"]
"""Why a Secret is written: no Secret is known, its certificate is due for renewal, or a pod may wait for a deleted Secret."""

_PUBLIC = ("tls.crt", "ca.crt")
_FIRST_CHECK = timedelta(minutes=1)
"""Time without readiness after which the Secret of a pod is created again in case it was deleted. Doubles each time."""
_MAX_CHECK = timedelta(hours=1)
_ALREADY_EXISTS = "AlreadyExists"


def tls_secret(application: Application, placed: PlannedInstance, data: dict[str, str]) -> Body:
    """Return the Secret with the client certificate of an instance."""
    instance_labels = {labels.COMPONENT_LABEL: placed.component, labels.INSTANCE_LABEL: placed.instance}
    return owned_object(
        kinds.SECRET, application, secret_name(placed.instance), instance_labels, type="kubernetes.io/tls", data=data
    )


@dataclass(frozen=True, slots=True)
class Certificate:
    """The certificate of an instance.

    Attributes:
        annotation: Public part that the Deployment has, or will be created with.
        secret: Secret to write, or None if the present one is valid.
        why: Why the Secret is written.
        renewed_annotation: Public part to write to the Deployment after the Secret, or an empty string.
    """

    annotation: str
    secret: Body | None = None
    why: SecretWrite = "new"
    renewed_annotation: str = ""


@dataclass(slots=True)
class _SecretState:
    """State of the Secret of an instance.

    Attributes:
        check_at: Time at which the Secret is created again if its pods are not ready by then.
        interval: Time until the check after that.
        write_failed: True if the last write failed.
    """

    check_at: datetime
    interval: timedelta = _FIRST_CHECK
    write_failed: bool = False

    def may_be_lost(self, pods: Sequence[PodView], now: datetime) -> bool:
        """Return True if it is time to check the Secret, because pods that are not ready may wait for it."""
        ready = all(pod.ready for pod in pods)
        if pods and ready:
            self.check_at = now + _FIRST_CHECK
            self.interval = _FIRST_CHECK
        if now < self.check_at or ready:
            return False
        self.check_at = now + self.interval
        self.interval = min(2 * self.interval, _MAX_CHECK)
        return True


class Certificates:
    """Issues certificates of instances when they are due.

    Args:
        authority: Signs the certificates.
        clock: Returns the current time.
    """

    def __init__(self, authority: Authority, clock: Callable[[], datetime]) -> None:
        self._authority = authority
        self._clock = clock
        self._states: dict[Key, dict[str, _SecretState]] = {}
        """By Application and instance. Losing it, as in a restart, is harmless."""

    def of(
        self, application: Application, placed: PlannedInstance, deployment: Body | None, pods: Iterable[PodView]
    ) -> Certificate:
        """Return the certificate of an instance. A valid one is kept, so a restart of the operator renews nothing.

        Args:
            application: The Application.
            placed: The planned instance.
            deployment: Its current Deployment, if any.
            pods: Pods of the Application.
        """
        namespace, name = application.key
        identity = component_identity(namespace, name, placed.component, placed.instance)
        annotations = (deployment or {}).get("metadata", {}).get("annotations") or {}
        annotation = str(annotations.get(CERTIFICATE_ANNOTATION, ""))
        now = self._clock()
        valid = self._authority.is_current(dict(zip(_PUBLIC, annotation.split("."), strict=False)), identity, now)
        state = self._states.setdefault(application.key, {}).setdefault(placed.instance, _SecretState(now))
        if deployment is None:
            state.check_at = now + state.interval
        running = [p for p in pods if p.instance == placed.instance and not (p.terminating or p.finished)]
        lost = state.write_failed or state.may_be_lost(running, now)
        if valid and not lost:
            return Certificate(annotation)
        data = self._authority.issue_component(identity, now)
        secret = tls_secret(application, placed, data)
        public = ".".join(data[field] for field in _PUBLIC)
        if deployment is None:
            return Certificate(public, secret)
        if valid:
            return Certificate(annotation, secret, "new" if state.write_failed else "lost")
        return Certificate(annotation, secret, "renewed", public)

    @contextmanager
    def writing(self, key: Key, instance: str) -> Iterator[None]:
        """Record whether a write of the Secret of an instance succeeds. After a failure it is written again."""
        state = self._states.get(key, {}).get(instance) or _SecretState(self._clock())
        state.write_failed = True
        yield
        state.write_failed = False

    def forget(self, key: Key) -> None:
        """Drop the state of a deleted Application."""
        self._states.pop(key, None)


class ComponentSecrets:
    """Writes and deletes the Secrets of instances.

    The admission policy of the chart allows the operator to write and delete only Secrets that it created.

    Args:
        store: The API server.
        limit: Limits the number of concurrent writes.
    """

    def __init__(self, store: Store, limit: asyncio.Semaphore) -> None:
        self._store = store
        self._limit = limit
        self._undeleted: dict[Key, set[Key]] = {}
        """By Application, the Secrets that could not be deleted together with their Deployments."""

    async def write(self, application: Key, body: Body, why: SecretWrite) -> None:
        """Write a Secret.

        Raises:
            KubeError: The API server refused the write, or could not be reached.
        """
        async with self._limit:
            self._undeleted.get(label_key(application), set()).discard(key_of(body))
            if why == "renewed":
                # A failed creation counts against the quota of the namespace.
                with contextlib.suppress(NotFound):
                    await self._store.replace(SECRET, body)
                    return
            try:
                await self._store.create(SECRET, body)
            except KubeError as refused:
                exists = isinstance(refused, Conflict) and refused.reason == _ALREADY_EXISTS
                # With an exhausted quota the API server reports Forbidden, even if the Secret exists.
                if not exists and refused.status != HTTPStatus.FORBIDDEN:
                    raise
                if exists and why == "lost":
                    return
                try:
                    await self._store.replace(SECRET, body)
                except NotFound:
                    raise refused from None

    async def delete_for(self, application: Key, deployment: Body) -> None:
        """Delete the Secret of a Deployment that is about to be deleted. Later, its name could not be determined.

        A failure does not prevent the deletion of the Deployment. A running pod keeps its mounted Secret.

        Args:
            application: Key of the Application, or its label key.
            deployment: The Deployment.
        """
        namespace, instance = key_of(deployment)
        secret = namespace, secret_name(instance)
        try:
            await self._store.delete(SECRET, secret)
        except KubeError as error:
            logger.debug("child objects: Secret not deleted yet (secret=%s/%s error=%s)", *secret, error)
            self._undeleted.setdefault(label_key(application), set()).add(secret)

    async def delete_remaining(self, application: Key) -> None:
        """Delete the Secrets that could not be deleted together with their Deployments.

        Raises:
            KubeError: The API server still refuses the deletion, or cannot be reached.
        """
        remaining = self._undeleted.get(label_key(application), set())
        for secret in list(remaining):
            await self._store.delete(SECRET, secret)
            remaining.discard(secret)
        if not remaining:
            self._undeleted.pop(label_key(application), None)
