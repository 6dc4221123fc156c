"""helm uninstall is refused while an Application exists or a drone flies, and what to do after a refusal."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Iterator

import pytest
from conftest import DRONE, ROOT, SYSTEM, flight_state, short_flight
from kubectl import Kube
from test_mission import phase

pytestmark = pytest.mark.slow


def helm(kube: Kube, *args: str) -> subprocess.CompletedProcess[str]:
    """Run the helm next to kubectl or, if there is no such program, the helm on the PATH."""
    sibling = kube.kubectl.with_name("helm")
    return subprocess.run(
        [str(sibling) if sibling.exists() else shutil.which("helm") or "helm", *args, "-n", SYSTEM],
        env={**os.environ, "KUBECONFIG": str(kube.kubeconfig)},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_uninstall_is_refused_while_an_application_exists(kube: Kube) -> None:
    application = short_flight("kept")
    # The Application is never placed, so no drone flies. Its finalizer blocks the uninstall.
    application["spec"]["components"][0]["controlPoints"][0]["point"] = {"depot": "nowhere"}
    application["metadata"]["finalizers"] = ["fractus.dev/teardown"]
    (release,) = json.loads(helm(kube, "list", "--filter", "^fractus$", "--output", "json").stdout)
    kube.apply(application)
    try:
        result = helm(kube, "uninstall", "fractus", "--timeout", "60s")
        assert result.returncode != 0
        log = kube.must("logs", "job/fractus-uninstall", "-n", SYSTEM)
        assert "Fractus still runs default/kept: delete all Applications first" in log
        assert kube.get("deployment", "fractus-operator", SYSTEM)
        assert kube.get("daemonset", "fractus-mobility", SYSTEM)
    finally:
        kube.must("delete", "application.fractus.dev", "kept", "--timeout=60s", timeout_s=90)
        # Helm upgrades only a release with a deployed revision, so the wipe cannot be enabled before the rollback.
        wipe = ("upgrade", "fractus", str(ROOT / "charts" / "fractus"), "--reuse-values")
        too_early = helm(kube, *wipe, "--set=uninstall.wipeNodes=true")
        rollback = helm(kube, "rollback", "fractus", release["revision"])
    assert "has no deployed releases" in too_early.stderr
    assert rollback.returncode == 0, rollback.stderr
    for enabled in ("true", "false"):
        upgraded = helm(kube, *wipe, f"--set=uninstall.wipeNodes={enabled}")
        assert upgraded.returncode == 0, upgraded.stderr
    kube.must("delete", "job", "fractus-uninstall", "-n", SYSTEM, "--ignore-not-found")


@pytest.fixture
def demo(grounded: Kube) -> Iterator[str]:
    """The release fractus-demo, as its revision. The embedded cluster has the same objects, and its own vehicle."""
    installed = json.loads(helm(grounded, "list", "--filter", "^fractus-demo$", "--output", "json").stdout)
    if not installed:
        chart = str(ROOT / "charts" / "fractus-demo")
        options = ("--take-ownership", "--set=vehicle.enabled=false", f"--set=drone={DRONE}")
        result = helm(grounded, "install", "fractus-demo", chart, *options)
        assert result.returncode == 0, result.stderr
    (release,) = json.loads(helm(grounded, "list", "--filter", "^fractus-demo$", "--output", "json").stdout)
    yield release["revision"]
    grounded.must("delete", "job", "fractus-demo-uninstall", "-n", SYSTEM, "--ignore-not-found")
    if not installed:
        # The other tests need the objects of the example, so only the record of the release is removed.
        grounded.must("delete", "secret", "-n", SYSTEM, "-l", "owner=helm,name=fractus-demo")


def objects_of_demo(kube: Kube) -> set[tuple[str, str]]:
    kinds = ("drone", "edgenode", "depot", "zone", "policy")
    return {(kind, body["metadata"]["name"]) for kind in kinds for body in kube.all(f"{kind}.fractus.dev")}


def test_uninstall_of_demo_in_flight_is_refused_as_a_whole(grounded: Kube, demo: str) -> None:
    kube = grounded
    before = objects_of_demo(kube)
    kube.apply(short_flight("demo"))
    kube.wait("the drone flies", lambda: flight_state(kube) == "flying", timeout_s=120)
    result = helm(kube, "uninstall", "fractus-demo", "--timeout", "60s")
    log = kube.must("logs", "job/fractus-demo-uninstall", "-n", SYSTEM)
    assert result.returncode != 0
    assert f"Fractus still flies {DRONE} (" in log
    assert log in result.stdout + result.stderr, "helm does not print the reason"
    assert objects_of_demo(kube) == before
    assert kube.get("configmap", "fractus-demo-applications", SYSTEM)
    rollback = helm(kube, "rollback", "fractus-demo", demo)
    assert rollback.returncode == 0, rollback.stderr
    kube.wait("the mission is over", lambda: phase(kube, "demo") in {"Completed", "Failed"}, timeout_s=240)
    assert phase(kube, "demo") == "Completed"


def test_refused_upgrade_in_flight_changes_all_but_the_refused_object(grounded: Kube) -> None:
    """The services that run on nodes do not change. docs/upgrades.md describes the state after the refusal."""
    kube = grounded
    chart = str(ROOT / "charts" / "fractus")

    def revisions() -> dict[str, str]:
        history = json.loads(helm(kube, "history", "fractus", "--output", "json").stdout)
        return {str(each["revision"]): each["status"] for each in history}

    def changed() -> set[str]:
        """Return the workloads that have the log level of the refused upgrade."""
        bodies = [*kube.all("daemonset", SYSTEM), *kube.all("deployment", SYSTEM)]
        return {body["metadata"]["name"] for body in bodies if "'DEBUG'" in str(body["spec"]["template"])}

    first = max(revisions(), key=int)
    kube.apply(short_flight("refused"))
    kube.wait("the drone flies", lambda: flight_state(kube) == "flying", timeout_s=120)
    values = ("--set=mobility.nodeSelector.rack=b", "--set=logLevel=DEBUG")
    refused = helm(kube, "upgrade", "fractus", chart, "--reuse-values", *values)
    assert refused.returncode != 0
    assert f"{DRONE} is in the air" in refused.stderr
    after = revisions()
    assert (after[first], after[str(int(first) + 1)]) == ("deployed", "failed")
    assert changed() == {"fractus-agent", "fractus-camera", "fractus-operator"}
    rolled = helm(kube, "rollback", "fractus", first)
    assert rolled.returncode == 0, rolled.stderr
    assert not changed()
    kube.wait("the mission is over", lambda: phase(kube, "refused") in {"Completed", "Failed"}, timeout_s=240)
    assert phase(kube, "refused") == "Completed"
