"""From a plan to Kubernetes objects: pure functions, one for each kind of child."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from typing import Any, assert_never

from fractus_core.api import API_VERSION, Application, Component, Drone
from fractus_core.api.components import TLS_DIR, TMP_DIR
from fractus_core.api.grants import GrantSpec
from fractus_core.api.names import CLASS_LABEL, CLOUD_LABEL, address_variable
from fractus_core.api.plans import DeploymentPlanSpec, PlannedInstance

from fractus_operator.cluster import kinds, labels
from fractus_operator.cluster.kinds import Body, Kind
from fractus_operator.cluster.labels import grant_name, label_value, service_name
from fractus_operator.cluster.pods import PodView

COMPONENT_USER = 10001
MOBILITY_PORT = 50051
CAMERA_PORT = 50052


def children(
    application: Application,
    plan: DeploymentPlanSpec,
    grants: Iterable[GrantSpec],
    pods: Sequence[PodView],
    drone: Callable[[str], Drone | None],
) -> dict[Kind, list[Body]]:
    """The children that a plan asks for, except Secrets: those hold keys, which are made when they are needed.

    Args:
        application: Whose plan it is.
        plan: The plan.
        grants: What its instances may do.
        pods: The application's pods as they are.
        drone: The Drone of a name, if there is one.
    """
    wanted: dict[Kind, list[Body]] = {kind: [] for kind in kinds.CHILDREN}
    wanted[kinds.DEPLOYMENT_PLAN] = [deployment_plan(application, plan)]
    wanted[kinds.GRANT] = [grant(application, spec) for spec in grants]
    for component in (c for c in application.spec.components if c.container.ports):
        wanted[kinds.SERVICE].append(service(application, component))
        if component.placement == "hybrid":
            based = base_pods(component.name, plan, pods)
            wanted[kinds.ENDPOINT_SLICE].append(endpoint_slice(application, component, based))
    if plan.drone is not None:
        wanted[kinds.DISRUPTION_BUDGET] = [disruption_budget(application)]
    for placed in plan.placements:
        node = drone(placed.node) if placed.node is not None else None
        wanted[kinds.DEPLOYMENT].append(deployment(application, placed, node))
    return wanted


def deployment_plan(application: Application, plan: DeploymentPlanSpec) -> Body:
    """The DeploymentPlan of an application; it carries the application's name."""
    return child(kinds.DEPLOYMENT_PLAN, application, application.name, {}, spec=plan.to_dict())


def grant(application: Application, spec: GrantSpec) -> Body:
    """The Grant of an instance. It is cluster-scoped, so labels and not an owner say whose it is."""
    namespace, _ = application.key
    body = kinds.GRANT.header(grant_name(namespace, spec.instance))
    body["metadata"]["labels"] = {
        **labels_of(application),
        labels.NAMESPACE_LABEL: namespace,
        labels.COMPONENT_LABEL: spec.component,
        labels.INSTANCE_LABEL: spec.instance,
    }
    body["spec"] = _unsigned(spec)
    return body


def regranted(observed: Body, spec: GrantSpec) -> Body:
    """A Grant that exists, with another spec: as `grant` builds it, but without its application."""
    body = kinds.GRANT.header(observed["metadata"]["name"])
    ours = (
        labels.APPLICATION_LABEL,
        labels.MANAGED_LABEL,
        labels.NAMESPACE_LABEL,
        labels.COMPONENT_LABEL,
        labels.INSTANCE_LABEL,
    )
    present = observed["metadata"].get("labels") or {}
    body["metadata"]["labels"] = {label: present[label] for label in ours if label in present}
    body["spec"] = _unsigned(spec)
    return body


def _unsigned(spec: GrantSpec) -> Body:
    """The spec without what is added when it is signed, so that what was signed before compares with it."""
    unsigned = spec.unsigned
    # Without defaults: a field that a later release adds changes no Grant that does not use it, and services of the
    # release before can still read those.
    return unsigned.model_dump(mode="json", by_alias=True, exclude_defaults=True)


def tls_secret(application: Application, placed: PlannedInstance, data: dict[str, str]) -> Body:
    """The Secret with an instance's client certificate."""
    described = {labels.COMPONENT_LABEL: placed.component, labels.INSTANCE_LABEL: placed.instance}
    return child(
        kinds.SECRET, application, labels.secret_name(placed.instance), described, type="kubernetes.io/tls", data=data
    )


def service(application: Application, component: Component) -> Body:
    """The Service of a component.

    A hybrid component's has no selector: the operator says by an EndpointSlice which instance answers.
    """
    spec: Body = {
        "type": "ClusterIP",
        "ports": [
            {"name": p.label, "port": p.port, "targetPort": p.port, "protocol": p.protocol}
            for p in component.container.ports
        ],
    }
    if component.placement != "hybrid":
        spec["selector"] = {
            labels.APPLICATION_LABEL: label_value(application.name),
            labels.COMPONENT_LABEL: component.name,
        }
    name = service_name(application.name, component)
    return child(kinds.SERVICE, application, name, {labels.COMPONENT_LABEL: component.name}, spec=spec)


