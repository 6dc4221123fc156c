"""The client certificates of instances, in Secrets that the operator writes and deletes, and has no right to read.

What it has to know of one, its public half, is an annotation of the instance's Deployment. So who holds the operator's token reads
no Secret of any namespace but that of the authority.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timedelta

from fractus_core.api import Application, component_identity
from fractus_core.api.plans import PlannedInstance
from fractus_core.identity.authority import Authority, Data

from fractus_operator.cluster.kinds import Body, Key
from fractus_operator.cluster.labels import CERTIFICATE_ANNOTATION
from fractus_operator.cluster.pods import PodView
from fractus_operator.reconcile import builders
from fractus_operator.reconcile.component_secrets import SecretWrite

_PUBLIC = ("tls.crt", "ca.crt")
_AGAIN = (timedelta(minutes=1), timedelta(hours=1))
"""How long a pod may be without being ready until its Secret is made if it is gone; twice as long each time."""


@dataclass(frozen=True, slots=True)
class Certificate:
    """The certificate of an instance.

    Attributes:
        noted: what its Deployment says of it, or is made with.
        secret: what to write; None while what was written is good.
        why: it is to be written.
        public: what its Deployment is to say of it then.
    """

    noted: str
    secret: Body | None = None
    why: SecretWrite = "new"
    public: str = ""


@dataclass(slots=True)
class _Known:
    """What is remembered of the Secret of an instance.

    Attributes:
        look_at: when it is made in case it is gone, if its pods are not ready by then.
        again: how long after that again.
        unwritten: whether the last write has failed.
    """

    look_at: datetime
    again: timedelta = _AGAIN[0]
    unwritten: bool = False

    def look(self, pods: Sequence[PodView], now: datetime) -> bool:
        """Whether it is time to see whether the Secret is there: pods that are not ready may wait for it."""
        if pods and all(pod.ready for pod in pods):
            self.look_at, self.again = now + _AGAIN[0], _AGAIN[0]
        if now < self.look_at or all(pod.ready for pod in pods):
            return False
        self.look_at, self.again = now + self.again, min(2 * self.again, _AGAIN[1])
        return True


class Certificates:
    """Issues them when they are due.

    Args:
        authority: signs them.
        clock: the time.
    """

    def __init__(self, authority: Authority, clock: Callable[[], datetime]) -> None:
        self._authority = authority
        self._clock = clock
        self._known: dict[Key, dict[str, _Known]] = {}
        """By application and instance; all of it can be lost."""

    def of(
        self, application: Application, placed: PlannedInstance, deployment: Body | None, pods: Iterable[PodView]
    ) -> Certificate:
        """The certificate of an instance: the present one while it is good, so that a restart renews nothing.

        Args:
            application: Whose instance it is.
            placed: The instance.
            deployment: Its Deployment as it is, if it is there.
            pods: The pods of the application.
        """
        namespace, name = application.key
        identity = component_identity(namespace, name, placed.component, placed.instance)
        annotations = (deployment or {}).get("metadata", {}).get("annotations") or {}
        noted = str(annotations.get(CERTIFICATE_ANNOTATION, ""))
        now = self._clock()
        good = self._authority.is_current(dict(zip(_PUBLIC, noted.split("."), strict=False)), identity, now)
        known = self._known.setdefault(application.key, {}).setdefault(placed.instance, _Known(now))
        if deployment is None:
            known.look_at = now + known.again
        lost = known.unwritten or known.look(
            [p for p in pods if p.instance == placed.instance and not (p.terminating or p.finished)], now
        )
        if good and not lost:
            return Certificate(noted)
        data = self._authority.issue_component(identity, now)
        secret = builders.tls_secret(application, placed, data)
        if deployment is None:
            return Certificate(_public(data), secret)
        if good:
            return Certificate(noted, secret, "new" if known.unwritten else "lost")
        return Certificate(noted, secret, "renewed", _public(data))

    @contextmanager
    def written(self, key: Key, instance: str) -> Iterator[None]:
        """While the Secret of an instance is written: one that was not is written again, whatever its Deployment says."""
        known = self._known.get(key, {}).get(instance) or _Known(self._clock())
        known.unwritten = True
        yield
        known.unwritten = False

    def forget(self, key: Key) -> None:
        """The application is gone."""
        self._known.pop(key, None)


def _public(data: Data) -> str:
    """What is no secret of a certificate."""
    return ".".join(data[name] for name in _PUBLIC)
