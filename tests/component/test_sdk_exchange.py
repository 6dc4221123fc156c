"""Requests between components: retries with the same id, single processing, refusals."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress

import grpc
import pytest
from fractus.errors import InvalidRequest, Unavailable
from fractus.exchange import (
    ATTEMPT_HEADER,
    CLIENT_HEADER,
    ID_HEADER,
    SERVICE,
    Request,
    Requester,
    Responder,
    StoredResponses,
)


class Worker:
    """Fake component that counts executed requests."""

    def __init__(self) -> None:
        self.done: list[str] = []
        self.failures: list[Exception] = []
        self.slow = asyncio.Event()
        self.slow.set()

    async def work(self, request: Request) -> bytes:
        await self.slow.wait()
        if self.failures:
            raise self.failures.pop(0)
        self.done.append(request.id)
        return b"did " + request.body

    @asynccontextmanager
    async def serving(self) -> AsyncIterator[Responder]:
        responder = Responder({"work": self.work}, 0)
        await responder.start()
        try:
            yield responder
        finally:
            await responder.stop(0.0)


async def until(condition: Callable[[], int]) -> None:
    async with asyncio.timeout(20):
        while not condition():  # noqa: ASYNC110 - the condition has no event
            await asyncio.sleep(0.02)


async def test_request_returns_response() -> None:
    worker = Worker()
    async with worker.serving() as responder, Requester(f"127.0.0.1:{responder.port}") as asking:
        assert await asking.request("work", b"this") == b"did this"
        assert await asking.request("work", b"that") == b"did that"
    assert len(set(worker.done)) == 2
    assert asking.repeated == 0


async def test_requester_reconnects_before_the_next_request() -> None:
    worker = Worker()
    opened = list[asyncio.StreamWriter]()

    async with worker.serving() as responder:

        async def pass_on(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            """Forward data in both directions between a client and the responder."""
            upstream_reader, upstream_writer = await asyncio.open_connection("127.0.0.1", responder.port)
            opened.append(writer)
            await asyncio.gather(copy(reader, upstream_writer), copy(upstream_reader, writer))

        async def copy(source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
            with suppress(ConnectionError):
                while data := await source.read(65536):
                    sink.write(data)
            sink.close()

        path = await asyncio.start_server(pass_on, "127.0.0.1", 0)
        port = path.sockets[0].getsockname()[1]
        async with path, Requester(f"127.0.0.1:{port}") as asking:
            await asking.request("work", b"this")
            for number in (1, 2):
                opened[-1].transport.abort()
                await until(lambda expected=number + 1: len(opened) == expected)  # type: ignore[misc]
            assert await asking.request("work", b"that") == b"did that"
            assert len(opened) == 3


async def test_repeated_request_returns_first_response() -> None:
    worker = Worker()
    async with worker.serving() as responder, Requester(f"127.0.0.1:{responder.port}") as asking:
        assert await asking.request("work", b"this", request_id="r1") == b"did this"
        assert await asking.request("work", b"this", request_id="r1") == b"did this"
        assert responder.responses.repeated == 1
        with pytest.raises(InvalidRequest, match="r1 had another body before"):
            await asking.request("work", b"other", request_id="r1")
    assert worker.done == ["r1"]


async def test_request_id_is_scoped_to_its_client() -> None:
    """Another client can neither use up an id nor read the response to it."""
    worker = Worker()
    async with worker.serving() as responder:
        address = f"127.0.0.1:{responder.port}"
        async with Requester(address) as asking, Requester(address) as other:
            assert await other.request("work", b"poison", request_id="r1") == b"did poison"
            assert await asking.request("work", b"this", request_id="r1") == b"did this"
            assert await other.request("work", b"this", request_id="r2") == b"did this"
            assert await asking.request("work", b"this", request_id="r2") == b"did this"
        assert responder.responses.repeated == 0
    assert worker.done == ["r1", "r1", "r2", "r2"]


async def test_request_id_is_scoped_to_its_method() -> None:
    answers = StoredResponses()
    worker = Worker()
    for method in ("work", "play"):
        await answers.once(Request("r1", method, b"this"), worker.work)
    assert worker.done == ["r1", "r1"]


async def test_repeated_request_waits_for_running_handler() -> None:
    worker = Worker()
    worker.slow.clear()
    async with worker.serving() as responder, Requester(f"127.0.0.1:{responder.port}", attempt_timeout_s=0.3) as asking:
        response = asyncio.ensure_future(asking.request("work", b"slow"))
        await until(lambda: responder.responses.repeated)
        worker.slow.set()
        assert await response == b"did slow"
    assert len(worker.done) == 1
    assert asking.repeated >= 1


@pytest.mark.parametrize("failure", [OSError("the store is away"), Unavailable("not yet")])
async def test_temporary_handler_error_is_retried(failure: Exception) -> None:
    worker = Worker()
    worker.failures = [failure, failure]
    async with worker.serving() as responder, Requester(f"127.0.0.1:{responder.port}") as asking:
        assert await asking.request("work", b"x") == b"did x"
    assert asking.repeated == 2


async def test_refused_request_is_not_retried() -> None:
    worker = Worker()
    worker.failures = [ValueError("not a picture")]
    async with worker.serving() as responder, Requester(f"127.0.0.1:{responder.port}") as asking:
        with pytest.raises(InvalidRequest, match="not a picture"):
            await asking.request("work", b"x")
        with pytest.raises(InvalidRequest):
            await asking.request("play", b"x")
        with pytest.raises(InvalidRequest, match="exceeds 16 MiB"):
            await asking.request("work", b"x" * (16 * 2**20 + 1))
    assert asking.repeated == 0


async def test_error_of_failed_handler_names_method_once() -> None:
    worker = Worker()
    worker.failures = [KeyError("content of the request")]
    async with worker.serving() as responder, Requester(f"127.0.0.1:{responder.port}") as asking:
        with pytest.raises(InvalidRequest, match=r"^work on 127\.0\.0\.1:\d+: the handler failed \(KeyError\)$"):
            await asking.request("work", b"x")


async def test_requester_finds_restarted_server() -> None:
    worker = Worker()
    async with worker.serving() as responder:
        port = responder.port
    async with Requester(f"127.0.0.1:{port}") as asking:
        response = asyncio.ensure_future(asking.request("work", b"x"))
        await until(lambda: asking.repeated)
        restarted = Responder({"work": worker.work}, port)
        await restarted.start()
        assert await response == b"did x"
        await restarted.stop(0.0)


async def test_request_without_response_fails_at_its_timeout() -> None:
    worker = Worker()
    async with worker.serving() as responder:
        port = responder.port
    async with Requester(f"127.0.0.1:{port}") as asking:
        with pytest.raises(Unavailable, match="attempts"):
            await asking.request("work", b"x", timeout_s=0.5)


async def test_request_without_id_is_refused() -> None:
    worker = Worker()
    async with worker.serving() as responder, grpc.aio.insecure_channel(f"127.0.0.1:{responder.port}") as channel:
        too_long = "x" * 300
        for metadata in ((), ((ID_HEADER, too_long),), ((ID_HEADER, "r1"), (CLIENT_HEADER, too_long))):
            with pytest.raises(grpc.aio.AioRpcError) as caught:
                await channel.unary_unary(f"/{SERVICE}/work")(b"x", metadata=metadata)
            assert caught.value.code() is grpc.StatusCode.INVALID_ARGUMENT
    assert not worker.done


async def test_oldest_stored_responses_are_removed_first() -> None:
    async def echo(request: Request) -> bytes:
        calls.append(request.id)
        return request.body

    calls: list[str] = []
    for answers, size in ((StoredResponses(2, 1000), 1), (StoredResponses(1000, 20), 10)):
        calls.clear()
        for name in ("a", "b", "b", "c", "c", "a"):
            assert await answers.once(Request(name, "echo", b"x" * size), echo) == b"x" * size
            await asyncio.sleep(0)
        assert calls == ["a", "b", "c", "a"]


async def test_non_numeric_attempt_counts_as_first() -> None:
    worker = Worker()
    async with worker.serving() as responder, grpc.aio.insecure_channel(f"127.0.0.1:{responder.port}") as channel:
        for number, attempt in enumerate(("9" * 5000, "x", "-1", "")):
            metadata = ((ID_HEADER, str(number)), (ATTEMPT_HEADER, attempt))
            assert await channel.unary_unary(f"/{SERVICE}/work")(b"x", metadata=metadata) == b"did x"
    assert worker.done == ["0", "1", "2", "3"]
