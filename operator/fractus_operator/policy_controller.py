"""Controller of Zones and Policies: reports objects that cannot be enforced, and policies that are probably mistakes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from datetime import datetime

from fractus_core.api import Condition, InvalidObject, Policy, Zone
from fractus_core.api.conditions import ConditionUpdate, merge_conditions
from fractus_core.planning.grant_compiler import check_united, validated
from fractus_core.plausibility import far_zones
from fractus_core.validation import check_policy, check_zone

from fractus_operator.cache import ClusterCache
from fractus_operator.kinds import POLICY, ZONE, Key, Kind
from fractus_operator.parsing import Unreadable
from fractus_operator.status_reporter import create_events
from fractus_operator.store import Conflict, NotFound, Store


class PolicyController:
    """Writes the conditions of Zones and Policies.

    `Ready` is True if the object can be enforced. A Policy has `FarFromDepots` if its zones are far from every depot. Such
    a policy is enforced.
    """

    def __init__(self, store: Store, cache: ClusterCache, clock: Callable[[], datetime]) -> None:
        self._store = store
        self._cache = cache
        self._clock = clock

    async def reconcile_zone(self, key: Key) -> None:
        """Check the rules of one Zone that its schema cannot express."""
        zone = self._cache.zones.get(key)
        if zone is not None:
            await self._report(ZONE, zone, [self._check_zone(zone)])

    async def reconcile_policy(self, key: Key) -> None:
        """Check the rules of one Policy that its schema cannot express.

        A Policy is ready if all of its Zones are ready.
        """
        policy = self._cache.policies.get(key)
        if policy is not None:
            await self._report(POLICY, policy, [self._check_policy(policy), *self._far_from_depots(policy)])

    def policies_of(self, zone: str) -> Sequence[Key]:
        """Return the Policies that select a Zone."""
        return [
            key
            for key, policy in self._cache.policies.items()
            if isinstance(policy, Policy) and zone in policy.spec.selector.zones
        ]

    def policies_with_zones(self) -> Sequence[Key]:
        """Return the Policies that select a Zone, whose distance from a depot may have changed."""
        return [
            key
            for key, policy in self._cache.policies.items()
            if isinstance(policy, Policy) and policy.spec.selector.zones
        ]

    def _check_zone(self, zone: Zone | Unreadable) -> ConditionUpdate:
        if isinstance(zone, Unreadable):
            return ConditionUpdate("Ready", "False", "Invalid", zone.problem)
        try:
            check_zone(zone)
        except InvalidObject as error:
            return ConditionUpdate("Ready", "False", "Invalid", str(error))
        return ConditionUpdate("Ready", "True", "Valid", "the zone can be enforced")

    def _check_policy(self, policy: Policy | Unreadable) -> ConditionUpdate:
        if isinstance(policy, Unreadable):
            return ConditionUpdate("Ready", "False", "Invalid", policy.problem)
        zones = {zone.name: zone for zone in self._cache.zones.values()}
        try:
            check_policy(policy, zones.keys())
        except InvalidObject as error:
            reason = "AttributeUnknown" if ".nodes[" in error.field else "ZoneMissing"
            return ConditionUpdate("Ready", "False", reason, str(error))
        for i, name in enumerate(policy.spec.selector.zones):
            update = self._check_zone(zones[name])
            if update.status != "True":
                message = f"spec.selector.zones[{i}]: Zone {name}: {update.message}"
                return ConditionUpdate("Ready", "False", "ZoneInvalid", message)
        selected = [zones[name] for name in dict.fromkeys(policy.spec.selector.zones)]
        try:
            check_united(policy, [validated(zone) for zone in selected if isinstance(zone, Zone)])
        except InvalidObject as error:
            return ConditionUpdate("Ready", "False", "ZoneInvalid", str(error))
        return ConditionUpdate("Ready", "True", "Valid", "the policy can be enforced")

    def _far_from_depots(self, policy: Policy | Unreadable) -> Iterator[ConditionUpdate]:
        if isinstance(policy, Unreadable):
            return
        selected = (self._cache.zones.get(("", name)) for name in policy.spec.selector.zones)
        zones = [zone for zone in selected if isinstance(zone, Zone)]
        if far := far_zones(zones, self._cache.depots_by_name().values()):
            yield ConditionUpdate("FarFromDepots", "True", "ZonesFar", f"spec.selector.zones: {far}", adverse=True)

    async def _report(
        self, kind: Kind, resource: Zone | Policy | Unreadable, updates: Sequence[ConditionUpdate]
    ) -> None:
        now = self._clock()
        generation = resource.metadata.generation
        before = _conditions(resource)
        conditions, transitions = merge_conditions(before, updates, generation, now)
        if conditions == before:
            return
        body = kind.header(resource.name, uid=resource.metadata.uid)
        body["status"] = {"observedGeneration": generation, "conditions": [c.to_dict() for c in conditions]}
        try:
            await self._store.apply(kind, body, subresource="status")
        except (Conflict, NotFound):
            return
        regarding = kind.header(resource.name, uid=resource.metadata.uid)
        await create_events(self._store, regarding, (update for update in transitions if update.warning), now)


def _conditions(resource: Zone | Policy | Unreadable) -> tuple[Condition, ...]:
    if isinstance(resource, Unreadable):
        return resource.conditions
    return resource.status.conditions if resource.status is not None else ()
