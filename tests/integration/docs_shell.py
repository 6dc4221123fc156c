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
        plane: The control plane that KUBECONFIG names; unset for none.
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
        """Return the standard output of a line. Fail unless it ends with the exit code; a failure inside a pipe counts too."""
        done = subprocess.run(
            ["bash", "-o", "pipefail", "-c", line], cwd=self._folder, env=self.environment, capture_output=True, text=True,
            timeout=TIMEOUT_S, check=False,
        )  # fmt: skip
        assert done.returncode == code, f"{line}: exit code {done.returncode}\n{done.stdout}{done.stderr}"
        return done.stdout
