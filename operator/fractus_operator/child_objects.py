"""Reconciliation of the child objects of Applications.

The operator applies a child object that is missing or different, and deletes a child object that is no longer desired.
It may write and delete the Secrets of components, but not read them. The chart's admission policy limits writing and
deleting to Secrets that the operator created.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Mapping, Sequence
from http import HTTPStatus

from fractus_core.api import Application, Grant, InvalidObject
from fractus_core.api.grants import GrantSpec
from fractus_core.identity.grant_signer import GrantSigner

from fractus_operator import kinds
from fractus_operator.comparison import contains, is_current, stamped
from fractus_operator.kinds import Body, Key, Kind, key_of
from fractus_operator.labels import (
    APPLICATION_LABEL,
    DIGEST_ANNOTATION,
    MANAGED_SELECTOR,
    NAMESPACE_LABEL,
    SLICE_LABEL,
    SLICES_BY,
    label_key,
    label_value,
    secret_name,
)
from fractus_operator.owned_objects import OwnedObjects, application_label_key
from fractus_operator.parsing import parse_object
from fractus_operator.resources.grant import regranted
from fractus_operator.resources.secret import SecretWrite
from fractus_operator.store import Conflict, ContentType, KubeError, NotFound, Store

log = logging.getLogger(__name__)

_MAX_CONCURRENT = 16
"""Limit of concurrent writes of child objects other than plans and Grants.

