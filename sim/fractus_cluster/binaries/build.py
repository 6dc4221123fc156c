"""Build of programs from pinned Go modules with progress output."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path

from fractus_cluster.binaries.catalog import MODULES, Module, Program
from fractus_cluster.commands import run
from fractus_cluster.errors import ClusterError, PrerequisiteError

_BUILD_TIMEOUT_S = 3600.0
_REPORT_EVERY_S = 10.0

Report = Callable[[str], None]


def module_digest(module: Module) -> str:
    """Return a digest of all inputs of a module build: sources, pins and link variables."""
    digest = hashlib.sha256()
    for entry in sorted(_sources(module).iterdir(), key=lambda item: item.name):
        digest.update(entry.name.encode() + b"\0" + entry.read_bytes() + b"\0")
    digest.update(repr(sorted(module.link_variables.items())).encode())
    return digest.hexdigest()[:16]


def build(programs: Sequence[Program], into: Path, *, report: Report) -> None:
    """Build programs of one module. Move them to a directory after all of them have been built.

    Args:
        programs: Programs to build, all of the same module.
        into: Target directory. An interrupted build changes nothing in it. The caller must hold its lock.
        report: Called with progress lines.

    Raises:
        PrerequisiteError: Go is missing or too old.
        ClusterError: The build failed. The message ends with the compiler output.
    """
    module = MODULES[programs[0].module]
    check_go(module)
    into.mkdir(parents=True, exist_ok=True)
    names = ", ".join(program.name for program in programs)
    report(f"building {names} {programs[0].version} from Go modules (once; kept in {into})")
    started = time.monotonic()
    # These directories are left by killed builds. No other build can run while this process holds the lock.
    for left in into.glob(".building-*"):
        shutil.rmtree(left)
    with tempfile.TemporaryDirectory(prefix=".building-", dir=into) as scratch:
        source = Path(scratch) / "source"
        output = Path(scratch) / "bin"
        output.mkdir()
        with resources.as_file(_sources(module)) as folder:
            shutil.copytree(folder, source)
        _go_build(module, programs, source, output, report)
        for program in programs:
            built = output / program.name
            check_version(built, program)
            built.replace(into / program.name)
    report(f"built {names} in {time.monotonic() - started:.0f} s")


def _go_build(module: Module, programs: Sequence[Program], source: Path, output: Path, report: Report) -> None:
    flags = " ".join(["-s", "-w", *(f"-X {key}={value}" for key, value in module.link_variables.items())])
    packages = [program.package for program in programs]
    target = output if packages != ["."] else output / programs[0].name
    argv = ["go", "build", "-v", "-trimpath", "-mod=readonly", "-buildvcs=false"]
    argv += ["-ldflags", flags, "-o", f"{target}/" if target == output else str(target), *packages]
    environment = {**os.environ, "CGO_ENABLED": "0", "GOFLAGS": "", "GOWORK": "off"}
    process = subprocess.Popen(
        argv,
        cwd=source,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
    )
    timer = threading.Timer(_BUILD_TIMEOUT_S, process.kill)
    timer.start()
    try:
        tail = _follow(process, programs[0].module, report)
        code = process.wait()
    finally:
        timer.cancel()
        if process.poll() is None:
            process.kill()
            process.wait()
    if code != 0:
        raise ClusterError(f"go build of {module.name} failed with exit code {code}:\n" + "\n".join(tail))


def _follow(process: subprocess.Popen[str], module: str, report: Report) -> list[str]:
    """Read the compiler output until it ends, and report progress. Return its last lines."""
    tail: list[str] = []
    packages = 0
    downloads = 0
    started = time.monotonic()
    reported = started
    assert process.stderr is not None
    for line in process.stderr:
        text = line.rstrip()
        tail = [*tail[-19:], text]
        if text.startswith("go: downloading"):
            downloads += 1
        elif " " not in text:
            packages += 1
        now = time.monotonic()
        if now - reported >= _REPORT_EVERY_S:
            reported = now
            report(
                f"  {module}: {packages} packages compiled, {downloads} modules fetched, "
                f"{now - started:.0f} s, at {text.removeprefix('go: downloading ')}"
            )
    return tail


def check_go(module: Module) -> None:
    """Check that the Go toolchain on PATH can build a module, or can download a toolchain for it.

    Raises:
        PrerequisiteError: The toolchain is missing or too old.
    """
    required = _go_version((_sources(module) / "go.mod").read_text(), r"^go (\d+)\.(\d+)")
    text = ".".join(map(str, required))
    if shutil.which("go") is None:
        raise PrerequisiteError(
            f"{module.name} must be built once, which needs Go {text} or newer on PATH "
            "(or set KUBEBUILDER_ASSETS to a directory that contains the programs)"
        )
    present, toolchain = run(["go", "env", "GOVERSION", "GOTOOLCHAIN"], timeout_s=60).stdout.split()
    if _go_version(present, r"go(\d+)\.(\d+)") < required and toolchain == "local":
        raise PrerequisiteError(
            f"building {module.name} needs Go {text} or newer; this is {present}, "
            "and GOTOOLCHAIN=local prevents the download of a newer version"
        )


def _sources(module: Module) -> Traversable:
    return resources.files("fractus_cluster.binaries") / "gomod" / module.name


def _go_version(text: str, pattern: str) -> tuple[int, int]:
    match = re.search(pattern, text, re.MULTILINE)
    if match is None:
        raise ClusterError(f"no Go version in {text[:100]!r}")
    return int(match[1]), int(match[2])


def reported_version(path: Path, program: Program) -> str | None:
    """Return the version that a program prints (without a leading v), or None."""
    if not program.version_arguments:
        return None
    done = run([path, *program.version_arguments], timeout_s=60, check=False)
    match = re.search(r"\bv?(\d+\.\d+\.\d+)\b", done.stdout + done.stderr)
    return match[1] if match else None


def check_version(path: Path, program: Program) -> None:
    """Check that a built program runs and prints the expected version.

    Raises:
        ClusterError: The program fails or prints a different version.
    """
    if program.version_arguments:
        version = reported_version(path, program)
        if version != program.version:
            raise ClusterError(f"{program.name} was built as {program.version} but reports {version}")
