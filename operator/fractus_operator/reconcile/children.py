"""What the operator makes for an Application: created if missing, applied if different, removed if stale."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Awaitable, Iterable, Mapping, Sequence

from fractus_core.api import Application, Grant, InvalidObject
from fractus_core.api.grants import GrantSpec
from fractus_core.identity.grant_signer import GrantSigner

from fractus_operator.cluster import kinds
from fractus_operator.cluster.kinds import Body, Key, Kind, key_of
from fractus_operator.cluster.labels import (
    APPLICATION_LABEL,
    MANAGED_SELECTOR,
    NAMESPACE_LABEL,
    SLICE_LABEL,
    SLICES_BY,
    label_value,
)
from fractus_operator.cluster.reading import read
from fractus_operator.cluster.store import Conflict, ContentType, KubeError, NotFound, Store
from fractus_operator.inventory.made import Made, application_of
from fractus_operator.reconcile import builders
from fractus_operator.reconcile.component_secrets import ComponentSecrets, SecretWrite
from fractus_operator.reconcile.difference import contains, digest, is_current, stamped

logger = logging.getLogger(__name__)

_MAX_PARALLEL = 8
_MAX_BESIDE = 2
"""Objects that are applied at a time and that a pod merely waits for: what schedules pods needs the API server more."""
_FIRST = frozenset({kinds.DEPLOYMENT_PLAN, kinds.GRANT})
"""Kinds that wait for no other, so that a webhook which holds up Secrets or Deployments delays neither plans nor grants."""

_WHOLE = frozenset({kinds.DEPLOYMENT_PLAN, kinds.DIRECT_LINK})
"""Kinds of which no one else says anything: they are given their spec as it is, which takes a third of an apply's requests."""

_EXISTS = "AlreadyExists"
_INADMISSIBLE = frozenset({403, 422})


class NameTaken(Exception):
    """An object that is not the application's own has the name of one of its children."""


