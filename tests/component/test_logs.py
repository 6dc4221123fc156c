"""`fractus logs` on an API server: which lines, in which order, what comes while it follows, and what cannot be read."""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import pytest
from fractus_cli import log_follower, log_reader, main
from kube_server import kubeconfig_for
from logs_server import LogServer, pod

Run = Callable[..., Awaitable[tuple[int, list[str], list[str]]]]

HOUR = "2026-01-01T10:"
NAVIGATOR = [f"{HOUR}00:01.000000001Z takes off", f"{HOUR}00:03.5Z flies", f"{HOUR}00:05.5Z lands"]
VIEWER = [f"{HOUR}00:01Z waits", f"{HOUR}00:04Z sees\ta car"]


@contextlib.asynccontextmanager
async def serving(server: LogServer, directory: Path) -> AsyncIterator[Path]:
    """The server on a port, and a kubeconfig for it."""
    listener = await asyncio.start_server(server, "127.0.0.1", 0)
    port = listener.sockets[0].getsockname()[1]
    try:
        async with asyncio.timeout(30.0):
            yield kubeconfig_for(directory, f"http://127.0.0.1:{port}", {})
    finally:
        listener.close()
        await server.stop()


@pytest.fixture
def server() -> LogServer:
    made = LogServer()
    made.pods["default"] = [pod("Navigator", "drone-1"), pod("GroundViewer", "edge-1")]
    made.logs = {("navigator-drone-1", "1"): NAVIGATOR.copy(), ("groundviewer-edge-1", "1"): VIEWER.copy()}
    return made


