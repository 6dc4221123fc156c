"""Client certificates of instances, in Secrets that the operator may write and delete but not read.

The public part of a certificate is an annotation of the Deployment of its instance. So the operator's token gives access to
no Secret except the Secret of the certificate authority.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Literal

from fractus_core.api import Application, component_identity
from fractus_core.api.plans import PlannedInstance
from fractus_core.identity.authority import Authority

from fractus_operator import kinds, labels
from fractus_operator.kinds import Body, Key
from fractus_operator.labels import CERTIFICATE_ANNOTATION, owned_object, secret_name
from fractus_operator.pods import PodView

SecretWrite = Literal["new", "renewed", "lost"]
"""Reason for which a Secret is written: no Secret is known, its certificate is due for renewal, or a pod may wait for a deleted Secret."""

_PUBLIC = ("tls.crt", "ca.crt")
_FIRST_CHECK = timedelta(minutes=1)
"""If a pod is not ready for this time, its Secret is created again, in case it was deleted.

The time doubles after each creation.
"""
_MAX_CHECK = timedelta(hours=1)


def tls_secret(application: Application, placed: PlannedInstance, data: dict[str, str]) -> Body:
    """Return the Secret with the client certificate of an instance."""
    return owned_object(
        kinds.SECRET,
        application,
        secret_name(placed.instance),
        {labels.COMPONENT_LABEL: placed.component, labels.INSTANCE_LABEL: placed.instance},
        type="kubernetes.io/tls",
        data=data,
    )


@dataclass(slots=True)
class SecretState:
    """State of the Secret of an instance.

    Attributes:
        check_at: Time at which the Secret is created again if its pods are not ready by then.
        interval: Time until the check after that.
        write_failed: True from the beginning of a write until it has succeeded. After a failure the Secret is written again.
    """

    check_at: datetime
    interval: timedelta = _FIRST_CHECK
    write_failed: bool = False

    def may_be_lost(self, pods: Sequence[PodView], now: datetime) -> bool:
        """Return True if it is time to check the Secret, because pods that are not ready may wait for the Secret."""
        ready = all(pod.ready for pod in pods)
        if pods and ready:
            self.check_at = now + _FIRST_CHECK
            self.interval = _FIRST_CHECK
        if now < self.check_at or ready:
            return False
        self.check_at = now + self.interval
        self.interval = min(2 * self.interval, _MAX_CHECK)
        return True


@dataclass(frozen=True, slots=True)
class Certificate:
    """The certificate of an instance.

    Attributes:
        annotation: Public part that the Deployment has, or will be created with.
        state: State of the Secret, shared by successive certificates of the instance.
        secret: Secret to write, or None if the present one is valid.
        reason: Reason for which the Secret is written.
        renewed_annotation: Public part to write to the Deployment after the Secret, or an empty string.
    """

    annotation: str
    state: SecretState
    secret: Body | None = None
    reason: SecretWrite = "new"
    renewed_annotation: str = ""


class Certificates:
    """Issues the certificates of instances that are missing or due for renewal.

    Args:
        authority: Signs the certificates.
        clock: Returns the current time.
    """

    def __init__(self, authority: Authority, clock: Callable[[], datetime]) -> None:
        self._authority = authority
        self._clock = clock
        self._states: dict[Key, dict[str, SecretState]] = {}
        """State of each Secret, by Application and instance.

        The operator works without these states after a restart.
        """

    def of(
        self, application: Application, placed: PlannedInstance, deployment: Body | None, pods: Iterable[PodView]
    ) -> Certificate:
        """Return the certificate of an instance. A valid certificate is kept, also after a restart of the operator.

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
        state = self._states.setdefault(application.key, {}).setdefault(placed.instance, SecretState(now))
        if deployment is None:
            state.check_at = now + state.interval
        running = [p for p in pods if p.instance == placed.instance and not (p.terminating or p.finished)]
        lost = state.write_failed or state.may_be_lost(running, now)
        if valid and not lost:
            return Certificate(annotation, state)
        data = self._authority.issue_component(identity, now)
        secret = tls_secret(application, placed, data)
        public = ".".join(data[field] for field in _PUBLIC)
        if deployment is None:
            return Certificate(public, state, secret)
        if valid:
            return Certificate(annotation, state, secret, "new" if state.write_failed else "lost")
        return Certificate(annotation, state, secret, "renewed", public)

    def forget(self, key: Key) -> None:
        """Drop the state of a deleted Application."""
        self._states.pop(key, None)
