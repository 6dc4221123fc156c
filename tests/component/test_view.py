"""The live view without a browser: reading of growing recordings, events sent to pages, and access control."""

from __future__ import annotations

import asyncio
import hashlib
import io
import itertools
import json
import re
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import aclosing
from pathlib import Path
from typing import Any
from unittest.mock import AsyncMock

import pytest
from aiohttp import ClientSession, hdrs, web
from click.testing import CliRunner
from fractus_cluster.ports import free_port
from fractus_runtime.connection_limit import ConnectionLimit
from fractus_runtime.mcap_tail import DamagedFile, Tail
from fractus_runtime.metrics import metrics_text
from fractus_services.recording import messages
from fractus_services.recording.messages import Record
from fractus_services.recording.segment_writer import McapWriter
from fractus_view import command, server
from fractus_view.command import ServerOptions, view
from fractus_view.events import Event, Fix, Problem, State, Verdict
from fractus_view.hub import RECENT, TRAIL, Hub, Trail
from fractus_view.server import PAGE, ViewServer
from fractus_view.sources import GrowingRecordings, Replay
from fractus_view.typescript import typescript_types
from scraping import scraped, values

ROOT = Path(__file__).parents[2]
START_NS = 1_780_000_000_000_000_000
JPEG = b"\xff\xd8 a picture \xff\xd9"


def records(seconds: int = 4) -> list[Record]:
    """Return the records of a flight: 20 positions a second, a refused call and a picture."""
    items: list[Record] = []
    for i in range(seconds * 20):
        time_ns = START_NS + i * 50_000_000
        items.append(messages.attitude(time_ns, 0.0, 0.0, -1.5707963))
        items.append(messages.location(time_ns, "drone-1", 39.36 + i * 1e-6, 22.95, 30.0))
    entry = {
        "kind": "call", "time": "2026-05-28T20:26:42+00:00", "caller": "spiffe://f/ns/d/app/a/component/Navigator/instance/n",
        "method": "Goto", "action": "deny", "code": "InsideExclusionZone", "reason": "inside", "policies": ["school"],
    }  # fmt: skip
    items += messages.audit_records(entry, "drone-1")
    items += messages.audit_records({"kind": "grant", "time": entry["time"]}, "drone-1")
    items.append(messages.picture(START_NS + 10**9, "drone-1", JPEG))
    return items


def write(file: Any, items: Iterable[Record], flush_every: int = 40) -> None:
    out = McapWriter(file)
    for number, record in enumerate(items):
        out.write(f"/drone-1/{record.topic}", record.schema, record.time_ns, record.content)
        if number % flush_every == 0:
            out.flush()
    out.close()


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "000001-20260528T202640Z.mcap"
    with path.open("wb") as file:
        write(file, records())
    return path


def events_of(kind: type, events: Iterable[Event]) -> list[Any]:
    return [event for event in events if isinstance(event, kind)]


def test_growing_file_yields_the_same_records_as_the_complete_file(recording: Path, tmp_path: Path) -> None:
    data = recording.read_bytes()
    growing = tmp_path / "growing.mcap"
    expected = list(Tail(recording).read())
    assert len(expected) == len(records())
    tail = Tail(growing)
    received = []
    with growing.open("wb") as file:
        for start in range(0, len(data), 997):
            file.write(data[start : start + 997])
            file.flush()
            received += list(tail.read())
    assert received == expected
    assert tail.finished


