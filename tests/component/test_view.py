"""The live view without a browser: recordings read while they are written, what pages are told, and who may look."""

from __future__ import annotations

import asyncio
import hashlib
import io
import itertools
import json
import re
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import aclosing
from dataclasses import fields
from pathlib import Path
from typing import Any, get_args
from unittest.mock import AsyncMock

import pytest
from aiohttp import ClientSession, hdrs, web
from click.testing import CliRunner
from fractus_cluster.ports import free_port
from fractus_runtime.metrics import metrics_text
from fractus_services.recording import messages
from fractus_services.recording.messages import Record
from fractus_services.recording.segment_writer import McapWriter
from fractus_view import command, server
from fractus_view.command import Site, view
from fractus_view.events import Event, Fix, Problem, State, Verdict
from fractus_view.hub import RECENT, TRAIL, Hub, Trail
from fractus_view.mcap_tail import Damaged, Tail
from fractus_view.server import PAGE, View
from fractus_view.sources import Following, Replay
from scraping import scraped, values

ROOT = Path(__file__).parents[2]
START_NS = 1_780_000_000_000_000_000
JPEG = b"\xff\xd8 a picture \xff\xd9"


def records(seconds: int = 4) -> list[Record]:
    """A flight as the services record it: 20 positions a second, a refused call, a picture."""
    found: list[Record] = []
    for i in range(seconds * 20):
        time_ns = START_NS + i * 50_000_000
        found.append(messages.attitude(time_ns, 0.0, 0.0, -1.5707963))
        found.append(messages.location(time_ns, "drone-1", 39.36 + i * 1e-6, 22.95, 30.0))
    entry = {
        "kind": "call", "time": "2026-05-28T20:26:42+00:00", "caller": "spiffe://f/ns/d/app/a/component/Navigator/instance/n",
        "method": "Goto", "action": "deny", "code": "InsideExclusionZone", "reason": "inside", "policies": ["school"],
    }  # fmt: skip
    found += messages.audit_records(entry, "drone-1")
    found += messages.audit_records({"kind": "grant", "time": entry["time"]}, "drone-1")
    found.append(messages.picture(START_NS + 10**9, "drone-1", JPEG))
    return found


def write(file: Any, told: Iterable[Record], flush_every: int = 40) -> None:
    out = McapWriter(file)
    for number, record in enumerate(told):
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


def of(kind: type, events: Iterable[Event]) -> list[Any]:
    return [event for event in events if isinstance(event, kind)]


# Recordings


def test_a_file_that_grows_says_the_same_as_the_whole_of_it(recording: Path, tmp_path: Path) -> None:
    data = recording.read_bytes()
    growing = tmp_path / "growing.mcap"
    whole = list(Tail(recording).read())
    assert len(whole) == len(records())
    tail = Tail(growing)
    found = []
    with growing.open("wb") as file:
        for start in range(0, len(data), 997):
            file.write(data[start : start + 997])
            file.flush()
            found += list(tail.read())
    assert found == whole
    assert tail.finished


