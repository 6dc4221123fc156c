"""Collect the secrets of a cluster with Fractus, and all texts that users can read: objects, logs and Events."""

from __future__ import annotations

import base64
import json

from conftest import SYSTEM
from fractus_core.api.grants import unpack
from kubectl import Kube

TOKEN = "/var/run/secrets/kubernetes.io/serviceaccount/token"
NODE_KEY = "/var/lib/fractus/tls/tls.key"


def secrets(kube: Kube) -> dict[str, bytes]:
    """Return the values of Secrets, the keys of nodes, and the tokens of Fractus' pods."""
    values: dict[str, bytes] = {}
    for body in kube.all("secrets"):
        # Ignore the Secrets in which helm stores its releases, and the bootstrap tokens of kubeadm.
        if body["type"] not in {"helm.sh/release.v1", "bootstrap.kubernetes.io/token"}:
            for name, value in (body.get("data") or {}).items():
                values[f"{body['metadata']['namespace']}/{body['metadata']['name']}/{name}"] = base64.b64decode(value)
    for pod in kube.all("pods", SYSTEM, "app.kubernetes.io/component in (agent,operator)"):
        name = pod["metadata"]["name"]
        values[f"token of {name}"] = kube.must("exec", "-n", SYSTEM, name, "--", "cat", TOKEN).encode()
        if pod["metadata"]["labels"]["app.kubernetes.io/component"] == "agent":
            values[f"key of {pod['spec']['nodeName']}"] = kube.must(
                "exec", "-n", SYSTEM, name, "--", "cat", NODE_KEY
            ).encode()
    return values


def readable(kube: Kube) -> dict[str, str]:
    """Return the logs of all pods of Fractus and its applications, Events, and all objects except Secrets."""
    texts: dict[str, str] = {}
    for pod in (*kube.all("pods", SYSTEM), *kube.all("pods", None, "fractus.dev/application")):
        namespace = pod["metadata"]["namespace"]
        name = pod["metadata"]["name"]
        texts[f"log of {name}"] = kube.must("logs", "-n", namespace, name, "--all-containers")
        if any(status["restartCount"] for status in pod["status"].get("containerStatuses") or ()):
            texts[f"log of {name} before its restart"] = kube.run(
                "logs", "-n", namespace, name, "--all-containers", "-p"
            ).stdout
    kinds = kube.must("api-resources", "--api-group=fractus.dev", "-o", "name").split()
    for kind in (
        *kinds,
        "events",
        "pods",
        "nodes",
        "configmaps",
        "deployments",
        "daemonsets",
        "leases",
        "serviceaccounts",
    ):
        for body in kube.all(kind):
            name = f"{kind} {body['metadata'].get('namespace', '')}/{body['metadata']['name']}"
            texts[name] = json.dumps(body)
            if kind.startswith("nodegrants"):
                texts[f"{name} unpacked"] = json.dumps(unpack(body["spec"]["packed"], body["spec"]["count"]))
    return texts
