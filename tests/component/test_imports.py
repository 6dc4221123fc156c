"""Imports of programs: commands import little to start quickly, and services import only libraries of their image."""

from __future__ import annotations

import subprocess
import sys

import pytest
from fractus_cli.main import COMMANDS


def run_program(program: str) -> tuple[str, set[str]]:
    """Run a program. Return its output and the packages that it imported."""
    argv = [sys.executable, "-c", f"import sys; {program}; print(*sys.modules, file=sys.stderr)"]
    result = subprocess.run(argv, capture_output=True, text=True, check=True, timeout=120)
    return result.stdout, {module.partition(".")[0] for module in result.stderr.split()}


def test_help_imports_no_command() -> None:
    output, imported = run_program("from fractus_cli.main import run; run(['--help'])")
    for name in COMMANDS:
        assert f"\n  {name} " in output
    assert {package for package in imported if package.startswith("fractus")} == {"fractus_cli"}
    assert not imported & {"grpc", "numpy", "shapely", "pydantic", "yaml"}


def test_help_and_verification_of_audit_logs_import_no_geometry() -> None:
    _, imported = run_program("import fractus_cli.audit")
    assert "fractus_cli" in imported
    assert not imported & {"mcap", "shapely", "numpy", "pydantic"}


def test_mobility_service_imports_no_image_libraries() -> None:
    """The mobility image does not contain these libraries."""
    _, imported = run_program(
        "import fractus_services.commands, fractus_services.mobility.rpc.server, fractus_services.recording.recorder"
    )
    assert "fractus_services" in imported
    assert not imported & {"cv2", "PIL", "scipy", "matplotlib", "kubernetes", "aiohttp"}


def test_startup_heartbeat_imports_no_large_library() -> None:
    """A drone in flight needs heartbeats soon. Importing large libraries takes seconds on a companion computer."""
    _, imported = run_program("import fractus_services.commands, fractus_services.mobility.mavlink.startup_heartbeat")
    assert "pymavlink" in imported
    assert not imported & {"grpc", "google", "numpy", "shapely", "pydantic", "yaml", "cryptography", "fractus_core"}


def test_environment_variable_cannot_disable_mavlink_checksums(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MAV_IGNORE_CRC", "1")
    printed, _ = run_program(
        "from fractus_runtime.mavlink_codec import Endpoint, Parser; "
        "frame = bytearray(Endpoint(1, 1).encode('HEARTBEAT', {})); frame[-1] ^= 1; print(len(Parser().feed(bytes(frame))))"
    )
    assert printed.strip() == "0"


def test_agent_does_not_import_the_control_state_machine() -> None:
    output, _ = run_program("import fractus_agent.__main__; print(*sys.modules)")
    assert "fractus_core.control.state" in output.split()
    assert "fractus_core.control.machine" not in output.split()