@pytest.fixture
def run(server: LogServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Run:
    async def call(*arguments: str) -> tuple[int, list[str], list[str]]:
        async with serving(server, tmp_path) as config:
            code = await asyncio.to_thread(main.run, ["logs", *arguments, "--kubeconfig", str(config)])
        said = capsys.readouterr()
        return code, said.out.splitlines(), said.err.splitlines()

    return call


async def test_lines_of_all_pods_come_in_order_of_time_with_component_and_node(run: Run) -> None:
    code, lines, said = await run("traffic")
    assert (code, said) == (0, [])
    assert lines == [
        "GroundViewer@edge-1 | waits",
        "Navigator@drone-1 | takes off",
        "Navigator@drone-1 | flies",
        "GroundViewer@edge-1 | sees    a car",
        "Navigator@drone-1 | lands",
    ]


async def test_times_of_other_zones_and_lines_without_a_time_find_their_place(run: Run, server: LogServer) -> None:
    server.logs["navigator-drone-1", "1"] = ["2026-01-01T12:00:02.25+02:00 takes off", "unable to retrieve more"]
    assert (await run("traffic"))[1] == [
        "GroundViewer@edge-1 | waits",
        "Navigator@drone-1 | takes off",
        "Navigator@drone-1 | unable to retrieve more",
        "GroundViewer@edge-1 | sees    a car",
    ]


async def test_programs_get_a_document_a_line(run: Run) -> None:
    _, lines, _ = await run("traffic", "-o", "json", "--component", "GroundViewer", "--tail", "1")
    assert [json.loads(line) for line in lines] == [
        {
            "time": f"{HOUR}00:04Z",
            "component": "GroundViewer",
            "system": False,
            "node": "edge-1",
            "namespace": "default",
            "pod": "groundviewer-edge-1",
            "container": "groundviewer",
            "message": "sees\ta car",
        }
    ]


async def test_only_the_chosen_components_are_asked_for(run: Run, server: LogServer) -> None:
    _, lines, _ = await run("traffic", "--component", "Navigator")
    assert {line.split(" ")[0] for line in lines} == {"Navigator@drone-1"}
    server.requests.clear()
    await run("traffic", "--component", "Navigator", "--component", "GroundViewer")
    (listed,) = [asked for path, asked in server.requests if path.endswith("/pods")]
    assert listed["labelSelector"] == (
        "fractus.dev/application=traffic,fractus.dev/component in (Navigator,GroundViewer)"
    )


async def test_what_a_line_does_to_a_terminal_is_escaped(run: Run, server: LogServer) -> None:
    server.logs["navigator-drone-1", "1"] = [f"{HOUR}00:00Z \x1b[2Jgone"]
    assert "Navigator@drone-1 | \\x1b[2Jgone" in (await run("traffic"))[1]


@pytest.mark.parametrize(
    ("options", "asked"),
    [
        ((), {}),
        (("--tail", "2"), {"tailLines": "2"}),
        (("--since", "1h30m"), {"sinceSeconds": "5400"}),
        (("--since", "90s", "--tail", "5"), {"sinceSeconds": "90", "tailLines": "5"}),
        (("--tail", "-1"), {}),
    ],
)
async def test_how_much_is_left_to_the_nodes(
    run: Run, server: LogServer, options: tuple[str, ...], asked: dict[str, str]
) -> None:
    await run("traffic", *options)
    for given in [asked for path, asked in server.requests if path.endswith("/log")]:
        assert {k: v for k, v in given.items() if k not in {"container", "timestamps"}} == asked


@pytest.mark.parametrize("text", ["", "10", "ten", "0s", "1h 30m", "-5m", "99999999999999d"])
async def test_a_length_of_time_that_is_none_is_refused(run: Run, text: str) -> None:
    code, _, said = await run("traffic", "--since", text)
    assert code == 1
    assert f"{text!r} is no length of time, such as 90s, 10m or 1h30m" in said[0]


async def test_a_container_that_restarted_is_shown_with_the_one_before(run: Run, server: LogServer) -> None:
    server.pods["default"] = [pod("Navigator", "drone-1", run="2", before="1")]
    server.logs["navigator-drone-1", "2"] = [f"{HOUR}00:07Z takes off again"]
    _, lines, said = await run("traffic", "--tail", "2")
    assert lines == ["Navigator@drone-1 | lands", "Navigator@drone-1 | takes off again"]
    assert said == []


async def test_one_that_waits_to_be_started_again_is_shown_once(run: Run, server: LogServer) -> None:
    waiting = pod("Navigator", "drone-1", before="1", state="waiting")
    server.pods["default"] = [waiting]
    _, lines, _ = await run("traffic")
    assert lines == [f"Navigator@drone-1 | {word}" for word in ("takes off", "flies", "lands")]


async def test_one_that_never_started_is_told_with_its_reason(run: Run, server: LogServer) -> None:
    unbound = pod("GroundViewer", "")
    unbound["spec"].pop("nodeName")
    unbound["status"] = {"conditions": [{"type": "PodScheduled", "status": "False", "message": "no node has room"}]}
    server.pods["default"] = [pod("Navigator", "drone-1", state="waiting"), unbound]
    code, lines, said = await run("traffic")
    assert (code, lines) == (0, [])
    assert said == [
        "fractus: Navigator@drone-1 has not started: ImagePullBackOff: no such image",
        "fractus: GroundViewer has not started: no node has room",
    ]


async def test_no_pods_at_all_are_told_with_the_state_of_the_application(run: Run, server: LogServer) -> None:
    server.pods["default"] = []
    code, lines, said = await run("traffic")
    assert (code, lines) == (2, [])
    assert said == ["fractus: default/traffic has no pods (Deploying: pods start)"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["trafic"], "there is no Application default/trafic; did you mean traffic?"),
        (["xyz"], "there is no Application default/xyz; see fractus status"),
        (
            ["traffic", "--component", "navigater"],
            "default/traffic has no component navigater; did you mean Navigator?",
        ),
        (["traffic", "--component", "x"], "default/traffic has no component x; there are Navigator, GroundViewer"),
    ],
)
async def test_a_name_that_is_not_there_is_told_with_the_nearest(run: Run, arguments: list[str], said: str) -> None:
    assert await run(*arguments) == (1, [], [f"fractus: {said}"])


SYSTEM_PODS = [
    pod("agent", "drone-1", system=True),
    pod("mobility", "drone-1", system=True),
    pod("camera", "edge-1", system=True),
    pod("agent", "edge-2", system=True),
    pod("operator", "cloud-1", system=True),
]


