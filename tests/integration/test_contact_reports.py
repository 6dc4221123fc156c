"""Reports of the node's contact with the API server: from the agent's telemetry feed to the mobility service."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from typing import Any

import grpc
import pytest
from fractus_agent.telemetry import TelemetryFeed
from fractus_core.api.names import node_identity
from fractus_proto.v1 import mobility_pb2 as pb
from fractus_proto.v1 import mobility_pb2_grpc
from fractus_runtime.files import write_set
from mobility_rig import DRIVER, NODE, Rig, grant


class Mobility(mobility_pb2_grpc.MobilityServiceServicer):
    """Fake mobility service that records reports, or refuses them as a service of an earlier release."""

    def __init__(self, *, knows_reports: bool = True) -> None:
        self.ages_s: list[float] = []
        self._knows_reports = knows_reports

    async def SubscribeTelemetry(  # noqa: N802
        self, _request: pb.SubscribeTelemetryRequest, _context: Any
    ) -> AsyncIterator[pb.Telemetry]:
        while True:
            yield pb.Telemetry(mode="GUIDED")
            await asyncio.sleep(0.1)

    async def ReportContact(  # noqa: N802
        self, request: pb.ReportContactRequest, context: Any
    ) -> pb.ReportContactResponse:
        if not self._knows_reports:
            await context.abort(grpc.StatusCode.UNIMPLEMENTED, "unknown method")
        self.ages_s.append(request.age_s)
        return pb.ReportContactResponse()


@asynccontextmanager
async def feeding(rig: Rig, service: Mobility, age_s: Any) -> AsyncIterator[TelemetryFeed]:
    """Serve a fake service with the certificates of a rig, and run the feed of the node."""
    files = {name: (rig.tls / name).read_bytes() for name in ("tls.key", "tls.crt", "ca.crt")}
    write_set(rig.directory / "node-tls", files)
    server = grpc.aio.server()
    mobility_pb2_grpc.add_MobilityServiceServicer_to_server(service, server)
    credentials = grpc.ssl_server_credentials([(files["tls.key"], files["tls.crt"])], files["ca.crt"], True)
    port = server.add_secure_port("127.0.0.1:0", credentials)
    await server.start()
    feed = TelemetryFeed(
        f"127.0.0.1:{port}",
        rig.directory / "node-tls",
        NODE,
        serial=lambda: 1,
        on_change=lambda: None,
        contact_age_s=age_s,
    )
    running = asyncio.create_task(feed.run())
    try:
        yield feed
    finally:
        running.cancel()
        with suppress(asyncio.CancelledError):
            await running
        await server.stop(None)


async def test_feed_reports_contact_once_per_second(rig: Rig) -> None:
    service = Mobility()
    ages_s = iter((0.5, 7.25, *[8.0] * 100))
    async with feeding(rig, service, lambda: next(ages_s)), asyncio.timeout(15):
        began = asyncio.get_running_loop().time()
        while len(service.ages_s) < 3:  # noqa: ASYNC110
            await asyncio.sleep(0.05)
        assert asyncio.get_running_loop().time() - began >= 1.7


async def test_feed_reports_nothing_without_contact_since_its_start(rig: Rig) -> None:
    service = Mobility()
    async with feeding(rig, service, lambda: math.inf) as feed, asyncio.timeout(15):
        while feed.latest is None:  # noqa: ASYNC110
            await asyncio.sleep(0.05)
        await asyncio.sleep(1.5)
        assert service.ages_s == []


async def test_feed_continues_if_service_does_not_know_reports(rig: Rig) -> None:
    async with feeding(rig, Mobility(knows_reports=False), lambda: 1.0) as feed, asyncio.timeout(15):
        while feed.latest is None:  # noqa: ASYNC110
            await asyncio.sleep(0.05)
        assert feed.problem is None


@pytest.mark.parametrize(
    ("caller", "age_s", "code"),
    [
        (DRIVER, 0.0, grpc.StatusCode.PERMISSION_DENIED),
        (node_identity("drone-2"), 0.0, grpc.StatusCode.PERMISSION_DENIED),
        (node_identity(NODE), math.nan, grpc.StatusCode.INVALID_ARGUMENT),
        (node_identity(NODE), math.inf, grpc.StatusCode.INVALID_ARGUMENT),
        (node_identity(NODE), -1.0, grpc.StatusCode.INVALID_ARGUMENT),
        (node_identity(NODE), 1e300, None),
    ],
)
async def test_service_takes_reports_of_its_agent_only(
    rig: Rig, caller: str, age_s: float, code: grpc.StatusCode | None
) -> None:
    rig.write_grant(grant())
    rig.start_service()
    request = pb.ReportContactRequest(age_s=age_s)
    call = rig.stub(caller).ReportContact(request, timeout=20, wait_for_ready=True)
    if code is None:
        await call
        return
    with pytest.raises(grpc.aio.AioRpcError) as refused:
        await call
    assert refused.value.code() is code