class Children:
    """The children of Applications.

    Args:
        store: The API server.
        copies: What is there, by kind.
        signer: Signs Grants.
    """

    def __init__(self, store: Store, copies: Mapping[Kind, Made], signer: GrantSigner) -> None:
        self._store = store
        self._copies = copies
        self._signer = signer
        self._first = asyncio.Semaphore(_MAX_PARALLEL)
        self._scheduling = asyncio.Semaphore(_MAX_PARALLEL)
        self._beside = asyncio.Semaphore(_MAX_BESIDE)
        self._met: set[tuple[Kind, Key]] = set()
        self._normalised: dict[tuple[Kind, Key], tuple[object, ...]] = {}
        self._secrets = ComponentSecrets(store, self._beside)

    # -- reading --

    def get(self, kind: Kind, key: Key) -> Body | None:
        """What is there of a kind under a key, as far as the watch has shown it."""
        return self._copies[kind].get(key)

    def of(self, key: Key, kind: Kind) -> list[Body]:
        """What was made of a kind for an application; no EndpointSlices by which Kubernetes itself follows one of its Services."""
        made = self._copies[kind].of(key)
        return [body for body in made if _is_ours(body)] if kind is kinds.ENDPOINT_SLICE else made

    # -- applying --

    async def apply(self, application: Application, wanted: Mapping[Kind, Sequence[Body]]) -> None:
        """Create those objects that are not there, and apply those that are not as they should be.

        Raises:
            NameTaken: another's object has the name of one of them.
            KubeError: the API server refused one, or cannot be reached.
        """
        await every(self._apply_one(application, kind, body) for kind, bodies in wanted.items() for body in bodies)

    async def refresh(self, grants: Sequence[tuple[Grant, GrantSpec]]) -> None:
        """Bring Grants that exist up to date; one that is refused stops no other."""
        await every(self._refresh_one(*pair) for pair in grants)

    async def change(self, kind: Kind, observed: Body, fields: Body) -> None:
        """Give some fields of a child other values. One that is gone is not made again.

        Raises:
            KubeError: the API server refuses the change, or cannot be reached.
        """
        key = key_of(observed)
        with contextlib.suppress(NotFound):
            self._copies[kind].note(key, await self._store.patch(kind, key, fields, ContentType.MERGE))

    async def write_secret(self, application: Application, instance: str, body: Body, why: SecretWrite) -> bool:
        """Write the Secret of an instance, unless its Deployment is not of the application; whether it was written.

        Raises:
            KubeError: the API server refuses it, or cannot be reached.
        """
        deployment = self.get(kinds.DEPLOYMENT, (application.key[0], instance))
        if deployment is not None and not _is_child(application, kinds.DEPLOYMENT, deployment):
            return False
        await self._secrets.write(application.key, body, why)
        return True

    async def _refresh_one(self, grant: Grant, spec: GrantSpec) -> None:
        key = ("", grant.name)
        observed = self.get(kinds.GRANT, key)
        if observed is None or "deletionTimestamp" in observed["metadata"]:
            return
        body = self._signer.sign(stamped(builders.regranted(observed, spec)), grant)
        async with self._first:
            self._copies[kinds.GRANT].note(key, await self._store.rewrite(kinds.GRANT, observed, body))

    async def _apply_one(self, application: Application, kind: Kind, body: Body) -> None:
        turn = self._first if kind in _FIRST else self._scheduling if kind is kinds.DEPLOYMENT else self._beside
        desired = stamped(body)
        async with turn:
            if kind is kinds.GRANT:
                await self._grant(application, body, desired)
            else:
                await self._make(application, kind, desired)

    async def _grant(self, application: Application, body: Body, desired: Body) -> None:
        kind, key = kinds.GRANT, key_of(desired)
        observed = self.get(kind, key)
        if observed is None:
            observed = await self._create(kind, desired, self._signer.sign(desired))
        if observed is None:
            return
        present = _readable(observed)
        problem = "it cannot be read" if present is None else self._signer.problem(present)
        if problem is not None:
            logger.warning("children: Grant is not valid and is signed again (grant=%s): %s", key[1], problem)
        elif self._is_as_desired(kind, desired, observed) or _says_as_desired(observed, present, body):
            return
        _check_own(application, kind, observed)
        signed = self._signer.sign(desired, present)
        if observed["spec"]["node"] != desired["spec"]["node"]:
            # A Grant belongs to one node for its whole life: its status tells what happened there.
            await self._store.delete(kind, key, observed["metadata"]["uid"])
            applied = await self._store.create(kind, signed)
        else:
            applied = await self._store.rewrite(kind, observed, signed)
        self._note(kind, desired, applied)

    async def _make(self, application: Application, kind: Kind, desired: Body) -> None:
        key = key_of(desired)
        observed = self.get(kind, key)
        if observed is None:
            observed = await self._create(kind, desired, desired)
        if observed is None or self._is_as_desired(kind, desired, observed):
            return
        _check_own(application, kind, observed)
        owners = "ownerReferences"
        if kind in _WHOLE and contains(observed["metadata"].get(owners), desired["metadata"].get(owners, [])):
            # One that is gone, which the watch has yet to show, is made again by the apply.
            with contextlib.suppress(NotFound):
                self._note(kind, desired, await self._store.rewrite(kind, observed, desired))
                return
        try:
            await self._store.count_as_applied(kind, key)
        except KubeError as error:
            if error.status not in _INADMISSIBLE:
                raise
            # Its present content is no longer admitted, not even for a change of its fields' owner: replace that first.
            await self._store.apply(kind, desired)
            await self._store.count_as_applied(kind, key)
        self._note(kind, desired, await self._store.apply(kind, desired))

    async def _create(self, kind: Kind, desired: Body, body: Body) -> Body | None:
        """Create what is most likely new without a look: the answer tells. The object that has its name, if there is one.

        A name that was taken once is looked up first: each failed creation counts against the quota of its namespace.
        """
        key = key_of(desired)
        if (kind, key) in self._met:
            there = await self._look(kind, key)
            if there is not None:
                return there
        try:
            self._note(kind, desired, await self._store.create(kind, body))
        except Conflict as taken:
            if taken.reason != _EXISTS:
                raise
            self._met.add((kind, key))
            return await self._store.get(kind, key[1], key[0])
        self._met.discard((kind, key))
        return None

    async def _look(self, kind: Kind, key: Key) -> Body | None:
        try:
            return await self._store.get(kind, key[1], key[0])
        except NotFound:
            return None

    def _is_as_desired(self, kind: Kind, desired: Body, observed: Body) -> bool:
        if is_current(desired, observed):
            return True
        known = self._normalised.get((kind, key_of(desired)))
        return known is not None and known == _state(desired, observed)

    def _note(self, kind: Kind, desired: Body, applied: Body) -> None:
        """Take what a write returned, ahead of the watch."""
        key = key_of(applied)
        self._copies[kind].note(key, applied)
        if not is_current(desired, applied):
            # The API server spells some value its own way (0.5 cores become 500m).
            self._normalised[kind, key] = _state(desired, applied)

    # -- removing --

    async def prune(self, application: Application, wanted: Mapping[Kind, Sequence[Body]]) -> None:
        """Delete children that are not wanted any more, what runs first."""
        for kind in reversed(kinds.CHILDREN):
            names = {body["metadata"]["name"] for body in wanted[kind]}
            for child in self.of(application.key, kind):
                if child["metadata"]["name"] not in names and _is_child(application, kind, child):
                    await self._delete(kind, child)
        await self._secrets.remove_kept(application.key)

    async def remove(self, key: Key, *of: Kind, orphan: bool = False) -> bool:
        """Delete every child of some kinds, one kind after the other, and what it owns unless that is left; True if there was any."""
        removed = False
        for kind in of:
            for child in self.of(key, kind):
                removed = True
                await self._delete(kind, child, orphan=orphan)
        await self._secrets.remove_kept(key)
        return removed

    async def remove_at_once(self, key: Key, kind: Kind) -> set[str]:
        """Delete every child of a kind, and what it owns; the uids of those that no finalizer of another keeps."""
        found = [body for body in self.of(key, kind) if "uid" in body["metadata"]]
        return {body["metadata"]["uid"] for body in found if await self._delete(kind, body)}

    async def revoke(self, key: Key) -> None:
        """Delete every Grant of an application, also those that the watch has not shown yet."""
        namespace, name = key
        selector = f"{MANAGED_SELECTOR},{NAMESPACE_LABEL}={namespace},{APPLICATION_LABEL}={label_value(name)}"
        for grant in await self._store.list(kinds.GRANT, selectors={"labelSelector": selector}):
            await self._delete(kinds.GRANT, grant)

    async def _delete(self, kind: Kind, body: Body, *, orphan: bool = False) -> bool:
        """Delete a child; whether it is gone now."""
        if "deletionTimestamp" in body["metadata"]:
            return False
        logger.info("children: removing (kind=%s name=%s)", kind.name, body["metadata"]["name"])
        if kind is kinds.DEPLOYMENT:
            await self._secrets.remove_of(application_of(body), body)
        self._normalised.pop((kind, key_of(body)), None)
        self._met.discard((kind, key_of(body)))
        return await self._store.delete(kind, key_of(body), body["metadata"].get("uid"), orphan=orphan)


