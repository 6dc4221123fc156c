"""Builders of the Deployments of planned instances."""

from __future__ import annotations

import hashlib
import json
from typing import assert_never

from fractus_core.api import Application, Component, Drone
from fractus_core.api.components import TLS_DIR, TMP_DIR
from fractus_core.api.names import CLASS_LABEL, CLOUD_LABEL, address_variable
from fractus_core.api.plans import PlannedInstance

from fractus_operator import kinds, labels
from fractus_operator.kinds import Body
from fractus_operator.labels import application_labels, label_value, owned_object, service_name

COMPONENT_USER = 10001
MOBILITY_PORT = 50051
CAMERA_PORT = 50052


GATEWAY_PORT = 50053
_MAVLINK_PORT = 5760


def deployment(
    application: Application, placed: PlannedInstance, drone: Drone | None = None, gateway_image: str = ""
) -> Body:
    """Return the Deployment of a planned instance. A required node affinity binds its pods to the planned node.

    Args:
        application: The Application.
        placed: The planned instance.
        drone: Drone of the planned node, if the node is a drone. Its spec.autonomy is the time for which pods tolerate
            a lost link to the node.
        gateway_image: Image of the sidecar, for a component that uses the interface mavlink.
    """
    component = application.spec.component(placed.component)
    identity = {labels.APPLICATION_LABEL: label_value(application.name), labels.INSTANCE_LABEL: placed.instance}
    instance_labels = {
        "app.kubernetes.io/name": component.slug,
        labels.COMPONENT_LABEL: component.name,
        labels.INSTANCE_LABEL: placed.instance,
        labels.PLACEMENT_LABEL: placed.placement,
    }
    spec: Body = {
        "replicas": placed.replicas,
        "revisionHistoryLimit": 0,
        "selector": {"matchLabels": identity},
        "strategy": {"type": "Recreate" if placed.node is not None else "RollingUpdate"},
        "template": {
            "metadata": {
                "labels": {**application_labels(application), **instance_labels},
                "annotations": {"kubectl.kubernetes.io/default-container": component.slug},
            },
            "spec": _pod_spec(application, component, placed, drone, gateway_image),
        },
    }
    body = owned_object(kinds.DEPLOYMENT, application, placed.instance, instance_labels, spec=spec)
    # The part of the manifest that determines the pods. Defaults are omitted, because a new version of the API may add
    # fields with defaults.
    called = [application.spec.component(name).container.ports for name in component.egress]
    content = [
        component.model_dump(mode="json", by_alias=True, exclude_defaults=True, exclude={"ends_with"}),
        [[port.port for port in ports] for ports in called],
    ]
    digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:12]
    body["metadata"]["annotations"] = {labels.CAUSE_ANNOTATION: f"{digest}@{placed.node or 'cloud'}"}
    return body


def _pod_spec(
    application: Application, component: Component, placed: PlannedInstance, drone: Drone | None, gateway_image: str
) -> Body:
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
        **_scheduling(placed, drone),
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
                "securityContext": _restricted(),
                "volumeMounts": [
                    _tls_mount(),
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
    if component.uses_mavlink and gateway_image:
        spec["initContainers"] = [_sidecar(gateway_image)]
    return spec


def _sidecar(image: str) -> Body:
    """Return the sidecar of a MAVLink program. The program starts when the sidecar listens on its ports."""
    connect = f"import socket; socket.create_connection(('127.0.0.1', {_MAVLINK_PORT}))"
    return {
        "name": labels.SIDECAR,
        "image": image,
        "restartPolicy": "Always",
        "command": ["fractus", "gateway", "connect", "--gateway", f"$(FRACTUS_HOST_IP):{GATEWAY_PORT}"],
        "env": [*_node_environment(), {"name": "FRACTUS_TLS_DIR", "value": TLS_DIR}],
        "resources": {"requests": {"cpu": "10m", "memory": "32Mi"}, "limits": {"memory": "128Mi"}},
        # A probe of the type tcpSocket would connect to the address of the pod, but the sidecar listens on the loopback interface.
        "startupProbe": {"exec": {"command": ["python3", "-c", connect]}, "periodSeconds": 1, "failureThreshold": 60},
        "terminationMessagePolicy": "FallbackToLogsOnError",
        "securityContext": _restricted(),
        "volumeMounts": [_tls_mount()],
    }


def _restricted() -> Body:
    return {"allowPrivilegeEscalation": False, "capabilities": {"drop": ["ALL"]}, "readOnlyRootFilesystem": True}


def _tls_mount() -> Body:
    return {"name": "tls", "mountPath": TLS_DIR, "readOnly": True}


def _node_environment() -> list[Body]:
    return [
        {"name": "FRACTUS_NODE", "valueFrom": {"fieldRef": {"apiVersion": "v1", "fieldPath": "spec.nodeName"}}},
        {"name": "FRACTUS_HOST_IP", "valueFrom": {"fieldRef": {"apiVersion": "v1", "fieldPath": "status.hostIP"}}},
    ]


def _environment(application: Application, component: Component, placed: PlannedInstance) -> list[Body]:
    namespace, name = application.key
    env: list[Body] = [
        *_node_environment(),
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


def _scheduling(placed: PlannedInstance, drone: Drone | None) -> Body:
    """Return affinity and tolerations of a pod. Pods on a drone or edge node tolerate an unreachable node, cloud pods do not."""
    terms: list[Body]
    tolerations: list[Body] = []
    if placed.node is None:
        cloud = ((CLASS_LABEL, "cloud"), (CLOUD_LABEL, "true"))
        terms = [{"matchExpressions": [{"key": key, "operator": "In", "values": [value]}]} for key, value in cloud]
    else:
        terms = [{"matchFields": [{"key": "metadata.name", "operator": "In", "values": [placed.node]}]}]
        autonomy = drone.spec.autonomy if drone is not None else None
        bound: Body = {} if autonomy is None else {"tolerationSeconds": autonomy}
        tolerations = [
            {"key": CLASS_LABEL, "operator": "Exists"},
            {"key": "node.kubernetes.io/not-ready", "operator": "Exists", "effect": "NoExecute", **bound},
            {"key": "node.kubernetes.io/unreachable", "operator": "Exists", "effect": "NoExecute", **bound},
        ]
    required = {"requiredDuringSchedulingIgnoredDuringExecution": {"nodeSelectorTerms": terms}}
    return {"affinity": {"nodeAffinity": required}, "tolerations": tolerations}
