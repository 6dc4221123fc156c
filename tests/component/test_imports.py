"""What programs import: commands that answer at once, and images without libraries that they do not need."""

from __future__ import annotations

import subprocess
import sys

import pytest
from fractus_cli.main import COMMANDS


def after(program: str) -> tuple[str, set[str]]:
    """What a program says, and the packages that it has imported when it ends."""
    argv = [sys.executable, "-c", f"import sys; {program}; print(*sys.modules, file=sys.stderr)"]
    done = subprocess.run(argv, capture_output=True, text=True, check=True, timeout=120)
    return done.stdout, {module.partition(".")[0] for module in done.stderr.split()}


def test_help_imports_no_command() -> None:
    said, imported = after("from fractus_cli.main import run; run(['--help'])")
    for name in COMMANDS:
        assert f"\n  {name} " in said
    assert {package for package in imported if package.startswith("fractus")} == {"fractus_cli"}
    assert not imported & {"grpc", "numpy", "shapely", "pydantic", "yaml"}


def test_help_and_verification_of_audit_logs_import_no_geometry() -> None:
    _, imported = after("import fractus_cli.audit")
    assert "fractus_cli" in imported
    assert not imported & {"mcap", "shapely", "numpy", "pydantic"}


def test_what_flies_needs_no_library_of_pictures() -> None:
    """The mobility image has none: importing the service with all that it may use later must not ask for one."""
    _, imported = after(
        "import fractus_services.commands, fractus_services.mobility.rpc.server, fractus_services.recording.recorder"
    )
    assert "fractus_services" in imported
    assert not imported & {"cv2", "PIL", "scipy", "matplotlib", "kubernetes", "aiohttp"}


def test_the_first_heartbeats_of_a_start_wait_for_no_large_import() -> None:
    """A drone in flight waits for them: what takes a small computer seconds to import comes afterwards."""
    _, imported = after("import fractus_services.commands, fractus_services.mobility.mavlink.startup_heartbeat")
    assert "pymavlink" in imported
    assert not imported & {"grpc", "google", "numpy", "shapely", "pydantic", "yaml", "cryptography", "fractus_core"}


def test_environment_cannot_turn_off_the_checksums_of_mavlink(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MAV_IGNORE_CRC", "1")
    printed, _ = after(
        "from fractus_runtime.mavlink_codec import Endpoint, Parser; "
        "frame = bytearray(Endpoint(1, 1).encode('HEARTBEAT', {})); frame[-1] ^= 1; print(len(Parser().feed(bytes(frame))))"
    )
    assert printed.strip() == "0"


def test_an_agent_reads_outcomes_without_what_decides_them() -> None:
    said, _ = after("import fractus_agent.__main__; print(*sys.modules)")
    assert "fractus_core.control.state" in said.split()
    assert "fractus_core.control.machine" not in said.split()