async def every(writes: Iterable[Awaitable[None]]) -> None:
    """Run writes together; the first failure is raised once all have ended, for one that fails stops no other."""
    for result in await asyncio.gather(*writes, return_exceptions=True):
        if isinstance(result, BaseException):
            raise result


def _state(desired: Body, observed: Body) -> tuple[object, ...]:
    """The versions of the desired and of the observed object; status changes do not count."""
    metadata = observed["metadata"]
    return (digest(desired), metadata.get("uid"), metadata.get("generation") or metadata.get("resourceVersion"))


def _check_own(application: Application, kind: Kind, observed: Body) -> None:
    """Check that an object was made for this application.

    Raises:
        NameTaken: it was not.
    """
    if not _is_child(application, kind, observed):
        name = observed["metadata"]["name"]
        raise NameTaken(f"{kind.name} {name} exists and is not of this application; rename one of them")


def _is_child(application: Application, kind: Kind, body: Body) -> bool:
    if not kind.namespaced:
        owner = body.get("spec", {}).get("application", {})
        return bool(owner.get("uid") == application.metadata.uid)
    owners = body["metadata"].get("ownerReferences") or ()
    return any(owner.get("uid") == application.metadata.uid for owner in owners)


def _is_ours(endpoint_slice: Body) -> bool:
    """Whether the operator made an EndpointSlice: those of Kubernetes have all labels of their Service, and go with it."""
    return bool(endpoint_slice["metadata"]["labels"].get(SLICE_LABEL) == SLICES_BY)


def _readable(observed: Body) -> Grant | None:
    try:
        return read(Grant, observed)
    except InvalidObject:
        return None


def _says_as_desired(observed: Body, present: Grant | None, desired: Body) -> bool:
    """Whether a Grant already says what is desired, however it is serialized: another release may do that differently."""
    if present is None or not contains(observed["metadata"].get("labels"), desired["metadata"]["labels"]):
        return False
    return present.spec.unsigned == read(Grant, desired).spec
