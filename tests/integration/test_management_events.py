"""Event streams of flight plans, and the shutdown of the management API."""

from __future__ import annotations

import http.client
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from control_plane import ControlPlane, wait_for
from management_server import ManagementServer, User, path_of, problem, submitted, user_token
from operator_world import World

Event = tuple[str, str, Any]


class Stream:
    """An open event stream."""

    def __init__(self, response: http.client.HTTPResponse) -> None:
        self._response = response

    def next(self) -> Event | None:
        """Return type, id and data of the next event, or None at the end of the stream."""
        fields: dict[str, str] = {}
        while True:
            line = self._response.readline().decode()
            if not line:
                return None
            if line == "\n" and "data" in fields:
                return fields["event"], fields.get("id", ""), json.loads(fields["data"])
            name, _, value = line.rstrip("\n").partition(": ")
            fields[name] = value

    def until(self, state: str) -> Event:
        """Return the first event of a plan with a state."""
        while True:
            event = self.next()
            assert event is not None, f"the stream ended before the state {state}"
            if (event[2].get("status") or {}).get("state") == state:
                return event


@contextmanager
def opened(user: User, path: str, last_id: str = "") -> Iterator[Stream]:
    connection, response = user.open(f"{path}/events", {"Last-Event-ID": last_id} if last_id else {})
    try:
        assert response.status == 200, response.read()
        assert response.headers["Content-Type"].startswith("text/event-stream")
        yield Stream(response)
    finally:
        connection.close()


def test_stream_follows_a_plan_until_it_is_deleted(pilot: User) -> None:
    created = submitted(pilot)
    with opened(pilot, path_of(created)) as stream:
        first = stream.next()
        assert first is not None
        assert (first[0], first[2]["metadata"]["uid"]) == ("plan", created.body["metadata"]["uid"])
        pilot("POST", f"{path_of(created)}:end")
        assert stream.until("Ended")[0] == "plan"
        pilot("DELETE", path_of(created), If_Match="*")
        last = stream.next()
        assert last is not None
        assert last[0] == "deleted"
        assert stream.next() is None


def test_stream_resumes_after_the_last_event(pilot: User) -> None:
    created = submitted(pilot)
    with opened(pilot, path_of(created)) as stream:
        first = stream.next()
    assert first is not None
    pilot("POST", f"{path_of(created)}:activate")
    with opened(pilot, path_of(created), first[1]) as stream:
        event = stream.next()
        assert event is not None
        assert (event[0], event[2]["spec"]["use"]) == ("plan", "InUse")


def test_stream_begins_again_after_an_unknown_event(pilot: User) -> None:
    created = submitted(pilot)
    for last_id in ("unknown", "1", "999999999"):
        with opened(pilot, path_of(created), last_id) as stream:
            events = [stream.next(), stream.next()]
        assert [event and event[0] for event in events] == ["reset", "plan"], last_id


def test_stream_of_missing_plan_is_refused(pilot: User) -> None:
    problem(pilot("GET", "/v1/plans/missing/events"), 404)


def test_stream_ends_with_an_error_when_the_permission_is_withdrawn(
    pilot: User, world: World, management: ManagementServer, namespace: str
) -> None:
    created = submitted(pilot)
    reader = "/apis/rbac.authorization.k8s.io/v1/clusterroles/plan-reader"
    rule = {"apiGroups": ["fractus.dev"], "resources": ["flightplans"], "verbs": ["get", "list"]}
    header = {"apiVersion": "rbac.authorization.k8s.io/v1", "kind": "ClusterRole", "metadata": {"name": "plan-reader"}}
    world.api.apply(reader, {**header, "rules": [rule]})
    try:
        user = User(management, user_token(world, namespace, "reader", ("plan-reader",), ()), namespace)
        wait_for(lambda: user("GET", path_of(created)).status == 200, "the role of the reader")
        with opened(user, path_of(created)) as stream:
            events = [stream.next(), stream.next(), stream.next()]
        assert [event and event[0] for event in events] == ["plan", "error", None]
        assert events[1] is not None
        assert events[1][2]["status"] == 403
    finally:
        world.api.delete(reader)


def test_streams_of_a_token_are_limited(pilot: User) -> None:
    created = submitted(pilot)
    streams = [pilot.open(f"{path_of(created)}/events", {}) for _ in range(16)]
    try:
        assert {response.status for _, response in streams} == {200}
        problem(pilot("GET", f"{path_of(created)}/events"), 429)
    finally:
        for connection, _ in streams:
            connection.close()
    wait_for(
        lambda: pilot.stream_status(f"{path_of(created)}/events") == 200, "the closed streams to be counted no more"
    )


def test_shutdown_ends_streams(pilot: User, control_plane: ControlPlane, tmp_path: Path) -> None:
    server = ManagementServer(
        control_plane, tmp_path / "log", f"--server={control_plane.server}", f"--ca={control_plane.ca}"
    )
    created = submitted(pilot)
    with opened(pilot.at(server), path_of(created)) as stream:
        assert stream.next() is not None
        assert server.stop() == 0
        assert stream.next() is None
    entries = [json.loads(line) for line in server.log.read_text().splitlines()]
    assert any(entry.get("fields", {}).get("path") == f"{path_of(created)}/events" for entry in entries)
    assert not [entry for entry in entries if entry["level"] == "ERROR"]
