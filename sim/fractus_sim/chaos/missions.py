"""Consecutive missions of a chaos run. Two Applications at a time compete for one drone."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

import yaml
from fractus_core.api.grants import unpack

from fractus_sim.chaos.stage import Stage
from fractus_sim.demo.clusters import EXAMPLE, documents
from fractus_sim.demo.kube import NAMESPACE, DemoError, Object

ENDED = frozenset({"Completed", "Failed", "Invalid"})
AT_A_TIME = 2
CHILDREN = "deployments,replicasets,services,secrets,endpointslices,poddisruptionbudgets,networkpolicies,pods"
Say = Callable[[str], None]


def flight(name: str, namespace: str = NAMESPACE) -> Object:
    """Return the Navigator of the example on a short path near the depot, about one minute of flight."""
    app = documents(EXAMPLE / "application.yaml")[0]
    navigator = next(each for each in app["spec"]["components"] if each["name"] == "Navigator")
    navigator["controlPoints"][0]["path"] = [
        {"lat": 50.864239, "lon": 4.679068, "alt": 12},
        {"lat": 50.864800, "lon": 4.679300, "alt": 12},
        {"lat": 50.865228, "lon": 4.679352, "alt": 12},
    ]
    navigator["container"].pop("env", None)
    app["metadata"] = {"name": name, "namespace": namespace}
    app["spec"]["components"] = [navigator]
    return app


@dataclass
class Missions:
    """Missions of one run.

    Attributes:
        prefix: Prefix of their names.
        ended: Phase and message of completed missions by name.
        present: Phase and message of active missions by name.
    """

    stage: Stage
    prefix: str
    say: Say
    ended: dict[str, tuple[str, str]] = field(default_factory=dict)
    present: dict[str, tuple[str, str]] = field(default_factory=dict)
    _count: int = 0

    def step(self, *, more: bool) -> None:
        """Update the missions, delete ended ones and apply new ones. Errors of the API server are ignored."""
        try:
            self._look()
            while more and len(self.present) < AT_A_TIME:
                self._apply()
        except DemoError:
            return

    def finish(self, timeout_s: float) -> None:
        """Wait until the missions have ended."""
        deadline = time.monotonic() + timeout_s
        while self.present and time.monotonic() < deadline:
            self.step(more=False)
            time.sleep(0.5)

    def left_over(self) -> list[Object]:
        """Return Applications in deletion, and remaining objects and stored Grants of deleted Applications.

        Raises:
            DemoError: The API server did not respond.
        """
        applications = self.stage.objects("applications.fractus.dev", "-A")
        leaving = [body for body in applications if "deletionTimestamp" in body["metadata"]]
        names = {body["metadata"]["name"] for body in applications}
        found = self.stage.objects(CHILDREN, "-A", "-l", "fractus.dev/application")
        found += self.stage.objects("grants.fractus.dev,directlinks.fractus.dev", "-A")
        found += self.stage.objects("deploymentplans.fractus.dev", "-A")
        found += self._carried() + self._stored()
        return leaving + [body for body in found if _application(body) not in names]

    def _carried(self) -> list[Object]:
        """Return the Grants in NodeGrant objects."""
        specs = [body["spec"] for body in self.stage.objects("nodegrants.fractus.dev", "-A")]
        return [grant for spec in specs for grant in unpack(spec["packed"], spec["count"])]

    def _stored(self) -> list[Object]:
        """Return the Grants on the disks of nodes."""
        stored = []
        for node in self.stage.cluster.nodes:
            for path in (node.own_state / "grants").glob("*.json"):
                with suppress(FileNotFoundError):  # # removed in the meantime
                    stored.append(json.loads(path.read_bytes()))
        return stored

    def _look(self) -> None:
        found = {
            body["metadata"]["name"]: body for body in self.stage.objects("applications.fractus.dev", "-n", NAMESPACE)
        }
        for name in list(self.present):
            status = (found.get(name) or {}).get("status") or {}
            now = (status.get("phase", ""), status.get("message", ""))
            if now[0] != self.present[name][0]:
                self.say(f"{name} is {now[0]}: {now[1]}")
            self.present[name] = now
            if now[0] in ENDED:
                self.stage.kubectl("delete", "application.fractus.dev", name, "-n", NAMESPACE, "--wait=false")
                self.ended[name] = self.present.pop(name)

    def _apply(self) -> None:
        name = f"{self.prefix}-{self._count + 1}"
        self.stage.kube.run("apply", "-f", "-", stdin=yaml.safe_dump(flight(name)), timeout_s=20.0)
        self._count += 1
        self.present[name] = ("", "")
        self.stage.applied.set()
        self.stage.applied.clear()


def _application(body: Object) -> str:
    """Return the name of the Application of an object."""
    label = body["metadata"].get("labels", {}).get("fractus.dev/application")
    reference = (body.get("spec") or {}).get("application") or {}
    return str(label or reference.get("name") or body["metadata"]["name"])