def test_damage_is_told_and_what_was_before_it_stays(recording: Path) -> None:
    data = bytearray(recording.read_bytes())
    data[len(data) // 2] ^= 0xFF
    recording.write_bytes(data)
    events = list(Replay([recording]).events())
    assert of(Fix, events)
    (problem,) = of(Problem, events)
    assert "damaged" in problem.text
    recording.write_bytes(b"no recording at all")
    with pytest.raises(Damaged, match="not an MCAP"):
        list(Tail(recording).read())


def test_positions_are_told_five_times_a_second_with_the_heading(recording: Path) -> None:
    fixes = of(Fix, Replay([recording]).events())
    assert [b.time_ms - a.time_ms for a, b in itertools.pairwise(fixes)] == [200] * (len(fixes) - 1)
    assert len(fixes) == 20
    assert {fix.heading_deg for fix in fixes} == {270.0}


def test_only_what_was_judged_is_a_verdict(recording: Path) -> None:
    (verdict,) = of(Verdict, Replay([recording]).events())
    assert (verdict.component, verdict.method, verdict.action) == ("Navigator", "Goto", "deny")
    assert (verdict.reason, list(verdict.policies)) == ("inside", ["school"])


def test_messages_of_another_shape_are_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "odd.mcap"
    odd = [
        Record("location", "foxglove.LocationFix", START_NS, {"latitude": "north", "longitude": 1}),
        Record("location", "foxglove.LocationFix", START_NS, {"latitude": 91.0, "longitude": 1.0}),
        Record("zones", "foxglove.GeoJSON", START_NS, {"geojson": "{"}),
        Record("attitude", "fractus.Attitude", START_NS, {"yaw_rad": None}),
    ]
    with path.open("wb") as file:
        write(file, [*odd, *records(1)])
    events = list(Replay([path]).events())
    assert len(of(Fix, events)) == 5
    assert not of(Problem, events)


def test_a_picture_is_found_by_its_id_and_nothing_else(recording: Path) -> None:
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


# What pages are told


def heard(message: bytes) -> tuple[str, list[dict[str, Any]]]:
    id_, data = message.decode().strip().split("\n")
    return id_.removeprefix("id: "), json.loads(data.removeprefix("data: "))


async def test_a_replay_is_resumed_where_the_page_lost_it(recording: Path) -> None:
    replay = Replay([recording])
    whole = [heard(message) async for message in replay.stream("")]
    events = [event for _, batch in whole for event in batch]
    assert events[0] == {"type": "reset"}
    assert events[-1] == {"type": "end"}
    rest = [event for message in [heard(m) async for m in replay.stream("7")] for event in message[1]]
    assert rest == events[1 + 7 :]
    assert whole[-1][0] == str(len(events) - 2)


def fix(drone: str, number: int) -> Fix:
    return Fix(drone, 1_000 * number, 39.0 + number * 1e-6, 22.0, 10.0, 0.0)


async def first(hub: Hub, last_id: str = "") -> tuple[str, list[dict[str, Any]]]:
    async with aclosing(hub.stream(last_id)) as stream:
        return heard(await anext(stream))


async def test_a_page_that_comes_back_hears_what_it_missed_and_no_more() -> None:
    hub = Hub()
    hub.publish([fix("a", 1)])
    id_, _ = await first(hub)
    hub.publish([fix("a", 2), fix("a", 3)])
    async with aclosing(hub.stream(id_)) as stream:
        await anext(stream)
        _, missed = heard(await anext(stream))
    assert [event["time_ms"] for event in missed] == [2_000, 3_000]
    _, other = await first(hub, "0123abcd-1")
    assert other[0] == {"type": "reset"}, "of another server: it knows nothing of this one"


async def test_a_slow_page_gets_what_is_known_instead_of_what_it_missed() -> None:
    hub = Hub()
    async with aclosing(hub.stream("")) as stream:
        await anext(stream)
        for number in range(RECENT + 1):
            hub.publish([fix("a", number)])
        _, found = heard(await anext(stream))
    assert found[0] == {"type": "reset"}
    assert found[-1] == {"type": "live"}
    assert len(found) <= TRAIL + 3
    assert found[-2]["time_ms"] == RECENT * 1_000


async def test_a_new_page_learns_all_that_holds() -> None:
    hub = Hub()
    hub.publish([fix("a", 1), State("a", 1, 10.0, 1.0, 0.5, "GUIDED", "Navigator", "in the air")])
    hub.publish([State("a", 2, 11.0, 1.0, 0.4, "GUIDED", "Navigator", "in the air")])
    _, found = await first(hub)
    assert [event["type"] for event in found] == ["reset", "state", "fix", "live"]
    assert found[1]["altitude_m"] == 11.0


def test_a_path_is_whole_in_a_bounded_number_of_positions() -> None:
    trail = Trail()
    for number in range(10_000):
        trail.add(fix("a", number))
    kept = list(trail)
    assert TRAIL // 2 <= len(kept) <= TRAIL
    assert (kept[0].time_ms, kept[-1].time_ms) == (0, 9_999_000)
    assert max(b.time_ms - a.time_ms for a, b in itertools.pairwise(kept)) <= 40_000


async def test_a_directory_is_followed_while_services_write_to_it(tmp_path: Path) -> None:
    following = Following(tmp_path)
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
            _, begun = heard(await anext(stream))
            with path.open("ab") as file:
                file.write(data[len(data) // 2 :])
            _, ended = heard(await anext(stream))
    finally:
        task.cancel()
    fixes = [event for event in begun + ended if event["type"] == "fix"]
    assert len(fixes) == 20
    assert any(event["type"] == "verdict" for event in begun + ended)


# Who may look


@pytest.fixture
async def served(recording: Path) -> AsyncIterator[tuple[str, View]]:
    shown = View(Replay([recording]), frozenset())
    runner = web.AppRunner(shown.application(), shutdown_timeout=0.1)
    await runner.setup()
    site = web.TCPSite(runner, "127.0.0.1", 0)
    await site.start()
    yield f"http://127.0.0.1:{runner.addresses[0][1]}", shown
    await runner.cleanup()


async def test_without_the_token_nothing_is_shown(served: tuple[str, View]) -> None:
    address, shown = served
    async with ClientSession() as session:
        for path in ("/", "/stream", "/pictures/0-0-0", "/?token=wrong", "/?token=%FF", "/sources.sha256", "/nothing"):
            for given in ({}, {hdrs.AUTHORIZATION: "Bearer wrong"}, {hdrs.COOKIE: f"fractus-view-{address[-5:]}=x"}):
                async with session.get(address + path, headers=given) as answer:
                    assert answer.status == 401
                    assert "fractus view" in await answer.text()
        async with session.get(address, headers={hdrs.AUTHORIZATION: f"Bearer {shown.token}"}) as answer:
            assert answer.status == 200


async def test_whether_it_works_is_told_without_the_token_and_nothing_else(served: tuple[str, View]) -> None:
    address, shown = served
    async with ClientSession() as session:
        async with session.get(f"{address}/healthz") as answer:
            assert (answer.status, await answer.text()) == (200, "ok\n")
        broken = shown.source.run = AsyncMock(side_effect=RuntimeError)  # type: ignore[method-assign]
        shown._running = asyncio.create_task(broken())
        await asyncio.wait({shown._running})
        async with session.get(f"{address}/healthz") as answer:
            assert answer.status == 503


async def test_the_token_leaves_the_address_for_a_cookie_that_scripts_do_not_see(served: tuple[str, View]) -> None:
    address, shown = served
    async with ClientSession() as session:
        async with session.get(f"{address}/?token={shown.token}", allow_redirects=False) as answer:
            assert (answer.status, answer.headers["Location"]) == (303, "/")
            cookie = answer.headers["Set-Cookie"]
        assert "HttpOnly" in cookie
        assert "SameSite=Strict" in cookie
        async with session.get(address, headers={hdrs.COOKIE: cookie.partition(";")[0]}) as answer:
            assert answer.status == 200


async def test_behind_tls_the_cookie_is_for_tls_alone(served: tuple[str, View]) -> None:
    address, shown = served
    async with ClientSession() as session:
        for proto, secure in (("https", True), ("http", False)):
            headers = {"X-Forwarded-Proto": proto}
            async with session.get(f"{address}/?token={shown.token}", headers=headers, allow_redirects=False) as answer:
                assert ("Secure" in answer.headers["Set-Cookie"]) is secure


async def test_an_open_page_is_closed_to_who_knows_an_old_token(
    served: tuple[str, View], monkeypatch: pytest.MonkeyPatch
) -> None:
    address, shown = served
    hub = shown.source = Hub()  # type: ignore[assignment]
    monkeypatch.setattr(server, "ALIVE_S", 0.05)
    async with ClientSession(headers={hdrs.AUTHORIZATION: f"Bearer {shown.token}"}) as session:
        async with asyncio.timeout(20), session.get(f"{address}/stream") as answer:
            await answer.content.readuntil(b"\n\n")
            shown.token = "another one of chance"
            hub.publish([fix("a", 1)])
            assert b"fix" not in await answer.read()
        async with session.get(f"{address}/stream") as answer:
            assert answer.status == 401


async def test_the_token_is_what_its_file_holds_now(
    served: tuple[str, View], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _, shown = served
    file = tmp_path / "token"
    file.write_text("the first of chance\n")
    monkeypatch.setattr(command, "TOKEN_PERIOD_S", 0.01)
    task = asyncio.create_task(command._follow_token(file, shown))

    said = ""

    async def until(wanted: Callable[[], bool]) -> None:
        nonlocal said
        async with asyncio.timeout(20):
            while not wanted():
                await asyncio.sleep(0.01)
                said += capsys.readouterr().err

    try:
        await until(lambda: shown.token == "the first of chance")
        file.write_text("the second of chance\n")
        await until(lambda: shown.token == "the second of chance")
        file.write_bytes(b"\xff" * 32)
        await until(lambda: "no one may look: " in said and "has no token" in said)
        assert shown.token != "the second of chance"
        file.unlink()
        await until(lambda: "cannot be read" in said)
        file.write_text("the third of chance\n")
        await until(lambda: shown.token == "the third of chance")
        await until(lambda: said.endswith("has a token again\n"))
    finally:
        task.cancel()


async def test_it_only_reads_and_answers_to_no_foreign_name(served: tuple[str, View]) -> None:
    address, shown = served
    bearer = {hdrs.AUTHORIZATION: f"Bearer {shown.token}"}
    async with ClientSession() as session:
        for method in ("POST", "PUT", "DELETE", "PATCH", "OPTIONS"):
            async with session.request(method, address, headers=bearer) as answer:
                assert answer.status == 405
        for host, status in (
            ("evil.example", 421),
            ("localhost:1", 200),
            ("[::1]:80", 200),
            ("10.1.2.3", 200),
            ("", 421),
        ):
            async with session.get(address, headers={**bearer, hdrs.HOST: host}) as answer:
                assert answer.status == status, host
        async with session.head(f"{address}/stream", headers=bearer) as answer:
            assert answer.content_type == "text/event-stream"


async def test_every_answer_keeps_the_page_to_itself(served: tuple[str, View]) -> None:
    address, shown = served
    async with ClientSession(headers={hdrs.AUTHORIZATION: f"Bearer {shown.token}"}) as session:
        for path in ("/", "/stream", "/nothing", "/pictures/0-0-0"):
            async with session.get(address + path) as answer:
                policy = answer.headers["Content-Security-Policy"]
                assert "default-src 'none'" in policy
                assert "unsafe" not in policy
                assert answer.headers["X-Content-Type-Options"] == "nosniff"
        async with session.get(f"{address}/stream", headers={"Last-Event-ID": "7"}) as answer:
            assert heard((await answer.read()).split(b"\n\n")[0])[1][0]["type"] != "reset"


# The command, and the page that is checked in


async def test_requests_and_open_pages_are_counted_for_prometheus(recording: Path) -> None:
    port = free_port()
    metrics = free_port()
    site = Site("127.0.0.1", port, (), None, f"127.0.0.1:{metrics}")
    task = asyncio.create_task(command._serve(Following(recording.parent), site))
    try:
        async with asyncio.timeout(20), ClientSession() as session:
            while not (await asyncio.to_thread(scraped, metrics)):
                assert not task.done()
            async with session.get(f"http://127.0.0.1:{port}/") as answer:
                assert answer.status == 401
            async with session.get(f"http://127.0.0.1:{port}/healthz") as answer:
                assert answer.status == 200
            seen = await asyncio.to_thread(scraped, metrics)
            assert seen["fractus_view_requests_total", "401"] == seen["fractus_view_requests_total", "200"] == 1
            assert seen["fractus_view_pages",] == 0
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def test_an_open_page_counts(served: tuple[str, View]) -> None:
    address, shown = served
    shown.source = Hub()  # type: ignore[assignment]

    def pages() -> float:
        return values(metrics_text(shown.metrics()).decode())["fractus_view_pages",]

    async with ClientSession(headers={hdrs.AUTHORIZATION: f"Bearer {shown.token}"}) as session, asyncio.timeout(20):
        assert pages() == 0
        async with session.get(f"{address}/stream") as answer:
            await answer.content.readuntil(b"\n\n")
            assert pages() == 1


def test_the_command_says_what_is_wrong(tmp_path: Path, recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KUBECONFIG", str(tmp_path / "nothing"))
    (tmp_path / "short").write_text("secret\n")
    (tmp_path / "text.mcap").write_text("no recording")
    for arguments, said in (
        ([], "or give recordings to replay"),
        ([str(recording), "--recordings", str(tmp_path)], "one of them"),
        ([str(recording), "--context", "k3s"], "one of them"),
        ([str(recording), "--token-file", str(tmp_path / "short")], "has no token: write 16"),
        ([str(tmp_path / "text.mcap")], "is not an MCAP file"),
        ([str(recording), "--listen", "8650"], "is not HOST:PORT"),
        ([str(recording), "--listen", "203.0.113.1:8650"], "choose another with --listen"),
    ):
        done = CliRunner().invoke(view, arguments)
        assert done.exit_code != 0
        assert said in done.output


def test_the_page_was_built_of_these_sources() -> None:
    """Run `make view` where this fails."""
    web_part = ROOT / "view" / "web"
    named = ("index.html", "package-lock.json", "package.json", "tsconfig.json", "vite.config.ts")
    inside = [path for folder in ("public", "src") for path in (web_part / folder).rglob("*") if path.is_file()]
    now = {
        path.relative_to(web_part).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in [*inside, *(web_part / name for name in named)]
    }
    lines = (PAGE / "sources.sha256").read_text().splitlines()
    assert {name: digest for digest, name in (line.split("  ") for line in lines)} == now


def test_the_page_knows_the_fields_of_events() -> None:
    declared = dict(
        re.findall(r"export interface (\w+) \{(.*?)\n\}", (ROOT / "view/web/src/events.ts").read_text(), re.DOTALL)
    )
    for kind in get_args(Event):
        names = re.findall(r"^  (\w+):", declared[kind.__name__], re.MULTILINE)
        assert names == ["type", *(field.name for field in fields(kind))]
        assert f'type: "{kind.__name__.lower()}"' in declared[kind.__name__]


def test_the_page_names_nothing_that_is_elsewhere() -> None:
    html = (PAGE / "index.html").read_text()
    assert re.findall(r'(?:src|href)="([^"]+)"', html)
    assert all(re.match(r"[/#]", found) for found in re.findall(r'(?:src|href)="([^"]+)"', html))
    assert not re.search(r"<script>|<style|style=|\son\w+=", html)
