"""The gateway's connection to the mobility service."""

from __future__ import annotations

import asyncio
import struct
from pathlib import Path

import pytest
from fractus_proto.v1 import gateway_pb2, mobility_pb2
from fractus_services.gateway.mobility_client import MAX_MESSAGE_BYTES, CallRefused, MobilityClient
from google.rpc import status_pb2


def framed(**fields: object) -> bytes:
    data = gateway_pb2.GatewayResponse(**fields).SerializeToString()
    return struct.pack(">I", len(data)) + data


ALTITUDE = mobility_pb2.ReturnToLaunchRequest(altitude_m=7.0).SerializeToString()
ANSWER = framed(id=1, message=ALTITUDE) + framed(id=1, status=status_pb2.Status().SerializeToString())


async def answer(path: Path, *parts: bytes) -> mobility_pb2.ReturnToLaunchRequest:
    """Return the result of a call to a service that sends some bytes, with pauses in between."""

    async def serve(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        for part in parts:
            writer.write(part)
            await asyncio.sleep(0.001)

    server = await asyncio.start_unix_server(serve, path)
    client = await MobilityClient.open(path, b"")
    try:
        async with asyncio.timeout(10.0):
            request = mobility_pb2.ReturnToLaunchRequest()
            return await client.call("ReturnToLaunch", request, mobility_pb2.ReturnToLaunchRequest, 1.0)
    finally:
        await client.close()
        server.close()


@pytest.mark.parametrize("size", [1, 3, 4, 5, 1000])
def test_client_reads_responses_that_arrive_in_parts(size: int, tmp_path: Path):
    parts = [ANSWER[at : at + size] for at in range(0, len(ANSWER), size)]
    assert asyncio.run(answer(tmp_path / "socket", *parts)).altitude_m == 7.0


def test_client_ends_its_calls_after_a_response_that_is_too_long(tmp_path: Path):
    with pytest.raises(CallRefused, match="the mobility service is not available"):
        asyncio.run(answer(tmp_path / "socket", struct.pack(">I", MAX_MESSAGE_BYTES + 1)))