def test_damaged_recording_is_reported_and_its_beginning_is_shown(recording: Path) -> None:
    data = bytearray(recording.read_bytes())
    data[len(data) // 2] ^= 0xFF
    recording.write_bytes(data)
    events = list(Replay([recording]).events())
    assert events_of(Fix, events)
    (problem,) = events_of(Problem, events)
    assert "the rest of a recording cannot be read" in problem.text
    recording.write_bytes(b"no recording at all")
    with pytest.raises(DamagedFile, match="not an MCAP"):
        list(Tail(recording).read())


def test_positions_are_shown_five_times_a_second_with_heading(recording: Path) -> None:
    fixes = events_of(Fix, Replay([recording]).events())
    assert [b.time_ms - a.time_ms for a, b in itertools.pairwise(fixes)] == [200] * (len(fixes) - 1)
    assert len(fixes) == 20
    assert {fix.heading_deg for fix in fixes} == {270.0}


def test_only_judged_calls_are_shown_as_verdicts(recording: Path) -> None:
    (verdict,) = events_of(Verdict, Replay([recording]).events())
    assert (verdict.component, verdict.method, verdict.action) == ("Navigator", "Goto", "deny")
    assert (verdict.reason, list(verdict.policies)) == ("inside", ["school"])


def state(second: int, *, in_air: bool, mode: str = "GUIDED") -> Record:
    content = {"altitude_m": 1.0, "mode": mode, "controller": "system", "in_air": in_air}
    return Record("state", "fractus.State", START_NS + second * 10**9, content)


def decision(second: int, kind: str, action: str, reason: str = "") -> Record:
    content = {"kind": kind, "action": action, "reason": reason}
    return Record("decisions", "fractus.Decision", START_NS + second * 10**9, content)


def phases(path: Path, items: Iterable[Record]) -> list[str]:
    with path.open("wb") as file:
        write(file, items)
    return [state.phase for state in events_of(State, Replay([path]).events())]


def test_flight_home_is_shown_as_returning(tmp_path: Path) -> None:
    items = [
        decision(0, "control", "granted"),
        state(1, in_air=True),
        decision(2, "control", "returned"),  # at the end of a control point that is not the last
        state(3, in_air=True),
        decision(4, "control", "returned", "the mission is complete"),
        state(5, in_air=True),
        state(6, in_air=False),
        decision(7, "control", "granted"),
        state(8, in_air=True),
        decision(9, "takeover", "returnToLaunch"),
        state(10, in_air=True),
        decision(11, "takeover", "pilot"),
        state(12, in_air=True),
        state(13, in_air=True, mode="SMART_RTL"),
    ]
    assert phases(tmp_path / "flight.mcap", items) == [
        "in the air", "in the air", "returning", "on the ground", "in the air", "returning", "in the air", "returning",
    ]  # fmt: skip


def test_state_contains_the_start_of_the_flight_in_an_earlier_file(tmp_path: Path) -> None:
    paths = [tmp_path / "1.mcap", tmp_path / "2.mcap"]
    contents = [
        [state(0, in_air=False), state(1, in_air=True), state(2, in_air=True)],
        [state(3, in_air=True), state(4, in_air=False), state(5, in_air=True)],
    ]
    for path, content in zip(paths, contents, strict=True):
        with path.open("wb") as file:
            write(file, content)
    start_ms = START_NS // 1_000_000
    starts = [s.flight_ms for s in events_of(State, Replay(paths).events())]
    assert starts == [None, *[start_ms + 1_000] * 4, start_ms + 5_000]


def test_invalid_messages_are_skipped(tmp_path: Path) -> None:
    path = tmp_path / "odd.mcap"
    invalid = [
        Record("location", "foxglove.LocationFix", START_NS, {"latitude": "north", "longitude": 1}),
        Record("location", "foxglove.LocationFix", START_NS, {"latitude": 91.0, "longitude": 1.0}),
        Record("location", "foxglove.LocationFix", START_NS, {"latitude": 10**400, "longitude": 1.0}),
        Record("zones", "foxglove.GeoJSON", START_NS, {"geojson": "{"}),
        Record("zones", "foxglove.GeoJSON", START_NS, {"geojson": "[" * 50_000}),
        Record("attitude", "fractus.Attitude", START_NS, {"yaw_rad": None}),
    ]
    with path.open("wb") as file:
        write(file, [*invalid, *records(1)])
    events = list(Replay([path]).events())
    assert len(events_of(Fix, events)) == 5
    assert not events_of(Problem, events)


def test_picture_is_found_only_by_its_id(recording: Path) -> None:
    replay = Replay([recording])
    (picture,) = [event for event in replay.events() if type(event).__name__ == "Picture"]
    assert replay.picture(picture.id) == JPEG
    file, offset, index = picture.id.split("-")
    for wrong in (
        "",
        "0",
        "0-0-0",
        f"9-{offset}-{index}",
        f"{file}-{offset}-99999",
        f"{file}-{int(offset) + 1}-0",
        "../etc-1-1",
    ):
        assert replay.picture(wrong) is None
    recording.unlink()
    assert replay.picture(picture.id) is None


def parse_event(message: bytes) -> tuple[str, list[dict[str, Any]]]:
    id_, data = message.decode().strip().split("\n")
    return id_.removeprefix("id: "), json.loads(data.removeprefix("data: "))


async def test_replay_resumes_after_the_last_received_event(recording: Path) -> None:
    replay = Replay([recording])
    complete = [parse_event(message) async for message in replay.stream("")]
    events = [event for _, batch in complete for event in batch]
    assert events[0] == {"type": "reset"}
    assert events[-1] == {"type": "end"}
    rest = [event for message in [parse_event(m) async for m in replay.stream("7")] for event in message[1]]
    assert rest == events[1 + 7 :]
    assert complete[-1][0] == str(len(events) - 2)


def fix(drone: str, number: int) -> Fix:
    return Fix(drone, 1_000 * number, 39.0 + number * 1e-6, 22.0, 10.0, 0.0)


async def first(hub: Hub, last_id: str = "") -> tuple[str, list[dict[str, Any]]]:
    async with aclosing(hub.stream(last_id)) as stream:
        return parse_event(await anext(stream))


async def test_reconnected_page_receives_only_missed_events() -> None:
    hub = Hub()
    hub.publish([fix("a", 1)])
    id_, _ = await first(hub)
    hub.publish([fix("a", 2), fix("a", 3)])
    async with aclosing(hub.stream(id_)) as stream:
        await anext(stream)
        _, missed = parse_event(await anext(stream))
    assert [event["time_ms"] for event in missed] == [2_000, 3_000]
    _, events = await first(hub, "0123abcd-1")
    assert events[0] == {"type": "reset"}, "the event id belongs to another server, so the page must reset"


async def test_slow_page_receives_current_state_instead_of_missed_events() -> None:
    hub = Hub()
    async with aclosing(hub.stream("")) as stream:
        await anext(stream)
        for number in range(RECENT + 1):
            hub.publish([fix("a", number)])
        _, events = parse_event(await anext(stream))
    assert events[0] == {"type": "reset"}
    assert events[-1] == {"type": "live"}
    assert len(events) <= TRAIL + 3
    assert events[-2]["time_ms"] == RECENT * 1_000


async def test_new_page_receives_current_state() -> None:
    hub = Hub()
    hub.publish([fix("a", 1), State("a", 1, 10.0, 1.0, 0.5, "GUIDED", "Navigator", "in the air")])
    hub.publish([State("a", 2, 11.0, 1.0, 0.4, "GUIDED", "Navigator", "in the air")])
    _, events = await first(hub)
    assert [event["type"] for event in events] == ["reset", "state", "fix", "live"]
    assert events[1]["altitude_m"] == 11.0


def test_trail_covers_the_flight_with_a_limited_number_of_positions() -> None:
    trail = Trail()
    for number in range(10_000):
        trail.add(fix("a", number))
    fixes = list(trail)
    assert TRAIL // 2 <= len(fixes) <= TRAIL
    assert (fixes[0].time_ms, fixes[-1].time_ms) == (0, 9_999_000)
    assert max(b.time_ms - a.time_ms for a, b in itertools.pairwise(fixes)) <= 40_000


async def test_recordings_directory_is_followed_while_services_write(tmp_path: Path) -> None:
    following = GrowingRecordings(tmp_path)
    task = asyncio.create_task(following.run())
    buffer = io.BytesIO()
    write(buffer, records())
    data = buffer.getvalue()
    path = tmp_path / "mobility" / "000001-20260528T202640Z.mcap"
    try:
        async with asyncio.timeout(20), aclosing(following.stream("")) as stream:
            await anext(stream)
            path.parent.mkdir()
            path.write_bytes(data[: len(data) // 2])
            _, begun = parse_event(await anext(stream))
            with path.open("ab") as file:
                file.write(data[len(data) // 2 :])
            _, ended = parse_event(await anext(stream))
    finally:
        task.cancel()
    fixes = [event for event in begun + ended if event["type"] == "fix"]
    assert len(fixes) == 20
    assert any(event["type"] == "verdict" for event in begun + ended)


@pytest.fixture
async def served(recording: Path) -> AsyncIterator[tuple[str, ViewServer]]:
    live_view = ViewServer(Replay([recording]), frozenset())
    runner = web.AppRunner(live_view.application(), shutdown_timeout=0.1)
    await runner.setup()
    site = web.TCPSite(runner, "127.0.0.1", 0)
    await site.start()
    yield f"http://127.0.0.1:{runner.addresses[0][1]}", live_view
    await runner.cleanup()


@pytest.fixture
async def limited(recording: Path) -> AsyncIterator[tuple[int, ViewServer]]:
    """Serve at most 20 connections."""
    live_view = ViewServer(Replay([recording]), frozenset())
    runner = web.AppRunner(live_view.application(), shutdown_timeout=0.1)
    await runner.setup()
    assert runner.server is not None
    limit = ConnectionLimit(runner.server, 20)
    server = await asyncio.get_running_loop().create_server(limit, "127.0.0.1", 0)
    yield server.sockets[0].getsockname()[1], live_view
    server.close()
    await runner.cleanup()


async def test_idle_connections_shut_nobody_out(limited: tuple[int, ViewServer]) -> None:
    port, live_view = limited
    live_view.source = Hub()  # type: ignore[assignment]
    bearer = {hdrs.AUTHORIZATION: f"Bearer {live_view.token}"}
    address = f"http://127.0.0.1:{port}"
    async with (
        asyncio.timeout(20),
        ClientSession() as session,
        session.get(f"{address}/stream", headers=bearer) as page,
    ):
        await page.content.readuntil(b"\n\n")
        idle = [await asyncio.open_connection("127.0.0.1", port) for _ in range(100)]
        for path, status in (("/healthz", 200), ("/", 401)):
            async with session.get(address + path) as response:
                assert response.status == status
        async with session.get(address, headers=bearer) as response:
            assert response.status == 200
        # The limit closed the oldest idle connections, but not the open page.
        closed = [await reader.read(1) for reader, _ in idle[:70]]
        assert closed == [b""] * 70
        assert not page.content.at_eof()
        for _, writer in idle:
            writer.close()


async def test_connection_without_authorized_request_is_closed(
    limited: tuple[int, ViewServer], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fractus_runtime.connection_limit.UNAUTHORIZED_TIMEOUT_S", 0.2)
    port, live_view = limited
    async with asyncio.timeout(20):
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n")  # never completed
        assert await reader.read() == b""
        writer.close()
        bearer = {hdrs.AUTHORIZATION: f"Bearer {live_view.token}"}
        async with ClientSession(headers=bearer) as session, session.get(f"http://127.0.0.1:{port}/") as response:
            await asyncio.sleep(0.4)
            assert response.status == 200
            assert await response.read()


async def test_requests_without_token_are_refused(served: tuple[str, ViewServer]) -> None:
    address, live_view = served
    async with ClientSession() as session:
        for path in (
            "/",
            "/stream",
            "/pictures/0-0-0",
            "/thumbnails/0-0-0",
            "/?token=wrong",
            "/?token=%FF",
            "/sources.sha256",
            "/nothing",
        ):
            for headers in ({}, {hdrs.AUTHORIZATION: "Bearer wrong"}, {hdrs.COOKIE: f"fractus-view-{address[-5:]}=x"}):
                async with session.get(address + path, headers=headers) as response:
                    assert response.status == 401
                    assert "fractus view" in await response.text()
        authorized = {hdrs.AUTHORIZATION: f"Bearer {live_view.token}"}
        async with session.get(address, headers=authorized) as response:
            assert response.status == 200
        async with session.get(f"{address}/plans.html", headers=authorized) as response:
            assert response.status == 404


async def test_health_endpoint_requires_no_token(served: tuple[str, ViewServer]) -> None:
    address, live_view = served
    async with ClientSession() as session:
        async with session.get(f"{address}/healthz") as response:
            assert (response.status, await response.text()) == (200, "ok\n")
        broken = live_view.source.run = AsyncMock(side_effect=RuntimeError)  # type: ignore[method-assign]
        live_view._running = asyncio.create_task(broken())
        await asyncio.wait({live_view._running})
        async with session.get(f"{address}/healthz") as response:
            assert response.status == 503


async def test_token_in_address_is_replaced_by_http_only_cookie(served: tuple[str, ViewServer]) -> None:
    address, live_view = served
    async with ClientSession() as session:
        async with session.get(f"{address}/?token={live_view.token}", allow_redirects=False) as response:
            assert (response.status, response.headers["Location"]) == (303, "/")
            cookie = response.headers["Set-Cookie"]
        assert "HttpOnly" in cookie
        assert "SameSite=Strict" in cookie
        async with session.get(address, headers={hdrs.COOKIE: cookie.partition(";")[0]}) as response:
            assert response.status == 200


async def test_cookie_is_secure_behind_tls(served: tuple[str, ViewServer]) -> None:
    address, live_view = served
    async with ClientSession() as session:
        for proto, secure in (("https", True), ("http", False)):
            headers = {"X-Forwarded-Proto": proto}
            async with session.get(
                f"{address}/?token={live_view.token}", headers=headers, allow_redirects=False
            ) as response:
                assert ("Secure" in response.headers["Set-Cookie"]) is secure


async def test_open_page_is_closed_when_the_token_changes(
    served: tuple[str, ViewServer], monkeypatch: pytest.MonkeyPatch
) -> None:
    address, live_view = served
    hub = live_view.source = Hub()  # type: ignore[assignment]
    monkeypatch.setattr(server, "KEEPALIVE_S", 0.05)
    async with ClientSession(headers={hdrs.AUTHORIZATION: f"Bearer {live_view.token}"}) as session:
        async with asyncio.timeout(20), session.get(f"{address}/stream") as response:
            await response.content.readuntil(b"\n\n")
            live_view.token = "a new random token"
            hub.publish([fix("a", 1)])
            assert b"fix" not in await response.read()
        async with session.get(f"{address}/stream") as response:
            assert response.status == 401


async def test_token_follows_its_file(
    served: tuple[str, ViewServer], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _, live_view = served
    file = tmp_path / "token"
    file.write_text("first random token\n")
    monkeypatch.setattr(command, "TOKEN_INTERVAL_S", 0.01)
    task = asyncio.create_task(command._follow_token(file, live_view))

    output = ""

    async def until(condition: Callable[[], bool]) -> None:
        nonlocal output
        async with asyncio.timeout(20):
            while not condition():
                await asyncio.sleep(0.01)
                output += capsys.readouterr().err

    try:
        await until(lambda: live_view.token == "first random token")
        file.write_text("second random token\n")
        await until(lambda: live_view.token == "second random token")
        file.write_bytes(b"\xff" * 32)
        await until(lambda: "access denied to all pages: " in output and "contains no token" in output)
        assert live_view.token != "second random token"
        file.unlink()
        await until(lambda: "cannot read" in output)
        file.write_text("third random token\n")
        await until(lambda: live_view.token == "third random token")
        await until(lambda: "token read again from" in output)
    finally:
        task.cancel()


async def test_other_methods_and_foreign_host_names_are_refused(served: tuple[str, ViewServer]) -> None:
    address, live_view = served
    bearer = {hdrs.AUTHORIZATION: f"Bearer {live_view.token}"}
    async with ClientSession() as session:
        for method in ("POST", "PUT", "DELETE", "PATCH", "OPTIONS"):
            async with session.request(method, address, headers=bearer) as response:
                assert response.status == 405
        for host, status in (
            ("evil.example", 421),
            ("localhost:1", 200),
            ("[::1]:80", 200),
            ("10.1.2.3", 200),
            ("", 421),
        ):
            async with session.get(address, headers={**bearer, hdrs.HOST: host}) as response:
                assert response.status == status, host
        async with session.head(f"{address}/stream", headers=bearer) as response:
            assert response.content_type == "text/event-stream"


async def test_every_response_has_security_headers(served: tuple[str, ViewServer]) -> None:
    address, live_view = served
    async with ClientSession(headers={hdrs.AUTHORIZATION: f"Bearer {live_view.token}"}) as session:
        for path in ("/", "/stream", "/nothing", "/pictures/0-0-0"):
            async with session.get(address + path) as response:
                policy = response.headers["Content-Security-Policy"]
                assert "default-src 'none'" in policy
                assert "unsafe" not in policy
                assert response.headers["X-Content-Type-Options"] == "nosniff"
        async with session.get(f"{address}/stream", headers={"Last-Event-ID": "7"}) as response:
            assert parse_event((await response.read()).split(b"\n\n")[0])[1][0]["type"] != "reset"


async def test_view_metrics_count_requests(recording: Path) -> None:
    port = free_port()
    metrics = free_port()
    site = ServerOptions("127.0.0.1", port, (), None, f"127.0.0.1:{metrics}")
    task = asyncio.create_task(command._serve(GrowingRecordings(recording.parent), site))
    try:
        async with asyncio.timeout(20), ClientSession() as session:
            while not (await asyncio.to_thread(scraped, metrics)):
                assert not task.done()
            async with session.get(f"http://127.0.0.1:{port}/") as response:
                assert response.status == 401
            async with session.get(f"http://127.0.0.1:{port}/healthz") as response:
                assert response.status == 200
            samples = await asyncio.to_thread(scraped, metrics)
            assert samples["fractus_view_requests_total", "401"] == samples["fractus_view_requests_total", "200"] == 1
            assert samples["fractus_view_pages",] == 0
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def test_view_metrics_count_open_pages(served: tuple[str, ViewServer]) -> None:
    address, live_view = served
    live_view.source = Hub()  # type: ignore[assignment]

    def pages() -> float:
        return values(metrics_text(live_view.metrics()).decode())["fractus_view_pages",]

    async with ClientSession(headers={hdrs.AUTHORIZATION: f"Bearer {live_view.token}"}) as session, asyncio.timeout(20):
        assert pages() == 0
        async with session.get(f"{address}/stream") as response:
            await response.content.readuntil(b"\n\n")
            assert pages() == 1


def test_invalid_arguments_are_refused_with_message(
    tmp_path: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("KUBECONFIG", str(tmp_path / "nothing"))
    (tmp_path / "short").write_text("secret\n")
    (tmp_path / "text.mcap").write_text("no recording")
    for arguments, message in (
        ([], "or specify recordings to replay"),
        ([str(recording), "--recordings", str(tmp_path)], "specify only one source"),
        ([str(recording), "--context", "k3s"], "specify only one source"),
        ([str(recording), "--token-file", str(tmp_path / "short")], "contains no token; write at least 16"),
        ([str(tmp_path / "text.mcap")], "is not an MCAP file"),
        ([str(recording), "--listen", "8650"], "is not HOST:PORT"),
        ([str(recording), "--listen", "203.0.113.1:8650"], "choose another with --listen"),
    ):
        result = CliRunner().invoke(view, arguments)
        assert result.exit_code != 0
        assert message in result.output


def test_built_page_matches_its_sources() -> None:
    """If this test fails, run `make view`."""
    web_part = ROOT / "view" / "web"
    root_files = ("index.html", "package-lock.json", "package.json", "plans.html", "tsconfig.json", "vite.config.ts")
    files = [path for folder in ("public", "src") for path in (web_part / folder).rglob("*") if path.is_file()]
    digests = {
        path.relative_to(web_part).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in [*files, *(web_part / name for name in root_files)]
    }
    lines = (PAGE / "sources.sha256").read_text().splitlines()
    assert {name: digest for digest, name in (line.split("  ") for line in lines)} == digests


def test_typescript_types_of_events_are_current() -> None:
    assert (ROOT / "view/web/src/events.ts").read_text() == typescript_types(), "run `make generate`"


@pytest.mark.parametrize("name", ["index.html", "plans.html"])
def test_page_loads_no_external_resources(name: str) -> None:
    html = (PAGE / name).read_text()
    assert re.findall(r'(?:src|href)="([^"]+)"', html)
    assert all(re.match(r"[/#]", url) for url in re.findall(r'(?:src|href)="([^"]+)"', html))
    assert not re.search(r"<script>|<style|style=|\son\w+=", html)
