"""What the operator makes for an Application: created where it lacks, applied where it differs, removed where it is stale."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Collection, Mapping, Sequence

from fractus_core.api import Application, Grant, InvalidObject
from fractus_core.api.plans import GrantSpec
from fractus_core.identity.grant_signer import GrantSigner

from fractus_operator.cluster import kinds
from fractus_operator.cluster.kinds import Body, Key, Kind, key_of
from fractus_operator.cluster.labels import APPLICATION_LABEL, MANAGED_SELECTOR, NAMESPACE_LABEL, label_value
from fractus_operator.cluster.reading import read
from fractus_operator.cluster.store import Conflict, KubeError, NotFound, Store
from fractus_operator.inventory.live import LiveInventory
from fractus_operator.reconcile import builders
from fractus_operator.reconcile.difference import contains, digest, is_current, stamped

logger = logging.getLogger(__name__)

_PARALLEL = 8
_BESIDE = 2
"""How many objects are applied at a time that a pod merely waits for: what schedules pods needs the API server more."""
_AHEAD = frozenset({kinds.DEPLOYMENT_PLAN, kinds.GRANT})
"""What waits for no other kind, so that a webhook which holds up Secrets or Deployments delays neither plans nor grants."""

_EXISTS = "AlreadyExists"
_INADMISSIBLE = frozenset({403, 422})


class NameTaken(Exception):
    """An object that is not the application's own has the name of one of its children."""


