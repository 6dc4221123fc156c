"""A shell for commands of the documentation, with kubectl, helm and fractus on the PATH."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from control_plane import ControlPlane
from fractus_cluster.binaries import ensure_binaries

TIMEOUT_S = 60


class Shell:
    """Runs command lines in a directory.

    Args:
        folder: The working directory.
        plane: Control plane that KUBECONFIG selects. If None, KUBECONFIG is not set.
    """

    def __init__(self, folder: Path, plane: ControlPlane | None = None) -> None:
        self._folder = folder
        programs = ensure_binaries(("kubectl", "helm"), report=print)
        folders = [Path(sys.executable).parent, *{programs[name].parent for name in ("kubectl", "helm")}]
        self.environment = {**os.environ, "PATH": ":".join([*map(str, folders), os.environ["PATH"]])}
        self.environment.pop("KUBECONFIG", None)
        if plane is not None:
            self.environment["KUBECONFIG"] = str(plane.kubeconfig)

    def type(self, line: str, code: int = 0) -> str:
        """Run a line with pipefail, and return its standard output. Fail if its exit code is not `code`."""
        result = subprocess.run(
            ["bash", "-o", "pipefail", "-c", line], cwd=self._folder, env=self.environment, capture_output=True, text=True,
            timeout=TIMEOUT_S, check=False,
        )  # fmt: skip
        assert result.returncode == code, f"{line}: exit code {result.returncode}\n{result.stdout}{result.stderr}"
        return result.stdout