def endpoint_slice(application: Application, component: Component, pods: Iterable[PodView]) -> Body:
    """Where a hybrid component's Service leads: to the ready pods of its base instance."""
    name = service_name(application.name, component)
    ready = [pod for pod in pods if pod.takes_calls]
    described = {
        labels.COMPONENT_LABEL: component.name,
        "kubernetes.io/service-name": name,
        labels.SLICE_LABEL: labels.SLICES_BY,
    }
    return child(
        kinds.ENDPOINT_SLICE,
        application,
        name,
        described,
        addressType="IPv6" if any(":" in (pod.ip or "") for pod in ready) else "IPv4",
        endpoints=endpoints(ready),
        ports=[{"name": p.label, "port": p.port, "protocol": p.protocol} for p in component.container.ports],
    )


def base_pods(component: str, plan: DeploymentPlanSpec, pods: Iterable[PodView]) -> list[PodView]:
    """The pods of a hybrid component's cloud base."""
    bases = {p.instance for p in plan.placements if p.component == component and p.role == "cloud"}
    return [pod for pod in pods if pod.instance in bases]


def endpoints(pods: Iterable[PodView]) -> list[Body]:
    """The endpoints of an EndpointSlice: those pods that take calls."""
    return [
        {
            "addresses": [pod.ip],
            "conditions": {"ready": True, "serving": True, "terminating": False},
            "nodeName": pod.node,
            "targetRef": {"kind": "Pod", "namespace": pod.namespace, "name": pod.name},
        }
        for pod in sorted(pods, key=lambda pod: pod.name)
        if pod.takes_calls
    ]


def disruption_budget(application: Application) -> Body:
    """Keeps evictions, such as those of kubectl drain, from what runs on the drone."""
    aboard = {labels.APPLICATION_LABEL: label_value(application.name), labels.PLACEMENT_LABEL: "drone"}
    spec = {"maxUnavailable": 0, "selector": {"matchLabels": aboard}}
    return child(kinds.DISRUPTION_BUDGET, application, application.name, {}, spec=spec)


def deployment(application: Application, placed: PlannedInstance, drone: Drone | None = None) -> Body:
    """The Deployment of a planned instance, bound to its node by required affinity.

    Args:
        application: Whose component it is.
        placed: The instance.
        drone: The Drone behind its node, if it is one: its autonomy bounds how long pods outlive a lost link.
    """
    component = application.spec.component(placed.component)
    identity = {labels.APPLICATION_LABEL: label_value(application.name), labels.INSTANCE_LABEL: placed.instance}
    described = {**labels_of(application), **_location_labels(component, placed)}
    spec: Body = {
        "replicas": placed.replicas,
        "revisionHistoryLimit": 0,
        "selector": {"matchLabels": identity},
        "strategy": {"type": "Recreate" if placed.node is not None else "RollingUpdate"},
        "template": {
            "metadata": {
                "labels": described,
                "annotations": {"kubectl.kubernetes.io/default-container": component.slug},
            },
            "spec": _pod_spec(application, component, placed, drone),
        },
    }
    body = child(kinds.DEPLOYMENT, application, placed.instance, _location_labels(component, placed), spec=spec)
    body["metadata"]["annotations"] = {
        labels.CAUSE_ANNOTATION: f"{_requested_digest(application, component)}@{placed.node or 'cloud'}"
    }
    return body


def _requested_digest(application: Application, component: Component) -> str:
    """A digest of what the manifest says of a component's pods."""
    called = [application.spec.component(name).container.ports for name in component.egress]
    # Defaults are left out: a new version of the kinds adds some.
    said = [
        component.model_dump(mode="json", by_alias=True, exclude_defaults=True),
        [[port.port for port in ports] for ports in called],
    ]
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()[:12]


def _pod_spec(application: Application, component: Component, placed: PlannedInstance, drone: Drone | None) -> Body:
    container = component.container
    spec: Body = {
        "automountServiceAccountToken": False,
        "enableServiceLinks": False,
        "terminationGracePeriodSeconds": 10,
        "securityContext": {
            "runAsNonRoot": True,
            "runAsUser": COMPONENT_USER,
            "runAsGroup": COMPONENT_USER,
            "fsGroup": COMPONENT_USER,
            "seccompProfile": {"type": "RuntimeDefault"},
        },
        "affinity": {"nodeAffinity": _affinity(placed)},
        "tolerations": _tolerations(placed, drone),
        "volumes": [
            {"name": "tls", "secret": {"secretName": labels.secret_name(placed.instance), "defaultMode": 0o440}},
            {"name": "tmp", "emptyDir": {"sizeLimit": "64Mi"}},
            *(volume.pod_volume() for volume in container.volumes),
        ],
        "containers": [
            {
                "name": component.slug,
                "image": container.image,
                "env": _environment(application, component, placed),
                "resources": container.resources.to_dict(),
                "terminationMessagePolicy": "FallbackToLogsOnError",
                "securityContext": {
                    "allowPrivilegeEscalation": False,
                    "capabilities": {"drop": ["ALL"]},
                    "readOnlyRootFilesystem": True,
                },
                "volumeMounts": [
                    {"name": "tls", "mountPath": TLS_DIR, "readOnly": True},
                    {"name": "tmp", "mountPath": TMP_DIR},
                    *(volume.mount() for volume in container.volumes),
                ],
            }
        ],
    }
    main = spec["containers"][0]
    if container.command:
        main["command"] = list(container.command)
    if container.args:
        main["args"] = list(container.args)
    if container.ports:
        main["ports"] = [{"name": p.label, "containerPort": p.port, "protocol": p.protocol} for p in container.ports]
    return spec