async def test_parts_of_fractus_are_those_of_its_nodes_and_the_operator(run: Run, server: LogServer) -> None:
    server.pods["fractus-system"] = SYSTEM_PODS
    server.logs |= {(p["metadata"]["name"], "1"): [f"{HOUR}00:00Z starts"] for p in SYSTEM_PODS}
    code, lines, _ = await run("traffic", "--system")
    assert code == 0
    assert {line for line in lines if line.startswith("fractus-")} == {
        "fractus-agent@drone-1 | starts",
        "fractus-mobility@drone-1 | starts",
        "fractus-camera@edge-1 | starts",
        "fractus-operator@cloud-1 | starts",
    }
    asked = {path.split("/")[6]: asked for path, asked in server.requests if path.endswith("/log")}
    assert asked["agent-drone-1"]["sinceTime"] == "2026-01-01T00:00:00Z", "when the Application was made"
    assert "sinceTime" not in asked["navigator-drone-1"]


@pytest.mark.parametrize("path", ["/namespaces/fractus-system/pods", "fractus-system/pods/agent-drone-1/log"])
async def test_who_may_not_read_fractus_gets_what_remains(run: Run, server: LogServer, path: str) -> None:
    server.pods["fractus-system"] = [pod("agent", "drone-1", system=True)]
    server.refusals[path] = (403, "you may not")
    code, lines, said = await run("traffic", "--system")
    assert (code, len(lines)) == (2, 5)
    assert said == ["fractus: you may not; without the lines of Fractus"]


async def test_who_may_not_read_logs_is_told_so(run: Run, server: LogServer) -> None:
    server.refusals["/log"] = (403, "pods/log is forbidden")
    assert await run("traffic") == (1, [], ["fractus: pods/log is forbidden; check your permissions"])


DIALED = 'Get "https://10.1.0.2:10250/containerLogs/default/x/y": dial tcp 10.1.0.2:10250: connect: no route to host'


async def test_a_drone_out_of_reach_is_one_sentence_and_the_others_are_shown(run: Run, server: LogServer) -> None:
    server.pods["default"].append(pod("AerialViewer", "drone-1"))
    server.refusals |= {f"{part}-drone-1/log": (500, DIALED) for part in ("navigator", "aerialviewer")}
    code, lines, said = await run("traffic")
    assert code == 2
    assert lines == ["GroundViewer@edge-1 | waits", "GroundViewer@edge-1 | sees    a car"]
    assert said == [f"fractus: drone-1 is out of reach ({DIALED}); without the lines of Navigator, AerialViewer"]


async def test_a_log_that_is_gone_is_told_for_its_container(run: Run, server: LogServer) -> None:
    server.refusals["navigator-drone-1/log"] = (404, 'pods "navigator" not found')
    code, lines, said = await run("traffic")
    assert (code, len(lines)) == (2, 2)
    assert said == ['fractus: Navigator@drone-1 has no log: pods "navigator" not found']


async def test_a_node_that_never_answers_is_given_up(
    run: Run, server: LogServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log_reader, "_SILENCE_S", 0.3)
    original = LogServer._answer

    async def silent(self: LogServer, writer: asyncio.StreamWriter, path: str, asked: dict[str, str]) -> bool:
        if "navigator" in path:
            await asyncio.Event().wait()
        return await original(self, writer, path, asked)

    monkeypatch.setattr(LogServer, "_answer", silent)
    code, lines, said = await run("traffic")
    assert (code, len(lines)) == (2, 2)
    assert len(said) == 1
    assert said[0].startswith("fractus: drone-1 is out of reach (GET ")