class Children:
    """The children of Applications."""

    def __init__(self, store: Store, live: LiveInventory, signer: GrantSigner) -> None:
        self._store = store
        self._live = live
        self._signer = signer
        self._parallel = asyncio.Semaphore(_PARALLEL)
        self._scheduling = asyncio.Semaphore(_PARALLEL)
        self._beside = asyncio.Semaphore(_BESIDE)
        self._met: set[tuple[Kind, Key]] = set()
        self._normalised: dict[tuple[Kind, Key], tuple[object, ...]] = {}

    async def apply(self, application: Application, wanted: Mapping[Kind, Sequence[Body]]) -> None:
        """Create those objects that are not there, and apply those that are not as they should be.

        Raises:
            NameTaken: somebody else's object has the name of one of them.
        """
        results = await asyncio.gather(
            *(self._apply_one(application, kind, body) for kind, bodies in wanted.items() for body in bodies),
            return_exceptions=True,
        )
        for result in results:
            if isinstance(result, BaseException):
                raise result

    async def refresh(self, grants: Sequence[tuple[Grant, GrantSpec]]) -> None:
        """Bring Grants that exist up to date; one that is refused stops no other."""
        results = await asyncio.gather(*(self._refresh_one(*pair) for pair in grants), return_exceptions=True)
        for result in results:
            if isinstance(result, BaseException):
                raise result

    async def _refresh_one(self, grant: Grant, spec: GrantSpec) -> None:
        key = ("", grant.name)
        observed = self._live.children[kinds.GRANT].get(key)
        if observed is None or "deletionTimestamp" in observed["metadata"]:
            return
        body = self._signer.sign(stamped(builders.granted_again(observed, spec)), grant)
        async with self._parallel:
            self._live.children[kinds.GRANT].note(key, await self._store.rewrite(kinds.GRANT, observed, body))

    async def _apply_one(self, application: Application, kind: Kind, body: Body) -> None:
        desired = stamped(body)
        async with self._turn(kind):
            if kind is kinds.GRANT:
                await self._grant(application, body, desired)
            else:
                await self._make(application, kind, desired)

    def _turn(self, kind: Kind) -> asyncio.Semaphore:
        if kind in _AHEAD:
            return self._parallel
        return self._scheduling if kind is kinds.DEPLOYMENT else self._beside

    async def _grant(self, application: Application, body: Body, desired: Body) -> None:
        kind, key = kinds.GRANT, key_of(desired)
        observed = self._live.children[kind].get(key)
        if observed is None:
            observed = await self._create(kind, desired, self._signer.sign(desired))
        if observed is None:
            return
        said = self._is_as_desired(kind, desired, observed) or _says_the_same(observed, body)
        present = _readable(observed)
        problem = self._signer.problem(present) if present is not None else "the object cannot be read"
        if said and problem is None:
            return
        if problem is not None:
            logger.warning("children: Grant is not valid and is signed again (grant=%s problem=%s)", key[1], problem)
        _check_own(application, kind, observed)
        signed = self._signer.sign(desired, present)
        if _moved(observed, body):
            # A Grant belongs to one node for its whole life: its status tells what happened there.
            await self._store.delete(kind, key, observed["metadata"]["uid"])
            made = await self._store.create(kind, signed)
        else:
            made = await self._store.rewrite(kind, observed, signed)
        self._note(kind, desired, made)

    async def _make(self, application: Application, kind: Kind, desired: Body) -> None:
        key = key_of(desired)
        observed = self._live.children[kind].get(key)
        if observed is None:
            observed = await self._create(kind, desired, desired)
        if observed is None or self._is_as_desired(kind, desired, observed):
            return
        _check_own(application, kind, observed)
        try:
            await self._store.count_as_applied(kind, key)
        except KubeError as error:
            if error.status not in _INADMISSIBLE:
                raise
            # What it says so far may not be said any more, not even by its fields' change of hands.
            await self._store.apply(kind, desired)
            await self._store.count_as_applied(kind, key)
        self._note(kind, desired, await self._store.apply(kind, desired))

    async def _create(self, kind: Kind, desired: Body, body: Body) -> Body | None:
        """Create what is most likely new without a look: the answer tells. The object that has its name, if there is one.

        What was once in the way is looked for: each creation in vain counts against the quota of its namespace.
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
        self._live.children[kind].note(key, applied)
        if not is_current(desired, applied):
            # The API server spells some value its own way (0.5 cores become 500m).
            self._normalised[kind, key] = _state(desired, applied)

    async def prune(
        self, application: Application, wanted: Mapping[Kind, Sequence[Body]], *, keep_secrets: Collection[str]
    ) -> None:
        """Delete children that are not wanted any more, what runs first."""
        for kind in reversed(kinds.CHILDREN):
            names = set(keep_secrets) if kind is kinds.SECRET else {body["metadata"]["name"] for body in wanted[kind]}
            for child in self._live.children_of(application.key, kind):
                if child["metadata"]["name"] not in names and _is_child(application, kind, child):
                    await self._delete(kind, child)

    async def remove(self, key: Key, kind: Kind) -> bool:
        """Delete every child of a kind; True if there was any."""
        children = self._live.children_of(key, kind)
        for child in children:
            self._normalised.pop((kind, key_of(child)), None)
            self._met.discard((kind, key_of(child)))
            await self._delete(kind, child)
        return bool(children)

    async def revoke(self, key: Key) -> bool:
        """Delete every Grant of an application, also those the watch has not shown yet; True if there was any."""
        namespace, name = key
        selector = f"{MANAGED_SELECTOR},{NAMESPACE_LABEL}={namespace},{APPLICATION_LABEL}={label_value(name)}"
        known = bool(self._live.children_of(key, kinds.GRANT))
        grants = await self._store.list(kinds.GRANT, selectors={"labelSelector": selector})
        for grant in grants:
            await self._delete(kinds.GRANT, grant)
        return known or bool(grants)

    async def _delete(self, kind: Kind, body: Body) -> None:
        if "deletionTimestamp" in body["metadata"]:
            return
        logger.info("removing %s %s", kind.name, body["metadata"]["name"])
        await self._store.delete(kind, key_of(body), body["metadata"].get("uid"))


def _state(desired: Body, observed: Body) -> tuple[object, ...]:
    """What tells that neither the desired nor the observed object changed; status changes do not count."""
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
    if kind is kinds.GRANT:
        owner = body.get("spec", {}).get("application", {})
        return bool(owner.get("uid") == application.metadata.uid)
    owners = body["metadata"].get("ownerReferences") or ()
    return any(owner.get("uid") == application.metadata.uid for owner in owners)


def _readable(observed: Body | None) -> Grant | None:
    try:
        return read(Grant, observed) if observed is not None else None
    except InvalidObject:
        return None


def _says_the_same(observed: Body, desired: Body) -> bool:
    """Whether a Grant, however it is spelt, already says what is desired: a release that spells it in another way changes none."""
    present = _readable(observed)
    if present is None or not contains(observed["metadata"].get("labels"), desired["metadata"]["labels"]):
        return False
    return present.spec.model_copy(update={"issued_at": None}) == read(Grant, desired).spec


def _moved(observed: Body, desired: Body) -> bool:
    return bool(observed["spec"]["node"] != desired["spec"]["node"])