def _environment(application: Application, component: Component, placed: PlannedInstance) -> list[Body]:
    namespace, name = application.key
    env: list[Body] = [
        {"name": "FRACTUS_NODE", "valueFrom": {"fieldRef": {"apiVersion": "v1", "fieldPath": "spec.nodeName"}}},
        {"name": "FRACTUS_HOST_IP", "valueFrom": {"fieldRef": {"apiVersion": "v1", "fieldPath": "status.hostIP"}}},
        {"name": "FRACTUS_NAMESPACE", "value": namespace},
        {"name": "FRACTUS_APPLICATION", "value": name},
        {"name": "FRACTUS_COMPONENT", "value": component.name},
        {"name": "FRACTUS_INSTANCE", "value": placed.instance},
        {"name": "FRACTUS_TLS_DIR", "value": TLS_DIR},
    ]
    mobility = {"name": "FRACTUS_MOBILITY_ADDRESS", "value": f"$(FRACTUS_HOST_IP):{MOBILITY_PORT}"}
    camera = {"name": "FRACTUS_CAMERA_ADDRESS", "value": f"$(FRACTUS_HOST_IP):{CAMERA_PORT}"}
    match placed.placement:
        case "drone":
            env += [mobility, camera]
        case "edge":
            env.append(camera)
        case "hybrid" | "cloud":
            pass
        case _:
            assert_never(placed.placement)
    if component.control_points:
        points = [point.to_dict() for point in component.control_points]
        env.append({"name": "FRACTUS_CONTROL_POINTS", "value": json.dumps(points, separators=(",", ":"))})
    for called in component.egress:
        other = application.spec.component(called)
        if other.container.ports:
            address = f"{service_name(name, other)}.{namespace}.svc:{other.container.ports[0].port}"
            env.append({"name": address_variable(other.name), "value": address})
    return [*env, *(v.to_dict() for v in component.container.env)]


def _affinity(placed: PlannedInstance) -> Body:
    terms: list[Body]
    if placed.node is not None:
        terms = [{"matchFields": [{"key": "metadata.name", "operator": "In", "values": [placed.node]}]}]
    else:
        cloud = ((CLASS_LABEL, "cloud"), (CLOUD_LABEL, "true"))
        terms = [{"matchExpressions": [{"key": key, "operator": "In", "values": [value]}]} for key, value in cloud]
    return {"requiredDuringSchedulingIgnoredDuringExecution": {"nodeSelectorTerms": terms}}


def _tolerations(placed: PlannedInstance, drone: Drone | None) -> list[Body]:
    """Pods of a drone or edge node stay when the node cannot be reached; those of the cloud go elsewhere."""
    if placed.node is None:
        return []
    autonomy = drone.spec.autonomy if drone is not None else None
    bound: Body = {} if autonomy is None else {"tolerationSeconds": autonomy}
    return [
        {"key": CLASS_LABEL, "operator": "Exists"},
        {"key": "node.kubernetes.io/not-ready", "operator": "Exists", "effect": "NoExecute", **bound},
        {"key": "node.kubernetes.io/unreachable", "operator": "Exists", "effect": "NoExecute", **bound},
    ]


def labels_of(application: Application) -> dict[str, str]:
    """The labels of all that is made for an application."""
    return {labels.APPLICATION_LABEL: label_value(application.name), labels.MANAGED_LABEL: labels.MANAGED_BY}


def _location_labels(component: Component, placed: PlannedInstance) -> dict[str, str]:
    return {
        "app.kubernetes.io/name": component.slug,
        labels.COMPONENT_LABEL: component.name,
        labels.INSTANCE_LABEL: placed.instance,
        labels.PLACEMENT_LABEL: placed.placement,
    }


def child(kind: Kind, application: Application, name: str, described: dict[str, str], **content: Any) -> Body:
    """A namespaced object that an application owns.

    Args:
        kind: Of the object.
        application: Its owner.
        name: Its name.
        described: Labels beside those of all that is made for the application.
        content: What it has beside its metadata.
    """
    namespace, _ = application.key
    body = kind.header(name, namespace)
    body["metadata"]["labels"] = {**labels_of(application), **described}
    body["metadata"]["ownerReferences"] = [
        {
            "apiVersion": API_VERSION,
            "kind": Application.KIND,
            "name": application.name,
            "uid": application.metadata.uid or "",
            "controller": True,
            "blockOwnerDeletion": True,
        }
    ]
    return {**body, **content}
