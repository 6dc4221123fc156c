"""Restrictions: a Policy and its Zone as one resource, without a state of its own.

The name of the Zone is derived from its content. A change writes another Zone, lets the Policy select this Zone, and then deletes
the previous Zone. Therefore the write of the Policy is the only step with an effect, and nodes enforce either the earlier
or the later restriction. An interrupted request leaves at most a Zone that no Policy selects. The same request
uses this Zone, and each later write or deletion of the restriction removes it.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable
from dataclasses import dataclass
from http import HTTPStatus

from fractus_core.api import GROUP, Policy, Zone
from fractus_core.api.policies import PolicySpec, ZoneSpec
from fractus_runtime.kubernetes import Body, Client, Conflict, KubeError, NotFound

from fractus_management.api_server import kind_of
from fractus_management.preconditions import check_version
from fractus_management.problem_details import refused

log = logging.getLogger(__name__)

POLICY = kind_of(Policy)
ZONE = kind_of(Zone)

RESTRICTION = f"{GROUP}/restriction"
"""Label of the Policy and the Zone of a restriction: its name."""

_SELECTED_BY = f"{GROUP}/selected-by"
"""Annotation of a Zone: resourceVersion of the Policy that selected it last. It makes every selection a change of the Zone."""

_WRITE_ATTEMPTS = 5


@dataclass(frozen=True, slots=True)
class Stored:
    """A restriction at the API server.

    Attributes:
        policy: The Policy.
        zone: The Zone that the Policy selects; None: it was deleted by another client.
    """

    policy: Body
    zone: Body | None

    @property
    def etag(self) -> str:
        """Version of the content. Reports of the operator do not change it."""
        metadata = self.policy["metadata"]
        zone_generation = self.zone["metadata"]["generation"] if self.zone is not None else 0
        return f'"{metadata["uid"]}-{metadata["generation"]}-{zone_generation}"'

    def public(self) -> Body:
        """Return the restriction as in responses. The Policy does not name its Zone."""
        spec = self.policy["spec"]
        selector = {field: value for field, value in spec["selector"].items() if field != "zones"}
        body: Body = {"name": self.policy["metadata"]["name"], "policy": {**spec, "selector": selector}}
        if self.zone is not None:
            body["zone"] = self.zone["spec"]
        if self.policy.get("status"):
            body["status"] = self.policy["status"]
        return body


async def stored(client: Client, policy: Body) -> Stored:
    """Return the restriction of a Policy with its Zone."""
    try:
        zone = await client.get(ZONE, policy["spec"]["selector"]["zones"][0])
    except NotFound:
        zone = None
    return Stored(policy, zone)


async def read(client: Client, name: str) -> Stored:
    """Return a restriction.

    Raises:
        NotFound: There is no such restriction.
    """
    try:
        policy = await client.get(POLICY, name)
    except NotFound:
        raise _missing(name) from None
    if not is_restriction(policy):
        raise _missing(name)
    return await stored(client, policy)


async def create(client: Client, name: str, zone: ZoneSpec, policy: PolicySpec) -> Stored:
    """Create a restriction, or return the present one if it has the same content.

    Raises:
        Refused: A Policy of this name has other content.
        KubeError: The API server refused the request.
    """
    body = _policy_body(name, zone, policy)
    try:
        # A refused request writes nothing.
        await client.request("POST", POLICY.path(), body, params={"dryRun": "All", "fieldValidation": "Strict"})
        await _write_zone(client, name, zone)
        written = await client.create(POLICY, body)
    except Conflict as conflict:
        written = await client.get(POLICY, name)
        if not is_restriction(written) or Policy.from_body(written).spec.to_dict() != body["spec"]:
            await _clean_up(client, name)
            message = (
                f"the name {name} belongs to a Policy with other content; use another name, or change the restriction"
            )
            raise refused(HTTPStatus.CONFLICT, "AlreadyExists", message, "name") from conflict
    return await _completed(client, name, zone, written)


async def change(
    client: Client, name: str, if_match: str, change_specs: Callable[[Body], tuple[ZoneSpec, PolicySpec]]
) -> Stored:
    """Change a restriction.

    Args:
        client: Connection with the permissions of the caller.
        name: Name of the restriction.
        if_match: Header If-Match.
        change_specs: Returns the new specifications. Its argument is the restriction as in responses.

    Raises:
        InvalidObject: The change is invalid.
        Refused: The restriction has another version.
        KubeError: The API server refused the change, or there is no such restriction.
    """
    for _ in range(_WRITE_ATTEMPTS):
        present = await read(client, name)
        check_version(if_match, present.etag)
        zone, policy = change_specs(present.public())
        body = _policy_body(name, zone, policy)
        await _write_zone(client, name, zone)
        try:
            written = await client.replace(POLICY, {**present.policy, "spec": body["spec"]})
        except Conflict:
            # Another client, or the status of the operator. The next attempt compares the versions.
            continue
        except KubeError:
            await _clean_up(client, name)
            raise
        return await _completed(client, name, zone, written)
    raise refused(HTTPStatus.CONFLICT, "Conflict", "other writers change the restriction all the time; try again")


async def delete(client: Client, name: str, if_match: str) -> None:
    """Delete a restriction, also the rest of one that was deleted or created in part.

    Raises:
        Refused: The restriction has another version.
        KubeError: The API server refused the request, or there is no such restriction.
    """
    for _ in range(_WRITE_ATTEMPTS):
        try:
            present = await read(client, name)
        except NotFound:
            if not await _remove_unselected(client, name):
                raise
            return
        check_version(if_match, present.etag)
        try:
            await _delete(client, POLICY.path("", name), present.policy)
        except Conflict:
            continue
        await _remove_unselected(client, name)
        return
    raise refused(HTTPStatus.CONFLICT, "Conflict", "other writers change the restriction all the time; try again")


async def _completed(client: Client, name: str, zone: ZoneSpec, policy: Body) -> Stored:
    """Return a restriction after its Policy was written, with its Zone and without earlier Zones."""
    selected = await _write_zone(client, name, zone, policy)
    await _clean_up(client, name)
    return Stored(policy, selected)


def _policy_body(name: str, zone: ZoneSpec, policy: PolicySpec) -> Body:
    """Return the Policy of a restriction."""
    selector = policy.selector.model_copy(update={"zones": (_zone_name(name, zone),)})
    spec = policy.model_copy(update={"selector": selector})
    return _labelled(POLICY.header(name), name) | {"spec": spec.to_dict()}


def _zone_name(name: str, zone: ZoneSpec) -> str:
    content = json.dumps(zone.to_dict(), sort_keys=True)
    return f"{name}-{hashlib.sha256(content.encode()).hexdigest()[:10]}"


async def _write_zone(client: Client, name: str, zone: ZoneSpec, policy: Body | None = None) -> Body:
    """Create or complete a Zone.

    Args:
        client: Connection with the permissions of the caller.
        name: Name of the restriction.
        zone: Content of the Zone.
        policy: The Policy that has selected the Zone. The Zone is then deleted with it. This write also restores the Zone
            if a simultaneous request has removed it before the selection, and lets a later removal fail.
    """
    body = _labelled(ZONE.header(_zone_name(name, zone)), name)
    if policy is not None:
        metadata = policy["metadata"]
        body["metadata"]["annotations"] = {_SELECTED_BY: metadata["resourceVersion"]}
        body["metadata"]["ownerReferences"] = [
            {"apiVersion": POLICY.api_version, "kind": POLICY.name, "name": name, "uid": metadata["uid"]}
        ]
    return await client.apply(ZONE, body | {"spec": zone.to_dict()})


async def _remove_unselected(client: Client, name: str) -> int:
    """Delete the Zones of a restriction that its Policy does not select, and return their number.

    The Policy is read after the Zones. A Zone that is selected later is written again, so its deletion fails.
    """
    zones = await client.list(ZONE, selectors={"labelSelector": f"{RESTRICTION}={name}"})
    try:
        selected = (await client.get(POLICY, name))["spec"]["selector"].get("zones", ())
    except NotFound:
        selected = ()
    unselected = [zone for zone in zones if zone["metadata"]["name"] not in selected]
    for zone in unselected:
        try:
            await _delete(client, ZONE.path("", zone["metadata"]["name"]), zone)
        except Conflict:
            continue
    return len(unselected)


async def _clean_up(client: Client, name: str) -> None:
    """Remove Zones that are not selected any more. An error does not hide the result, because these Zones have no effect."""
    try:
        await _remove_unselected(client, name)
    except KubeError as error:
        log.info("management: zone not removed (restriction=%s error=%s)", name, error)


async def _delete(client: Client, path: str, version: Body) -> None:
    """Delete a version of an object. A missing object is not an error.

    Raises:
        Conflict: The object has another version.
    """
    metadata = version["metadata"]
    preconditions = {"uid": metadata["uid"], "resourceVersion": metadata["resourceVersion"]}
    try:
        await client.request("DELETE", path, {"propagationPolicy": "Background", "preconditions": preconditions})
    except NotFound:
        return


def _labelled(header: Body, name: str) -> Body:
    return {**header, "metadata": {**header["metadata"], "labels": {RESTRICTION: name}}}


def is_restriction(policy: Body) -> bool:
    """Return True if a Policy belongs to a restriction, and not only has its label."""
    labels = policy["metadata"].get("labels") or {}
    return bool(labels.get(RESTRICTION) == policy["metadata"]["name"] and policy["spec"]["selector"].get("zones"))


def _missing(name: str) -> NotFound:
    message = f"there is no restriction {name}; restrictions are listed at /v1/restrictions"
    return NotFound(HTTPStatus.NOT_FOUND, "NotFound", message)