async def test_no_api_server_is_no_drone_out_of_reach(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = kubeconfig_for(tmp_path, "http://127.0.0.1:1", {})
    assert await asyncio.to_thread(main.run, ["logs", "traffic", "--kubeconfig", str(config)]) == 1
    assert "check the cluster and --kubeconfig" in capsys.readouterr().err


# -- following --


@contextlib.asynccontextmanager
async def following(server: LogServer, directory: Path, *options: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """The command in a process of its own, which is interrupted as by Ctrl-C."""
    async with serving(server, directory) as config:
        arguments = ["-m", "fractus_cli", "logs", "traffic", "-f", "--kubeconfig", str(config), *options]
        pipe = asyncio.subprocess.PIPE
        process = await asyncio.create_subprocess_exec(sys.executable, *arguments, stdout=pipe, stderr=pipe)
        try:
            yield process
            process.send_signal(signal.SIGINT)
            said = (await process.communicate())[1].decode().splitlines()
            assert said[-1] == "fractus: interrupted"
            assert process.returncode == 130
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()


async def read(process: asyncio.subprocess.Process, lines: int = 1) -> list[str]:
    assert process.stdout is not None
    return [(await process.stdout.readline()).decode().rstrip("\n") for _ in range(lines)]


async def test_what_comes_is_shown_once_through_restarts_new_pods_and_lost_connections(
    server: LogServer, tmp_path: Path
) -> None:
    async with following(server, tmp_path, "--tail", "1") as process:
        assert await read(process, 2) == ["GroundViewer@edge-1 | sees    a car", "Navigator@drone-1 | lands"]
        # Within the second of the last line that was read.
        await server.write("navigator-drone-1", "1", f"{HOUR}00:05.6Z charges")
        assert await read(process) == ["Navigator@drone-1 | charges"]

        # It ended and another one runs before anyone looks: what the first said last comes before what the second says.
        server.logs["navigator-drone-1", "1"].append(f"{HOUR}00:05.6Z fails")
        server.logs["navigator-drone-1", "2"] = [f"{HOUR}00:09Z starts", f"{HOUR}00:09Z starts"]
        await server.change("MODIFIED", pod("Navigator", "drone-1", run="2", before="1"))
        assert await read(process, 3) == [f"Navigator@drone-1 | {word}" for word in ("fails", "starts", "starts")]

        server.logs["groundviewer-edge-2", "1"] = [f"{HOUR}00:01Z is", f"{HOUR}00:02Z new"]
        await server.change("ADDED", pod("GroundViewer", "edge-2"))
        assert await read(process, 2) == ["GroundViewer@edge-2 | is", "GroundViewer@edge-2 | new"]

        server.logs["navigator-drone-1", "2"].append(f"{HOUR}00:09Z flies on")
        await server.cut()
        assert await read(process) == ["Navigator@drone-1 | flies on"]
        await server.change("DELETED", server.pods["default"][-1])
        await server.write("navigator-drone-1", "2", f"{HOUR}00:10Z lands")
        assert await read(process) == ["Navigator@drone-1 | lands"]


async def test_a_drone_that_comes_back_into_reach_is_told_once_and_shown(server: LogServer, tmp_path: Path) -> None:
    server.pods["default"] = []
    async with following(server, tmp_path, "--system") as process:
        assert process.stderr is not None
        assert b"default/traffic has no pods (Deploying: pods start)" in await process.stderr.readline()
        server.refusals["/log"] = (500, DIALED)
        server.logs["agent-drone-2", "1"] = [f"{HOUR}00:01Z holds Grants"]
        await server.change("ADDED", pod("agent", "drone-2", system=True))
        # It is none of its nodes until a pod is there.
        await server.change("ADDED", pod("Navigator", "drone-2"))
        said = (await process.stderr.readline()).decode()
        assert said == f"fractus: drone-2 is out of reach ({DIALED}); trying again\n"
        server.logs["navigator-drone-2", "1"] = [f"{HOUR}00:01Z flies"]
        server.refusals.clear()
        assert sorted(await read(process, 2)) == ["Navigator@drone-2 | flies", "fractus-agent@drone-2 | holds Grants"]


async def test_what_is_too_much_to_follow_is_told(server: LogServer, tmp_path: Path) -> None:
    server.pods["default"] = [pod("Navigator", f"drone-{n}") for n in range(log_follower.MAX_FOLLOWED + 2)]
    async with following(server, tmp_path) as process:
        assert process.stderr is not None
        assert (await process.stderr.readline()).decode() == (
            "fractus: more than 90 containers at once: the others are not followed; choose by --component\n"
        )
