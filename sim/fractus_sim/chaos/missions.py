"""Missions that follow one another: two Applications at a time want the one drone."""

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
    """The example's Navigator alone, on a short path that stays near the depot: about a minute in the air."""
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
    """The missions of one run.

    Attributes:
        prefix: of their names.
        ended: phase and message of those that are over, by name.
        present: the same of those that are not.
    """

    stage: Stage
    prefix: str
    say: Say
    ended: dict[str, tuple[str, str]] = field(default_factory=dict)
    present: dict[str, tuple[str, str]] = field(default_factory=dict)
    _count: int = 0

    def step(self, *, more: bool) -> None:
        """Take a look, delete what ended, and apply another mission where one is missing; the API server may be away."""
        try:
            self._look()
            while more and len(self.present) < AT_A_TIME:
                self._apply()
        except DemoError:
            return

    def finish(self, timeout_s: float) -> None:
        """Wait until the missions are over."""
        deadline = time.monotonic() + timeout_s
        while self.present and time.monotonic() < deadline:
            self.step(more=False)
            time.sleep(0.5)

    def left_over(self) -> list[Object]:
        """Applications that are being deleted, and objects and stored Grants of those that do not exist any more.

        Raises:
            DemoError: the API server does not answer.
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
        """Grants that the objects of nodes carry."""
        specs = [body["spec"] for body in self.stage.objects("nodegrants.fractus.dev", "-A")]
        return [grant for spec in specs for grant in unpack(spec["packed"], spec["count"])]

    def _stored(self) -> list[Object]:
        """Grants on the disks of nodes."""
        stored = []
        for node in self.stage.cluster.nodes:
            for path in (node.own_state / "grants").glob("*.json"):
                with suppress(FileNotFoundError):  # it was removed meanwhile
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
    """The name of the Application that an object belongs to."""
    label = body["metadata"].get("labels", {}).get("fractus.dev/application")
    reference = (body.get("spec") or {}).get("application") or {}
    return str(label or reference.get("name") or body["metadata"]["name"])
