"""Rollout of a plan: applies the child objects of an Application in order, and later updates addresses and certificates."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from functools import partial

from fractus_core.api import Application, InvalidObject
from fractus_core.api.geometry import Position
from fractus_core.api.grants import GrantSpec
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.identity.authority import Authority
from fractus_core.planning.link_planning import flown_path, plan_links

from fractus_operator import kinds
from fractus_operator.bookings import ByName
from fractus_operator.cache import ClusterCache
from fractus_operator.child_objects import ChildObjects
from fractus_operator.comparison import contains
from fractus_operator.kinds import Body, Key, key_of
from fractus_operator.labels import CAUSE_ANNOTATION, CERTIFICATE_ANNOTATION, COMPONENT_LABEL
from fractus_operator.parsing import Submitted
from fractus_operator.pods import PodView
from fractus_operator.replanning import mission_changed, of_generation
from fractus_operator.resources.children import children, deployment_plan
from fractus_operator.resources.direct_link import direct_links, retargeted
from fractus_operator.resources.secret import Certificate, Certificates
from fractus_operator.resources.service import endpoints
from fractus_operator.store import KubeError

log = logging.getLogger(__name__)

_AFTER_DEPLOYMENTS = (
    kinds.SERVICE,
    kinds.ENDPOINT_SLICE,
    kinds.NETWORK_POLICY,
    kinds.DIRECT_LINK,
    kinds.DISRUPTION_BUDGET,
)


class Rollout:
    """Applies the child objects of Applications.

    The order is: plan, deletion of stale objects, Grants, new Secrets, Deployments, other Secrets, other objects. Grants come first,
    so that a webhook that does not respond to other kinds does not delay a revocation. The Secret of a new Deployment comes before
    it, because its pod could not mount a missing Secret.

    Args:
        objects: Writes the child objects.
        cache: Observed objects.
        authority: Signs the certificates of instances.
        clock: Returns the current time.
        gateway_image: Image of the sidecar of MAVLink programs.

    Attributes:
        in_progress: Number of Applications that are being rolled out.
    """

    def __init__(
        self,
        objects: ChildObjects,
        cache: ClusterCache,
        authority: Authority,
        clock: Callable[[], datetime],
        gateway_image: str,
    ) -> None:
        self._objects = objects
        self._gateway_image = gateway_image
        self._cache = cache
        self._certificates = Certificates(authority, clock)
        self.in_progress = 0

    async def apply(
        self,
        application: Application,
        plan: DeploymentPlanSpec,
        grants: Sequence[GrantSpec],
        pods: Sequence[PodView],
        rules: int,
    ) -> bool:
        """Apply a plan with its Grants. A failure does not stop later steps. The first failure is raised at the end.

        Args:
            application: The Application.
            plan: Its plan.
            grants: Grants of its instances.
            pods: Its current pods.
            rules: Revision of the inputs of the Grants. No new Grant is created if there is a later revision.

        Returns:
            True if everything was applied. False if new Grants must be compiled again first.

        Raises:
            NameTaken: An object of another owner has the name of a child object.
            KubeError: The API server refused an object, or could not be reached.
        """
        desired = children(application, plan, grants, pods, self._cache.drone, gateway_image=self._gateway_image)
        desired[kinds.DIRECT_LINK] = self._links(application, plan, pods)
        certificates = self._certificates_of(application, plan, pods)
        for body in desired[kinds.DEPLOYMENT]:
            annotation = certificates[body["metadata"]["name"]].annotation
            if annotation:
                body["metadata"]["annotations"][CERTIFICATE_ANNOTATION] = annotation
        self.in_progress += 1
        try:
            # The plan records which Application flies the drone, also after a crash. So it comes first.
            await self._objects.apply(application, {kinds.DEPLOYMENT_PLAN: desired[kinds.DEPLOYMENT_PLAN]})
            await self._objects.prune(application, desired)
            # If the rules changed meanwhile, only existing Grants are applied. The next step compiles all Grants again.
            current = rules == self._cache.rules_revision
            granted = {
                kinds.GRANT: [
                    body
                    for body in desired[kinds.GRANT]
                    if current or self._objects.get(kinds.GRANT, key_of(body)) is not None
                ]
            }
            deployments = {
                kinds.DEPLOYMENT: [body for body in desired[kinds.DEPLOYMENT] if not self._is_frozen(body, plan)]
            }
            last = {kind: desired[kind] for kind in _AFTER_DEPLOYMENTS}
            failures: list[Exception] = []
            for step in (
                partial(self._objects.apply, application, granted),
                partial(self._create_secrets, application, certificates),
                partial(self._objects.apply, application, deployments),
                # Only for existing Deployments. If the name of a Deployment is taken by another owner, the name of the
                # Secret may be taken as well.
                partial(self._write_secrets, application, certificates),
                partial(self._objects.apply, application, last),
            ):
                try:
                    await step()
                except Exception as error:
                    failures.append(error)
            if failures:
                raise failures[0]
        finally:
            self.in_progress -= 1
        return current

    async def keep_plan(self, submitted: Submitted, plan: DeploymentPlanSpec) -> None:
        """Store the plan of a finished mission, which records its outcome.

        If the manifest describes the same mission, the plan becomes the plan of the Application's current generation.

        Raises:
            NameTaken: An object of another owner has its name.
            KubeError: The API server refused it, or could not be reached.
        """
        application = submitted.application
        if application is None:
            observed = self._objects.get(kinds.DEPLOYMENT_PLAN, submitted.key)
            fields = {"spec": {"flown": plan.to_dict()["flown"]}}
            if observed is not None and not contains(observed, fields):
                await self._objects.change(kinds.DEPLOYMENT_PLAN, observed, fields)
            self._cache.plans.forget(submitted.key)
            return
        kept = plan if mission_changed(application, plan) else of_generation(application, plan)
        await self._objects.apply(application, {kinds.DEPLOYMENT_PLAN: [deployment_plan(application, kept)]})
        if kept is not self._cache.plans.latest(submitted.key, submitted.uid):
            self._cache.plans.decide(submitted.key, submitted.uid, kept)

    def forget(self, key: Key) -> None:
        """Drop the state of a deleted Application."""
        self._certificates.forget(key)

    def _is_frozen(self, desired: Body, plan: DeploymentPlanSpec) -> bool:
        """Return True if a Deployment must not change: its drone flies, and its part of the manifest is unchanged.

        Otherwise, an upgrade of the operator that builds pods differently would restart a driver in flight.
        """
        drone = self._cache.fleet.drone_in_flight(plan)
        observed = self._objects.get(kinds.DEPLOYMENT, key_of(desired))
        if drone is None or observed is None:
            return False
        cause = str(desired["metadata"]["annotations"][CAUSE_ANNOTATION])
        present = (observed["metadata"].get("annotations") or {}).get(CAUSE_ANNOTATION)
        return cause == present and cause.rpartition("@")[2] == drone

    def _links(self, application: Application, plan: DeploymentPlanSpec, pods: Sequence[PodView]) -> list[Body]:
        """Return the DirectLinks of a plan.

        Links to a new Service follow in the next step, when the Service has an address.
        """
        if plan.drone is None:
            return []
        planned = plan_links(application, plan, self._cache.drone(plan.drone.node), ByName(self._cache.edge_nodes))
        flying: Application | None = application
        if plan.drone.shared_with is not None:
            host, _ = self._cache.plans.flight_host(plan)
            flying = host.application if host is not None else None
        path: tuple[Position, ...] = ()
        if flying is not None and planned:
            # If the depot was deleted, agents predict the route from the velocity of the drone.
            with suppress(InvalidObject):
                path = flown_path(flying.spec, self._cache.depots_by_name())
        namespace, _ = application.key

        def cluster_ip(service: str) -> str | None:
            body = self._objects.get(kinds.SERVICE, (namespace, service))
            return body["spec"].get("clusterIP") if body is not None else None

        return direct_links(application, plan, planned, path, pods, cluster_ip=cluster_ip)

    async def keep_running(
        self, key: Key, application: Application | None, plan: DeploymentPlanSpec, pods: Sequence[PodView]
    ) -> None:
        """Update addresses and certificates of a running plan while the next step is blocked, which may last for days.

        Raises:
            KubeError: The API server refused a change of addresses, or could not be reached.
        """
        await self.update_addresses(key, plan, pods)
        try:
            if application is not None:
                await self.renew_certificates(application, plan, pods)
        except KubeError as error:
            if not error.status:
                raise
            log.warning("rollout: certificates not renewed (application=%s/%s error=%s)", *key, error)

    async def update_addresses(self, key: Key, plan: DeploymentPlanSpec, pods: Sequence[PodView]) -> None:
        """Update only the addresses of pods in EndpointSlices and DirectLinks.

        Raises:
            KubeError: The API server refused a change, or could not be reached.
        """
        for body in self._objects.of(key, kinds.ENDPOINT_SLICE):
            component = body["metadata"]["labels"].get(COMPONENT_LABEL, "")
            present = endpoints(component, plan, pods)
            if not contains(body.get("endpoints"), present):
                await self._objects.change(kinds.ENDPOINT_SLICE, body, {"endpoints": present})
        for body in self._objects.of(key, kinds.DIRECT_LINK):
            services = body["spec"].get("services") or []
            present = retargeted(services, pods)
            if present != services:
                await self._objects.change(kinds.DIRECT_LINK, body, {"spec": {"services": present}})

    async def renew_certificates(
        self, application: Application, plan: DeploymentPlanSpec, pods: Sequence[PodView]
    ) -> None:
        """Renew only the certificates of a running plan.

        Raises:
            KubeError: The API server refused a write, or could not be reached.
        """
        await self._write_secrets(application, self._certificates_of(application, plan, pods))

    def _certificates_of(
        self, application: Application, plan: DeploymentPlanSpec, pods: Sequence[PodView]
    ) -> dict[str, Certificate]:
        """Return the certificates of all instances of a plan."""
        namespace, _ = application.key
        certificates = {}
        for placed in plan.placements:
            deployment = self._objects.get(kinds.DEPLOYMENT, (namespace, placed.instance))
            certificates[placed.instance] = self._certificates.of(application, placed, deployment, pods)
        return certificates

    async def _create_secrets(self, application: Application, certificates: dict[str, Certificate]) -> None:
        """Create the Secrets of Deployments that do not exist yet. Created ones are removed from `certificates`.

        A Secret that exists already may belong to another owner, and a refused one is written again after its Deployment.
        """
        namespace, _ = application.key

        async def create(instance: str, certificate: Certificate) -> None:
            exists = self._objects.get(kinds.DEPLOYMENT, (namespace, instance)) is not None
            if certificate.secret is None or exists or certificate.state.write_failed:
                return
            certificate.state.write_failed = True
            if await self._objects.create_secret(certificate.secret):
                certificate.state.write_failed = False
                del certificates[instance]

        await asyncio.gather(*(create(*each) for each in list(certificates.items())))

    async def _write_secrets(self, application: Application, certificates: Mapping[str, Certificate]) -> None:
        """Write the due Secrets of existing Deployments. A failure does not stop the others. Raise the first failure at the end."""
        namespace, _ = application.key

        async def write(instance: str, certificate: Certificate) -> None:
            key = (namespace, instance)
            if certificate.secret is None or self._objects.get(kinds.DEPLOYMENT, key) is None:
                return
            certificate.state.write_failed = True
            written = await self._objects.write_secret(application, instance, certificate.secret, certificate.reason)
            certificate.state.write_failed = False
            deployment = self._objects.get(kinds.DEPLOYMENT, key)
            if written and certificate.renewed_annotation and deployment is not None:
                annotations = {CERTIFICATE_ANNOTATION: certificate.renewed_annotation}
                await self._objects.change(kinds.DEPLOYMENT, deployment, {"metadata": {"annotations": annotations}})

        writes = (write(instance, certificate) for instance, certificate in certificates.items())
        for result in await asyncio.gather(*writes, return_exceptions=True):
            if isinstance(result, BaseException):
                raise result
