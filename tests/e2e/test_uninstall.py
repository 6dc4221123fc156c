"""helm uninstall is refused while an Application exists."""

from __future__ import annotations

import json
import os
import shutil
import subprocess

import pytest
from conftest import SYSTEM, short_flight
from kubectl import Kube

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
        rollback = helm(kube, "rollback", "fractus", release["revision"])
    assert rollback.returncode == 0, rollback.stderr
    kube.must("delete", "job", "fractus-uninstall", "-n", SYSTEM, "--ignore-not-found")
