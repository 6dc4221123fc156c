"""Access of end-to-end tests to a cluster: kubectl, waiting, and signals to processes of pods."""

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
    """A command failed that must succeed."""


@dataclass(frozen=True)
class Kube:
    """kubectl on one cluster."""

    kubectl: pathlib.Path
    kubeconfig: pathlib.Path

    def run(self, *args: str, stdin: str | None = None, timeout_s: float = 60) -> subprocess.CompletedProcess[str]:
        """Run kubectl and return the completed process, also after an error."""
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
        done = self.run(*args, stdin=stdin, timeout_s=timeout_s)
        if done.returncode:
            raise CommandFailed(f"kubectl {' '.join(args)}: {done.stderr.strip()}")
        return done.stdout

    def apply(self, *objects: Object) -> None:
        """Apply objects; the API server must accept all of them."""
        self.must("apply", "-f", "-", stdin=yaml.safe_dump_all(objects))

    def refused(self, obj: Object) -> str:
        """Apply an object and return the API server's refusal, empty when it was accepted."""
        done = self.run("apply", "-f", "-", stdin=yaml.safe_dump(obj))
        return done.stderr if done.returncode else ""

    def get(self, kind: str, name: str, namespace: str = "default") -> Object | None:
        """Return an object, or None if it does not exist."""
        done = self.run("get", kind, name, "-n", namespace, "-o", "json", "--ignore-not-found")
        if done.returncode:
            raise CommandFailed(done.stderr.strip())
        return json.loads(done.stdout) if done.stdout.strip() else None

    def all(self, kind: str, namespace: str | None = None, selector: str = "") -> list[Object]:
        """Return the objects of a kind, in one namespace or in all."""
        scope = ["-n", namespace] if namespace else ["-A"]
        text = self.must("get", kind, *scope, "-o", "json", *(["-l", selector] if selector else []))
        return list(json.loads(text)["items"])

    def wait(self, what: str, condition: Callable[[], Any], timeout_s: float = 60, poll_s: float = 0.3) -> Any:
        """Poll until the condition returns something true, and return that."""
        deadline = time.monotonic() + timeout_s
        last: Exception | None = None
        while time.monotonic() < deadline:
            try:
                found = condition()
            except CommandFailed as error:
                found = None
                last = error
            if found:
                return found
            time.sleep(poll_s)
        cause = f" ({last})" if last else ""
        raise AssertionError(f"waited {timeout_s:.0f} s for: {what}{cause}\n{self.state()}")

    def state(self) -> str:
        """Return the state of the cluster for the report of a failed test."""
        looks = (
            ("get", "applications.fractus.dev,deploymentplans.fractus.dev,grants.fractus.dev,drones.fractus.dev", "-A"),
            ("get", "applications.fractus.dev", "-A", "-o", 'jsonpath={range .items[*]}{.status}{"\\n"}{end}'),
            ("get", "pods", "-A", "-o", "wide"),
            ("logs", "-n", "fractus-system", "deployment/fractus-operator", "--tail=25"),
        )
        return "\n".join(done.stdout + done.stderr for done in (self.run(*look) for look in looks))

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
        """SIGKILL every process of a pod's containers, as a crash would; the sandbox stays."""
        if not process_lookup.send_signal(process_lookup.of_pod(pod["metadata"]["uid"]), signal.SIGKILL):
            raise CommandFailed(f"pod {pod['metadata']['name']} has no processes to kill")


def condition(obj: Object | None, type_: str) -> Mapping[str, Any]:
    """Return a condition of an object, or an empty mapping."""
    conditions = ((obj or {}).get("status") or {}).get("conditions") or []
    return next((c for c in conditions if c["type"] == type_), {})
