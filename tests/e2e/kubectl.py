"""Helpers for end-to-end tests: run kubectl, wait for conditions, and send signals to processes of pods."""

from __future__ import annotations

import json
import os
import pathlib
import signal
import subprocess
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import yaml
from fractus_sim.chaos import process_lookup

Object = dict[str, Any]


class CommandFailed(AssertionError):
    """A command that must succeed has failed."""


@dataclass(frozen=True)
class Kube:
    """Runs kubectl on one cluster."""

    kubectl: pathlib.Path
    kubeconfig: pathlib.Path

    def run(self, *args: str, stdin: str | None = None, timeout_s: float = 60) -> subprocess.CompletedProcess[str]:
        """Run kubectl and return the completed process. A nonzero exit code raises no exception."""
        return subprocess.run(
            [str(self.kubectl), *args],
            input=stdin,
            capture_output=True,
            text=True,
            timeout=timeout_s,
            env={**os.environ, "KUBECONFIG": str(self.kubeconfig)},
            check=False,
        )

    def must(self, *args: str, stdin: str | None = None, timeout_s: float = 60) -> str:
        """Run kubectl and return its standard output."""
        result = self.run(*args, stdin=stdin, timeout_s=timeout_s)
        if result.returncode:
            raise CommandFailed(f"kubectl {' '.join(args)}: {result.stderr.strip()}")
        return result.stdout

    def apply(self, *objects: Object) -> None:
        """Apply objects. The API server must accept all of them."""
        self.must("apply", "-f", "-", stdin=yaml.safe_dump_all(objects))

    def refused(self, obj: Object) -> str:
        """Apply an object. Return the refusal of the API server, or an empty string if it accepted the object."""
        result = self.run("apply", "-f", "-", stdin=yaml.safe_dump(obj))
        return result.stderr if result.returncode else ""

    def get(self, kind: str, name: str, namespace: str = "default") -> Object | None:
        """Return an object, or None if it does not exist."""
        result = self.run("get", kind, name, "-n", namespace, "-o", "json", "--ignore-not-found")
        if result.returncode:
            raise CommandFailed(result.stderr.strip())
        return json.loads(result.stdout) if result.stdout.strip() else None

    def all(self, kind: str, namespace: str | None = None, selector: str = "") -> list[Object]:
        """Return the objects of a kind, in one namespace or in all namespaces."""
        scope = ["-n", namespace] if namespace else ["-A"]
        text = self.must("get", kind, *scope, "-o", "json", *(["-l", selector] if selector else []))
        return list(json.loads(text)["items"])

    def wait(self, description: str, condition: Callable[[], Any], timeout_s: float = 60, poll_s: float = 0.3) -> Any:
        """Poll a condition until it returns a true value, and return this value."""
        deadline = time.monotonic() + timeout_s
        last: Exception | None = None
        while time.monotonic() < deadline:
            try:
                value = condition()
            except CommandFailed as error:
                value = None
                last = error
            if value:
                return value
            time.sleep(poll_s)
        cause = f" ({last})" if last else ""
        raise AssertionError(f"waited {timeout_s:.0f} s for: {description}{cause}\n{self.state()}")

    def state(self) -> str:
        """Return the state of the cluster for the report of a failed test."""
        commands = (
            ("get", "applications.fractus.dev,deploymentplans.fractus.dev,grants.fractus.dev,drones.fractus.dev", "-A"),
            ("get", "applications.fractus.dev", "-A", "-o", 'jsonpath={range .items[*]}{.status}{"\\n"}{end}'),
            ("get", "pods", "-A", "-o", "wide"),
            ("logs", "-n", "fractus-system", "deployment/fractus-operator", "--tail=25"),
        )
        results = [self.run(*command) for command in commands]
        return "\n".join(result.stdout + result.stderr for result in results)

    def pod(self, selector: str, namespace: str, node: str | None = None) -> Object:
        """Return the only running pod that matches a selector."""
        pods = [
            p
            for p in self.all("pods", namespace, selector)
            if p["status"].get("phase") == "Running"
            and "deletionTimestamp" not in p["metadata"]
            and (node is None or p["spec"].get("nodeName") == node)
        ]
        if len(pods) != 1:
            raise CommandFailed(f"{len(pods)} running pods of {selector} in {namespace}")
        return pods[0]

    def kill_pod(self, pod: Object) -> None:
        """Simulate a crash: send SIGKILL to every process of a pod's containers, but not to the sandbox of the pod."""
        if not process_lookup.send_signal(process_lookup.of_pod(pod["metadata"]["uid"]), signal.SIGKILL):
            raise CommandFailed(f"pod {pod['metadata']['name']} has no processes to kill")


def condition(obj: Object | None, type_: str) -> Mapping[str, Any]:
    """Return the condition of this type from the status of an object, or an empty mapping."""
    conditions = ((obj or {}).get("status") or {}).get("conditions") or []
    return next((c for c in conditions if c["type"] == type_), {})
