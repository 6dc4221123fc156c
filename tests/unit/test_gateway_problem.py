"""Problems that the gateway reports to the agent of its node."""

from __future__ import annotations

import asyncio
import os
import stat
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

from fractus_agent.registration.diagnostics import read_gateway_problem
from fractus_agent.registration.node_status import NodeObservation, node_status
from fractus_core.api.conditions import ConditionUpdate
from fractus_core.identity.authority import Authority
from fractus_services.auth import TlsFiles
from fractus_services.gateway.gateway_server import GatewayOptions, current_problem, run

NOW = datetime(2026, 6, 1, tzinfo=UTC)


def _certificate(directory: Path) -> TlsFiles:
    (directory / "tls.crt").write_bytes(Authority.generate(datetime.now(UTC) - timedelta(days=1)).certificate_pem)
    return TlsFiles(directory)


def test_gateway_reports_missing_certificate_and_missing_socket(tmp_path: Path) -> None:
    now_s = time.time()
    served = tmp_path / "gateway.sock"
    os.mknod(served, stat.S_IFSOCK | 0o600)
    assert current_problem(served, TlsFiles(tmp_path), now_s) == "The gateway cannot read the certificate of the node."
    certificate = _certificate(tmp_path)
    assert current_problem(served, certificate, now_s) == ""
    assert current_problem(served, certificate, now_s + 1e10) == "The certificate of the node has expired."
    problem = current_problem(tmp_path / "none.sock", certificate, now_s)
    assert problem.startswith(f"The mobility service does not offer the socket {tmp_path / 'none.sock'}")


def test_agent_reports_problem_of_the_gateway_as_condition(tmp_path: Path) -> None:
    assert read_gateway_problem(tmp_path) == ""
    (tmp_path / "gateway").mkdir()
    (tmp_path / "gateway" / "gateway.problem").write_text("The certificate of the node has expired.")
    observed = NodeObservation(
        kind="Drone",
        has_mobility=False,
        needs_certificate=False,
        certified=ConditionUpdate("Certified", "True", "Issued", ""),
        gateway_problem=read_gateway_problem(tmp_path),
    )
    conditions = {c["type"]: c for c in node_status(observed, {}, 1, NOW)["conditions"]}
    assert conditions["MavlinkGateway"]["status"] == "False"
    assert conditions["MavlinkGateway"]["message"] == "The certificate of the node has expired."


async def test_group_of_the_gateway_can_read_its_problem(tmp_path: Path) -> None:
    options = GatewayOptions(
        tls=tmp_path / "tls",
        mobility=tmp_path / "gateway.sock",
        listen="127.0.0.1:0",
        state=tmp_path / "gateway",
        audit=tmp_path / "gateway.jsonl",
        lock_timeout=0.0,
    )
    options.state.mkdir()
    gateway = asyncio.create_task(run(options, asyncio.Event()))
    try:
        async with asyncio.timeout(5.0):
            while not options.problem.exists():  # noqa: ASYNC110 - the gateway has no notification
                await asyncio.sleep(0.01)
        assert stat.S_IMODE(options.problem.stat().st_mode) == 0o640
        assert read_gateway_problem(tmp_path) == "The gateway cannot read the certificate of the node."
    finally:
        gateway.cancel()
        await asyncio.gather(gateway, return_exceptions=True)


def test_agent_reports_a_problem_file_that_it_cannot_read(tmp_path: Path) -> None:
    (tmp_path / "gateway" / "gateway.problem").mkdir(parents=True)
    assert read_gateway_problem(tmp_path).startswith(f"The agent cannot read {tmp_path}/gateway/gateway.problem (")
