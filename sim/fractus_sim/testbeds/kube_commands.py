"""kubectl and helm commands for a cluster."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import yaml

from fractus_sim.errors import ExperimentError

Object = dict[str, Any]
SYSTEM = "fractus-system"
NAMESPACE = "default"


@dataclass(frozen=True, slots=True)
class Kube:
    """A cluster and the programs that access it."""

    kubectl: Path
    helm: Path
    kubeconfig: Path

    def run(self, *arguments: str, stdin: str | None = None, timeout_s: float = 60.0) -> str:
        """Run kubectl and return its standard output.

        Raises:
            ExperimentError: The command failed or timed out.
        """
        return self._run(self.kubectl, arguments, stdin, timeout_s)

    def fetch(self, pod: str, path: str, copy: Path, timeout_s: float = 120.0) -> None:
        """Copy a file of a system pod to a local file. An incomplete copy is removed.

        Raises:
            ExperimentError: The file cannot be read or written.
        """
        scratch = copy.with_name(f".{copy.name}")
        try:
            with scratch.open("wb") as out:
                self._run(self.kubectl, ["exec", "-n", SYSTEM, pod, "--", "cat", path], None, timeout_s, out)
            scratch.replace(copy)
        except OSError as error:
            raise ExperimentError(f"cannot write {copy}: {error.strerror}") from None
        finally:
            scratch.unlink(missing_ok=True)

    def objects(self, kinds: str, namespace: str = NAMESPACE) -> list[Object]:
        """Return objects of the kinds (comma-separated) in a namespace. Cluster-scoped kinds are also supported."""
        output = self.run("get", kinds, "-n", namespace, "-o", "json")
        return list(json.loads(output)["items"])

    def apply(self, objects: Sequence[Object], timeout_s: float = 60.0) -> None:
        """Apply manifests."""
        self.run("apply", "-f", "-", stdin=yaml.safe_dump_all(objects), timeout_s=timeout_s)

    def delete(self, objects: Sequence[Object], timeout_s: float) -> None:
        """Delete the objects of manifests and wait until they are gone."""
        manifests = yaml.safe_dump_all(objects)
        self.run(
            "delete", "-f", "-", "--ignore-not-found", f"--timeout={timeout_s:.0f}s", stdin=manifests, timeout_s=timeout_s + 10
        )  # fmt: skip

    def install(self, release: str, chart: Path, values: Sequence[str] = ()) -> bool:
        """Install or upgrade a chart with `key=value` settings. Return True if it is a new installation."""
        releases = self._run(self.helm, ["list", "-n", SYSTEM, "-q", "-f", f"^{release}$"], None, 60.0)
        arguments = ["upgrade", "--install", release, str(chart), "-n", SYSTEM, "--create-namespace"]
        arguments += [f"--set={value}" for value in values]
        self._run(self.helm, arguments, None, 120.0)
        return not releases.strip()

    def uninstall(self, release: str) -> None:
        """Uninstall a release."""
        self._run(self.helm, ["uninstall", release, "-n", SYSTEM, "--ignore-not-found", "--wait"], None, 180.0)

    def follow(
        self, arguments: Sequence[str], out: IO[bytes] | int, stdin: int | None = None
    ) -> subprocess.Popen[bytes]:
        """Start kubectl and return its process. The caller ends the process."""
        return subprocess.Popen(
            [str(self.kubectl), *arguments], stdin=stdin, stdout=out, stderr=subprocess.DEVNULL, env=self._environment()
        )

    def _run(
        self,
        program: Path,
        arguments: Sequence[str],
        stdin: str | None,
        timeout_s: float,
        out: IO[bytes] | None = None,
    ) -> str:
        command = f"{program.name} {' '.join(arguments[:4])}"
        try:
            completed = subprocess.run(
                [str(program), *arguments],
                input=stdin,
                stdout=subprocess.PIPE if out is None else out,
                stderr=subprocess.PIPE,
                text=True,
                timeout=timeout_s,
                env=self._environment(),
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise ExperimentError(f"{command}: timed out after {timeout_s:.0f} s") from None
        except OSError as error:
            raise ExperimentError(
                f"cannot run {program}: {error.strerror}; install it, or use --cluster embedded"
            ) from None
        if completed.returncode:
            raise ExperimentError(f"{command}: {' '.join(completed.stderr.split())}")
        return completed.stdout or ""

    def _environment(self) -> dict[str, str]:
        return {**os.environ, "KUBECONFIG": str(self.kubeconfig)}
