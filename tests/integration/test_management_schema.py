"""Generated requests to the management API (schemathesis), on a real API server with the operator."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from control_plane import ControlPlane
from management_server import ManagementServer, User, path_of, submitted, user_token
from operator_world import World

CONFIGURATION = """
[checks.negative_data_rejection]
expected-statuses = [400, 401, 403, 404, 405, 409, 412, 413, 415, 422, 428]
[[operations]]
include-path-regex = "^(/v1/plans|/app_plan|/app_status)/"
parameters = {{ "path.name" = "{plan}" }}
[[operations]]
include-path-regex = "/apps/"
parameters = {{ "path.name" = "survey" }}
[[operations]]
include-path-regex = "/drones/"
parameters = {{ "path.name" = "drone-1" }}
"""
"""Statuses for invalid data, some of which is too large, and names of existing objects, because generated names do not exist."""

Fuzz = Callable[..., int]


@pytest.fixture
def fuzz(pilot: User, control_plane: ControlPlane, world: World, namespace: str, tmp_path: Path) -> Fuzz:
    """Return a function that sends generated requests with all permissions in one namespace, and returns their number."""

    def run(*options: str) -> int:
        existing = path_of(submitted(pilot)).rpartition("/")[2]
        (tmp_path / "schemathesis.toml").write_text(CONFIGURATION.format(plan=existing))
        server = ManagementServer(
            control_plane, tmp_path / "log", f"--namespace={namespace}", "--requests-per-second=1000"
        )
        roles = ("fractus-drone-editor", "fractus-applicationtemplate-editor")
        token = user_token(world, namespace, "fuzzer", ("fractus-flightplan-admin",), roles)
        command = [
            str(Path(sys.executable).with_name("schemathesis")),
            "run", f"{server.url}/openapi.json", f"--header=Authorization: Bearer {token}",
            # Rules across fields, such as unique names, are not expressible in a schema.
            "--exclude-checks=positive_data_acceptance",
            "--suppress-health-check=all", "--no-color", "--request-timeout=30", "--max-failures=20", *options,
        ]  # fmt: skip
        try:
            result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)
        finally:
            code = server.stop()
        assert result.returncode == 0, result.stdout + result.stderr
        assert code == 0
        assert '"level": "ERROR"' not in server.log.read_text()
        print(result.stdout)
        cases = re.search(r"Test cases:\s+([\d,]+) generated", result.stdout)
        assert cases, result.stdout
        return int(cases[1].replace(",", ""))

    return run


def test_generated_requests_get_documented_responses(fuzz: Fuzz) -> None:
    assert fuzz("--phases=fuzzing", "--max-examples=8", "--include-path-regex=^/v1/", NO_STREAMS) > 100


NO_STREAMS = "--exclude-operation-id-regex=stream_plan"
"""Option without which the requests would wait for the end of streams. Further exclusions must be part of this option."""

GENERATED = {
    "plans": (8000, ("--phases=coverage,fuzzing", "--max-examples=350", f"{NO_STREAMS}|publish_app")),
    "templates": (1200, ("--phases=coverage,fuzzing", "--max-examples=20", "--include-operation-id-regex=publish_app")),
    "sequences": (400, ("--phases=stateful", "--max-examples=60", NO_STREAMS)),
}
"""Runs with 10,000 requests together: the least number of requests, and options. Templates take a second each to generate."""


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("run", GENERATED)
def test_ten_thousand_generated_requests_get_documented_responses(fuzz: Fuzz, run: str) -> None:
    """`test_generated_requests_get_documented_responses` is the fast form."""
    least, options = GENERATED[run]
    assert fuzz(*options) >= least
