"""Builders of DirectLinks: the planned links of an Application with the current addresses of its pods and Services."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from fractus_core.api import Application
from fractus_core.api.direct_links import CallerAddress, DirectLinkSpec, LinkedService, TargetAddress, VirtualAddress
from fractus_core.api.geometry import Position
from fractus_core.api.grants import ApplicationReference
from fractus_core.api.names import object_name
from fractus_core.api.plans import DeploymentPlanSpec, PlannedInstance
from fractus_core.planning.link_planning import PlannedLink

from fractus_operator import kinds, labels
from fractus_operator.kinds import Body
from fractus_operator.labels import application_labels, service_name
from fractus_operator.pods import PodView


def direct_links(
    application: Application,
    plan: DeploymentPlanSpec,
    planned: Iterable[PlannedLink],
    path: tuple[Position, ...],
    pods: Sequence[PodView],
    *,
    cluster_ip: Callable[[str], str | None],
) -> list[Body]:
    """Return the DirectLinks of an Application. A link is omitted until its Services have addresses.

    Args:
        application: The Application.
        plan: Its plan.
        planned: Planned links.
        path: Planned path of its drone.
        pods: Its current pods.
        cluster_ip: Returns the cluster IP of a Service by name, or None if the Service has none yet.
    """
    bodies = []
    for link in planned:
        services = tuple(
            service for placed in link.instances for service in _services(application, plan, placed, pods, cluster_ip)
        )
        if services:
            bodies.append(_direct_link(application, link, path, services))
    return bodies


def link_name(namespace: str, application: str, drone: str, node: str) -> str:
    """Return the name of the DirectLink of an Application between two nodes."""
    return f"{namespace}.{object_name(application, drone, node)}"


def _direct_link(
    application: Application, link: PlannedLink, path: tuple[Position, ...], services: tuple[LinkedService, ...]
) -> Body:
    namespace, name = application.key
    spec = DirectLinkSpec(
        drone=link.drone,
        node=link.node,
        application=ApplicationReference(namespace=namespace, name=name, uid=application.metadata.uid or ""),
        technology=link.technology,
        pairing=link.pairing,
        range=link.range_m,
        bandwidth=link.bandwidth_mbps,
        position=link.position,
        heuristic=link.heuristic,
        path=path,
        services=services,
    )
    body = kinds.DIRECT_LINK.header(link_name(namespace, name, link.drone, link.node))
    body["metadata"]["labels"] = {**application_labels(application), labels.NAMESPACE_LABEL: namespace}
    body["spec"] = spec.to_dict()
    return body


def _services(
    application: Application,
    plan: DeploymentPlanSpec,
    placed: PlannedInstance,
    pods: Sequence[PodView],
    cluster_ip: Callable[[str], str | None],
) -> Iterable[LinkedService]:
    """Return the ports of an instance behind the address of its component's Service.

    Each port lists the instances on the drone that may call it, or None if every instance may.
    """
    component = application.spec.component(placed.component)
    address = cluster_ip(service_name(application.name, component))
    if address is None:
        return
    components = application.spec.callers(placed.component)
    callers = [p.instance for p in plan.placements if p.component in components and p.placement == "drone"]
    allowed = _addressed(callers, pods) if components else None
    pod_address = _target(placed.instance, pods)
    for port in component.container.ports:
        target = TargetAddress(address=pod_address, port=port.port) if pod_address is not None else None
        yield LinkedService(
            component=component.name,
            instance=placed.instance,
            virtual=VirtualAddress(address=address, port=port.port, protocol=port.protocol),
            target=target,
            callers=allowed,
        )


def _addressed(instances: Iterable[str], pods: Sequence[PodView]) -> tuple[CallerAddress, ...]:
    return tuple(CallerAddress(instance=instance, address=_source(instance, pods)) for instance in instances)


def _source(instance: str, pods: Iterable[PodView]) -> str | None:
    """Return the address of an instance's pod, even if the pod is not ready. Prefer pods that do not terminate."""
    present = [pod for pod in pods if pod.instance == instance and pod.ip and not pod.finished]
    return min(present, key=lambda pod: (pod.terminating, pod.ip)).ip if present else None


def retargeted(services: Iterable[Body], pods: Sequence[PodView]) -> list[Body]:
    """Return the services of an existing DirectLink with the current addresses of the pods."""
    updated = []
    for service in services:
        address = _target(service["instance"], pods)
        rest = {name: value for name, value in service.items() if name not in ("target", "callers")}
        if address is not None:
            rest["target"] = {"address": address, "port": service["virtual"]["port"]}
        callers = service.get("callers")
        if callers is not None:
            rest["callers"] = [each.to_dict() for each in _addressed((c["instance"] for c in callers), pods)]
        updated.append(rest)
    return updated


def _target(instance: str, pods: Iterable[PodView]) -> str | None:
    """Return an address of the instance's pods that take calls, or None.

    The lowest address is used, so that the result is stable.
    """
    return min((pod.ip for pod in pods if pod.instance == instance and pod.takes_calls and pod.ip), default=None)
