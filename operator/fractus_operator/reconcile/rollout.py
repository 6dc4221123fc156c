"""How a plan becomes objects: the order in which an application's children are applied, and which are left alone."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime

from fractus_core.api import Application, InvalidObject
from fractus_core.api.grants import GrantSpec
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.identity.authority import Authority
from fractus_core.planning.link_planning import flown_path, plan_links

from fractus_operator.cluster import kinds
from fractus_operator.cluster.kinds import Body, Key, Kind, key_of
from fractus_operator.cluster.labels import CAUSE_ANNOTATION, CERTIFICATE_ANNOTATION, COMPONENT_LABEL
from fractus_operator.cluster.pods import PodView
from fractus_operator.cluster.store import KubeError
from fractus_operator.inventory.bookings import ByName
from fractus_operator.inventory.live import LiveInventory
from fractus_operator.reconcile import builders
from fractus_operator.reconcile.certificates import Certificate, Certificates
from fractus_operator.reconcile.children import Children, every
from fractus_operator.reconcile.difference import contains
from fractus_operator.reconcile.isolation import network_policies
from fractus_operator.reconcile.links import direct_links, retargeted
from fractus_operator.reconcile.replanning import of_generation

logger = logging.getLogger(__name__)

_HEAD_START_S = 0.5
"""How long Deployments go first at most, where there are new ones: neither a webhook that holds them up nor pods that no node
takes delay a Grant for longer."""

_LAST = (kinds.SERVICE, kinds.ENDPOINT_SLICE, kinds.NETWORK_POLICY, kinds.DIRECT_LINK, kinds.DISRUPTION_BUDGET)


class Rollout:
    """Makes an application's children what its plan says.

    Deployments go first: until their pods have nodes, nothing else that is new takes the API server from the scheduler.
    A pod starts without the rest, which takes longer than applying it, but can call nothing before it has its Grant.
    """

    def __init__(
        self, children: Children, live: LiveInventory, authority: Authority, clock: Callable[[], datetime]
    ) -> None:
        self._children = children
        self._live = live
        self._certificates = Certificates(authority, clock)
        self.under_way = 0
        """How many applications are being rolled out."""

    async def carry_out(
        self,
        application: Application,
        decided: DeploymentPlanSpec,
        grants: Sequence[GrantSpec],
        pods: Sequence[PodView],
        rules: int,
    ) -> bool:
        """Write the plan, remove what is stale, then make the Deployments and the rest.

        Args:
            application: Whose plan it is.
            decided: The plan.
            grants: What its instances may do.
            pods: Its pods as they are.
            rules: The revision of the rules that the grants are made of; no new one is made once there is a later one.

        Returns:
            Whether that is all; else some grants are left to the next reconcile.

        Raises:
            NameTaken: another's object has the name of a child.
            KubeError: the API server refuses one, or cannot be reached.
        """
        self.under_way += 1
        try:
            return await self._carry_out(application, decided, grants, pods, rules)
        finally:
            self.under_way -= 1

    async def _carry_out(
        self,
        application: Application,
        decided: DeploymentPlanSpec,
        grants: Sequence[GrantSpec],
        pods: Sequence[PodView],
        rules: int,
    ) -> bool:
        wanted = builders.children(application, decided, grants, pods, self._live.drone)
        wanted[kinds.NETWORK_POLICY] = network_policies(application, decided)
        wanted[kinds.DIRECT_LINK] = self._links(application, decided, pods)
        certificates = self._certified(application, decided, pods)
        for body in wanted[kinds.DEPLOYMENT]:
            body["metadata"]["annotations"] |= _noted(certificates[body["metadata"]["name"]])
        # The plan before all else: it tells, also after a crash, which application flies the drone and which share its flight.
        await self._children.apply(application, {kinds.DEPLOYMENT_PLAN: wanted[kinds.DEPLOYMENT_PLAN]})
        await self._children.prune(application, wanted)
        running = [body for body in wanted[kinds.DEPLOYMENT] if not self._is_in_flight(body, decided)]
        starts = not all(self._is_there(kinds.DEPLOYMENT, body) for body in running)
        granted = [body for body in wanted[kinds.GRANT] if self._is_there(kinds.GRANT, body)]
        # What is granted already may have to shrink: it waits for nothing.
        first = {kinds.GRANT: granted, kinds.DEPLOYMENT: running}
        made = asyncio.ensure_future(self._children.apply(application, first))

        async def beside() -> None:
            await asyncio.wait({made}, timeout=_HEAD_START_S)
            # Without its Deployment an instance waits for no certificate; where that is another's, its Secret may be, too.
            await self._write(application, certificates, of_all=not made.done())

        async def after() -> bool:
            if starts:
                await self._scheduled(application.key, decided, made, rules)
            last = {kind: wanted[kind] for kind in _LAST}
            # One that leads nowhere yet would only be made to be changed, which takes three times as many requests.
            last[kinds.ENDPOINT_SLICE] = [
                body
                for body in wanted[kinds.ENDPOINT_SLICE]
                if body["endpoints"] or self._is_there(kinds.ENDPOINT_SLICE, body)
            ]
            # Rules that changed meanwhile are in no Grant that was compiled before.
            valid = rules == self._live.rules_revision
            if valid:
                last = {kinds.GRANT: [body for body in wanted[kinds.GRANT] if body not in granted], **last}
            await self._children.apply(application, last)
            return valid

        # All have ended when the next reconcile begins, and one that fails stops no other.
        results = await asyncio.gather(made, beside(), after(), return_exceptions=True)
        for result in results:
            if isinstance(result, BaseException):
                raise result
        return results[2] is True

    async def keep(self, application: Application, plan: DeploymentPlanSpec) -> None:
        """Keep the plan of a mission that is over as that of the application's present generation.

        Raises:
            NameTaken: another's object has its name.
            KubeError: the API server refuses it, or cannot be reached.
        """
        kept = of_generation(application, plan)
        if kept is not plan:
            self._live.plans.decide(application.key, application.metadata.uid or "", kept)
            await self._children.apply(
                application, {kinds.DEPLOYMENT_PLAN: [builders.deployment_plan(application, kept)]}
            )

    def forget(self, key: Key) -> None:
        """An application is gone."""
        self._certificates.forget(key)

    def _is_there(self, kind: Kind, body: Body) -> bool:
        return self._children.get(kind, key_of(body)) is not None

    async def _scheduled(self, key: Key, decided: DeploymentPlanSpec, made: asyncio.Future[None], rules: int) -> None:
        """Wait until every pod of a plan has its node, or will get none: the head start at most, and not once rules change."""
        with self._live.subscriptions.subscribe(key) as inputs, contextlib.suppress(TimeoutError):
            made.add_done_callback(lambda _: inputs.wake())
            async with asyncio.timeout(_HEAD_START_S):
                while rules == self._live.rules_revision and not (made.done() and made.exception()):
                    nodes = Counter(pod.instance for pod in self._live.pods_of(key) if pod.node is not None)
                    if all(nodes[placed.instance] >= placed.replicas for placed in decided.placements):
                        return
                    await inputs.changed(_HEAD_START_S)

    def _is_in_flight(self, desired: Body, decided: DeploymentPlanSpec) -> bool:
        """Whether a Deployment is left alone: its drone flies, and the application's manifest asks for no change.

        So no upgrade of the operator, which may build pods in another way, restarts a driver in flight.
        """
        drone = self._live.fleet.in_flight(decided)
        observed = self._children.get(kinds.DEPLOYMENT, key_of(desired))
        if drone is None or observed is None:
            return False
        cause = str(desired["metadata"]["annotations"][CAUSE_ANNOTATION])
        present = (observed["metadata"].get("annotations") or {}).get(CAUSE_ANNOTATION)
        return cause == present and cause.rpartition("@")[2] == drone

    def _links(self, application: Application, decided: DeploymentPlanSpec, pods: Sequence[PodView]) -> list[Body]:
        """The direct links of a plan. A Service that is only made now has an address, and its links, in the next reconcile."""
        if decided.drone is None:
            return []
        planned = plan_links(application, decided, self._live.drone(decided.drone.node), ByName(self._live.edge_nodes))
        flying: Application | None = application
        if decided.drone.shared_with is not None:
            host, _ = self._live.plans.host_of(decided)
            flying = host.application if host is not None else None
        try:
            path = flown_path(flying.spec, self._live.depots_by_name()) if flying is not None and planned else ()
        except InvalidObject:
            # The depot is gone: the drone's velocity tells where it goes.
            path = ()
        namespace, _ = application.key

        def cluster_ip(service: str) -> str | None:
            body = self._children.get(kinds.SERVICE, (namespace, service))
            return body["spec"].get("clusterIP") if body is not None else None

        return direct_links(application, decided, planned, path, pods, cluster_ip=cluster_ip)

    async def keep_running(
        self, key: Key, application: Application | None, plan: DeploymentPlanSpec, pods: Sequence[PodView]
    ) -> None:
        """Renew what runs by a plan, addresses and certificates, where the next step has to wait: for days, if need be.

        Raises:
            KubeError: the API server refuses a change of addresses, or cannot be reached.
        """
        await self.follow_pods(key, plan, pods)
        try:
            if application is not None:
                await self.renew_certificates(application, plan, pods)
        except KubeError as error:
            if not error.status:
                raise
            logger.warning("rollout: certificates not renewed (application=%s/%s): %s", *key, error)

    async def follow_pods(self, key: Key, plan: DeploymentPlanSpec, pods: Sequence[PodView]) -> None:
        """Bring the addresses in what was rolled out up to date with the pods, which may restart, and change nothing else.

        Raises:
            KubeError: the API server refuses a change, or cannot be reached.
        """
        for body in self._children.of(key, kinds.ENDPOINT_SLICE):
            component = body["metadata"]["labels"].get(COMPONENT_LABEL, "")
            present = builders.endpoints(builders.base_pods(component, plan, pods))
            if not contains(body.get("endpoints"), present):
                await self._children.change(kinds.ENDPOINT_SLICE, body, {"endpoints": present})
        for body in self._children.of(key, kinds.DIRECT_LINK):
            services = body["spec"].get("services") or []
            present = retargeted(services, pods)
            if present != services:
                await self._children.change(kinds.DIRECT_LINK, body, {"spec": {"services": present}})

    async def renew_certificates(
        self, application: Application, plan: DeploymentPlanSpec, pods: Sequence[PodView]
    ) -> None:
        """Renew the certificates of what runs by a plan, and change nothing else.

        Raises:
            KubeError: the API server refuses one, or cannot be reached.
        """
        await self._write(application, self._certified(application, plan, pods), of_all=False)

    def _certified(
        self, application: Application, plan: DeploymentPlanSpec, pods: Sequence[PodView]
    ) -> dict[str, Certificate]:
        """The certificates of all instances of a plan."""
        namespace, _ = application.key

        def deployment(instance: str) -> Body | None:
            return self._children.get(kinds.DEPLOYMENT, (namespace, instance))

        return {
            placed.instance: self._certificates.of(application, placed, deployment(placed.instance), pods)
            for placed in plan.placements
        }

    async def _write(self, application: Application, certificates: Mapping[str, Certificate], *, of_all: bool) -> None:
        """Write the Secrets that are due, and then what their Deployments say of them; one that fails stops no other.

        Args:
            application: Whose they are.
            certificates: By instance.
            of_all: Also of instances whose Deployments are not there yet.
        """
        namespace, _ = application.key
        due = [
            (instance, certificate)
            for instance, certificate in certificates.items()
            if certificate.secret is not None
            and (of_all or self._children.get(kinds.DEPLOYMENT, (namespace, instance)) is not None)
        ]
        await every(self._write_one(application, *one) for one in due)

    async def _write_one(self, application: Application, instance: str, certificate: Certificate) -> None:
        assert certificate.secret is not None
        with self._certificates.written(application.key, instance):
            written = await self._children.write_secret(application, instance, certificate.secret, certificate.why)
        observed = self._children.get(kinds.DEPLOYMENT, (application.key[0], instance))
        if written and certificate.public and observed is not None:
            said = {"annotations": {CERTIFICATE_ANNOTATION: certificate.public}}
            await self._children.change(kinds.DEPLOYMENT, observed, {"metadata": said})


def _noted(certificate: Certificate) -> dict[str, str]:
    """What a Deployment says of its instance's certificate."""
    return {CERTIFICATE_ANNOTATION: certificate.noted} if certificate.noted else {}