If a webhook does not respond to such writes, connections for plans and Grants remain.
"""
_UNLIMITED = frozenset({kinds.DEPLOYMENT_PLAN, kinds.GRANT})

_ALREADY_EXISTS = "AlreadyExists"
_INADMISSIBLE = frozenset({HTTPStatus.FORBIDDEN, HTTPStatus.UNPROCESSABLE_ENTITY})


class NameTaken(Exception):
    """The name of a child object is taken by an object that does not belong to the Application."""


class ChildObjects:
    """The child objects of Applications.

    Args:
        store: The API server.
        caches: The existing objects by kind.
        signer: Signs Grants.
    """

    def __init__(self, store: Store, caches: Mapping[Kind, OwnedObjects], signer: GrantSigner) -> None:
        self._store = store
        self._caches = caches
        self._signer = signer
        self._limit = asyncio.Semaphore(_MAX_CONCURRENT)
        self._normalised: dict[tuple[Kind, Key], tuple[object, ...]] = {}
        self._taken: set[tuple[Kind, Key]] = set()
        """Names of objects whose creation failed because another object has the name."""
        self._undeleted_secrets: dict[Key, set[Key]] = {}
        """By Application, the Secrets that could not be deleted together with their Deployments."""

    # -- reading --

    def get(self, kind: Kind, key: Key) -> Body | None:
        """Return the cached object with this key, or None."""
        return self._caches[kind].get(key)

    def of(self, key: Key, kind: Kind) -> list[Body]:
        """Return the child objects of one kind of an Application, without EndpointSlices that Kubernetes manages."""
        children = self._caches[kind].of(key)
        return [body for body in children if _is_managed(body)] if kind is kinds.ENDPOINT_SLICE else children

    # -- applying --

    async def apply(self, application: Application, desired: Mapping[Kind, Sequence[Body]]) -> None:
        """Apply the objects that are missing or different, kind by kind in the given order.

        A failure does not stop the others. The first failure is raised at the end.

        Raises:
            NameTaken: An object of another owner has the name of one of them.
            KubeError: The API server refused one of them, or could not be reached.
        """
        failures: list[BaseException] = []
        for kind, bodies in desired.items():
            writes = (self._apply_one(application, kind, body) for body in bodies)
            results = await asyncio.gather(*writes, return_exceptions=True)
            failures += [result for result in results if isinstance(result, BaseException)]
        if failures:
            raise failures[0]

    async def refresh_grant(self, grant: Grant, spec: GrantSpec) -> None:
        """Update the spec of an existing Grant. A deleted Grant is not created again.

        Raises:
            KubeError: The API server refused the change, or could not be reached.
        """
        key = ("", grant.name)
        observed = self.get(kinds.GRANT, key)
        if observed is None or "deletionTimestamp" in observed["metadata"]:
            return
        body = self._signer.sign(stamped(regranted(observed, spec)), grant)
        self._caches[kinds.GRANT].record_write(key, await self._store.replace_spec(kinds.GRANT, observed, body))

    async def change(self, kind: Kind, observed: Body, fields: Body) -> None:
        """Change fields of a child object. A deleted object is not created again.

        Raises:
            KubeError: The API server refused the change, or could not be reached.
        """
        key = key_of(observed)
        with contextlib.suppress(NotFound):
            self._caches[kind].record_write(key, await self._store.patch(kind, key, fields, ContentType.MERGE))

    async def create_secret(self, body: Body) -> bool:
        """Create a Secret. Return False if the API server refuses it, for example because its name is taken.

        Raises:
            KubeError: The API server could not be reached.
        """
        async with self._limit:
            try:
                await self._store.create(kinds.SECRET, body)
            except KubeError as error:
                if not error.status:
                    raise
                log.debug("child objects: Secret not created yet (secret=%s/%s error=%s)", *key_of(body), error)
                return False
        return True

    async def write_secret(self, application: Application, instance: str, body: Body, reason: SecretWrite) -> bool:
        """Write the Secret of an instance, unless its Deployment belongs to another owner. Return True if it is written.

        Raises:
            KubeError: The API server refused the write, or could not be reached.
        """
        deployment = self.get(kinds.DEPLOYMENT, (application.key[0], instance))
        if deployment is not None and not _is_child(application, kinds.DEPLOYMENT, deployment):
            return False
        async with self._limit:
            self._undeleted_secrets.get(label_key(application.key), set()).discard(key_of(body))
            if reason == "renewed":
                # A failed creation counts against the quota of the namespace.
                with contextlib.suppress(NotFound):
                    await self._store.replace(kinds.SECRET, body)
                    return True
            try:
                await self._store.create(kinds.SECRET, body)
            except KubeError as refused:
                exists = isinstance(refused, Conflict) and refused.reason == _ALREADY_EXISTS
                # With an exhausted quota the API server reports Forbidden, even if the Secret exists.
                if not exists and refused.status != HTTPStatus.FORBIDDEN:
                    raise
                if exists and reason == "lost":
                    return True
                try:
                    await self._store.replace(kinds.SECRET, body)
                except NotFound:
                    raise refused from None
        return True

    async def _apply_one(self, application: Application, kind: Kind, body: Body) -> None:
        async with contextlib.nullcontext() if kind in _UNLIMITED else self._limit:
            if kind is kinds.GRANT:
                await self._apply_grant(application, body)
                return
            desired = stamped(body)
            observed = self.get(kind, key_of(desired)) or await self._create(kind, desired, desired)
            if observed is None or self._is_current(kind, desired, observed):
                return
            _check_owner(application, kind, observed)
            try:
                await self._store.take_ownership(kind, key_of(desired))
            except KubeError as error:
                if error.status not in _INADMISSIBLE:
                    raise
                # Admission would refuse the current content, so it must be replaced first.
                await self._store.apply(kind, desired)
                await self._store.take_ownership(kind, key_of(desired))
            self._record(kind, desired, await self._store.apply(kind, desired))

    async def _apply_grant(self, application: Application, body: Body) -> None:
        """Create or replace a Grant. Its spec is signed as a whole, so it is not merged by server-side apply."""
        kind = kinds.GRANT
        desired = stamped(body)
        key = key_of(desired)
        observed = self.get(kind, key) or await self._create(kind, desired, self._signer.sign(desired))
        if observed is None:
            return
        present = _parse_grant(observed)
        problem = "it cannot be parsed" if present is None else self._signer.problem(present)
        if problem is not None:
            log.warning("child objects: invalid Grant is signed again (grant=%s problem=%s)", key[1], problem)
        elif self._is_current(kind, desired, observed) or _is_equal(observed, present, body):
            return
        _check_owner(application, kind, observed)
        signed = self._signer.sign(desired, present)
        if observed["spec"]["node"] != desired["spec"]["node"]:
            # A Grant never changes its node, because its status reports the mission on that node.
            await self._store.delete(kind, key, observed["metadata"]["uid"])
            applied = await self._store.create(kind, signed)
        else:
            applied = await self._store.replace_spec(kind, observed, signed)
        self._record(kind, desired, applied)

    async def _create(self, kind: Kind, desired: Body, body: Body) -> Body | None:
        """Create an object, normally without a prior GET. If its name is taken, return the existing object.

        Only a name that was taken at an earlier attempt is looked up first, because each failed creation counts against the
        quota of the namespace.
        """
        key = key_of(desired)
        if (kind, key) in self._taken:
            with contextlib.suppress(NotFound):
                return await self._store.get(kind, key[1], key[0])
        try:
            self._record(kind, desired, await self._store.create(kind, body))
        except Conflict as conflict:
            if conflict.reason != _ALREADY_EXISTS:
                raise
            self._taken.add((kind, key))
            return await self._store.get(kind, key[1], key[0])
        self._taken.discard((kind, key))
        return None

    def _is_current(self, kind: Kind, desired: Body, observed: Body) -> bool:
        if is_current(desired, observed):
            return True
        known = self._normalised.get((kind, key_of(desired)))
        return known is not None and known == _versions(desired, observed)

    def _record(self, kind: Kind, desired: Body, applied: Body) -> None:
        """Add the result of a write to the cache, before the watch reports it."""
        key = key_of(applied)
        self._caches[kind].record_write(key, applied)
        if not is_current(desired, applied):
            # The API server normalised a value, such as 0.5 CPU cores to 500m.
            self._normalised[kind, key] = _versions(desired, applied)

    # -- deleting --

    async def prune(self, application: Application, desired: Mapping[Kind, Sequence[Body]]) -> None:
        """Delete child objects that are no longer desired, in the reverse of the order in which they are applied."""
        for kind in reversed(kinds.CHILDREN):
            names = {body["metadata"]["name"] for body in desired[kind]}
            for child in self.of(application.key, kind):
                if child["metadata"]["name"] not in names and _is_child(application, kind, child):
                    await self._delete(kind, child)
        await self._delete_remaining_secrets(application.key)

    async def remove(
        self, key: Key, *of: Kind, orphan: bool = False, keeps: Callable[[Body], bool] | None = None
    ) -> bool:
        """Delete child objects of some kinds, one kind after the other. Return True if there were any.

        Args:
            key: The Application.
            of: The kinds.
            orphan: Keep the objects that the deleted objects own.
            keeps: Returns True for objects that are not deleted. By default, all are deleted.
        """
        removed = False
        for kind in of:
            for child in self.of(key, kind):
                if keeps is None or not keeps(child):
                    removed = True
                    await self._delete(kind, child, orphan=orphan)
        await self._delete_remaining_secrets(key)
        return removed

    async def remove_at_once(self, key: Key, kind: Kind) -> set[str]:
        """Delete all child objects of a kind and the objects that they own.

        Returns:
            The uids of the deleted objects, except objects that a finalizer keeps.
        """
        existing = [body for body in self.of(key, kind) if "uid" in body["metadata"]]
        return {body["metadata"]["uid"] for body in existing if await self._delete(kind, body)}

    async def revoke(self, key: Key) -> None:
        """Delete every Grant of an Application, including Grants that are not in the cache yet."""
        namespace, name = key
        selector = f"{MANAGED_SELECTOR},{NAMESPACE_LABEL}={namespace},{APPLICATION_LABEL}={label_value(name)}"
        for grant in await self._store.list(kinds.GRANT, selectors={"labelSelector": selector}):
            await self._delete(kinds.GRANT, grant)

    async def _delete(self, kind: Kind, body: Body, *, orphan: bool = False) -> bool:
        """Delete a child object. Return True if it is gone."""
        if "deletionTimestamp" in body["metadata"]:
            return False
        log.info("child objects: deleting (kind=%s name=%s)", kind.name, body["metadata"]["name"])
        if kind is kinds.DEPLOYMENT:
            await self._delete_secret_of(body)
        self._normalised.pop((kind, key_of(body)), None)
        self._taken.discard((kind, key_of(body)))
        return await self._store.delete(kind, key_of(body), body["metadata"].get("uid"), orphan=orphan)

    async def _delete_secret_of(self, deployment: Body) -> None:
        """Delete the Secret of a Deployment that is about to be deleted. Its name is derived from the Deployment.

        A failure does not prevent the deletion of the Deployment. A running pod keeps its mounted Secret.
        """
        namespace, instance = key_of(deployment)
        secret = namespace, secret_name(instance)
        try:
            await self._store.delete(kinds.SECRET, secret)
        except KubeError as error:
            log.debug("child objects: Secret not deleted yet (secret=%s/%s error=%s)", *secret, error)
            self._undeleted_secrets.setdefault(application_label_key(deployment), set()).add(secret)

    async def _delete_remaining_secrets(self, application: Key) -> None:
        """Delete the Secrets that could not be deleted together with their Deployments.

        Raises:
            KubeError: The API server still refuses the deletion, or cannot be reached.
        """
        remaining = self._undeleted_secrets.get(label_key(application), set())
        for secret in list(remaining):
            await self._store.delete(kinds.SECRET, secret)
            remaining.discard(secret)
        if not remaining:
            self._undeleted_secrets.pop(label_key(application), None)


def _versions(desired: Body, observed: Body) -> tuple[object, ...]:
    """Return the digest of a stamped object, and uid and version of an observed object. Changes of the status change neither."""
    metadata = observed["metadata"]
    digest = desired["metadata"]["annotations"][DIGEST_ANNOTATION]
    return (digest, metadata.get("uid"), metadata.get("generation") or metadata.get("resourceVersion"))


def _check_owner(application: Application, kind: Kind, observed: Body) -> None:
    """Check that an object belongs to this Application.

    Raises:
        NameTaken: The object belongs to another owner.
    """
    if not _is_child(application, kind, observed):
        name = observed["metadata"]["name"]
        raise NameTaken(f"{kind.name} {name} exists but does not belong to this Application; rename one of them")


def _is_child(application: Application, kind: Kind, body: Body) -> bool:
    if not kind.namespaced:
        owner = body.get("spec", {}).get("application", {})
        return bool(owner.get("uid") == application.metadata.uid)
    owners = body["metadata"].get("ownerReferences") or ()
    return any(owner.get("uid") == application.metadata.uid for owner in owners)


def _is_managed(endpoint_slice: Body) -> bool:
    """Return True if the operator manages an EndpointSlice. Slices of Kubernetes also have the labels of their Service."""
    return bool(endpoint_slice["metadata"]["labels"].get(SLICE_LABEL) == SLICES_BY)


def _parse_grant(observed: Body) -> Grant | None:
    try:
        return parse_object(Grant, observed)
    except InvalidObject:
        return None


def _is_equal(observed: Body, present: Grant | None, desired: Body) -> bool:
    """Return True if a Grant has the desired content in another serialization, as another release may write it."""
    if present is None or not contains(observed["metadata"].get("labels"), desired["metadata"]["labels"]):
        return False
    return present.spec.unsigned == parse_object(Grant, desired).spec
