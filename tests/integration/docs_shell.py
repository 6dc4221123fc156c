"""A reader's shell: what a page says is typed there as it stands, with kubectl, helm and fractus on the PATH."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from control_plane import ControlPlane
from fractus_cluster.binaries import ensure_binaries

TIMEOUT_S = 60


class Shell:
    """Types lines in a directory.

    Args:
        folder: where they are typed.
        plane: the cluster of its KUBECONFIG.
    """

    def __init__(self, folder: Path, plane: ControlPlane | None = None) -> None:
        self._folder = folder
        programs = ensure_binaries(("kubectl", "helm"), report=print)
        places = [Path(sys.executable).parent, *{programs[name].parent for name in ("kubectl", "helm")}]
        self.environment = {**os.environ, "PATH": ":".join([*map(str, places), os.environ["PATH"]])}
        self.environment.pop("KUBECONFIG", None)
        if plane is not None:
            self.environment["KUBECONFIG"] = str(plane.kubeconfig)

    def type(self, line: str, code: int = 0) -> str:
        """What a line prints to standard output; it ends with this code, also where a command before a pipe fails."""
        done = subprocess.run(
            ["bash", "-o", "pipefail", "-c", line], cwd=self._folder, env=self.environment, capture_output=True, text=True,
            timeout=TIMEOUT_S, check=False,
        )  # fmt: skip
        assert done.returncode == code, f"{line}: exit code {done.returncode}\n{done.stdout}{done.stderr}"
        return done.stdout
