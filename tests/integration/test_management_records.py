"""Records of flights through the management API: roles of the chart, a real API server, and the agent's endpoint."""

from __future__ import annotations

from pathlib import Path

from control_plane import ControlPlane, wait_for
from docs_pages import shell_lines
from docs_shell import Shell
from flight_log import write_pictures
from management_server import ManagementServer, User, path_of, problem, submitted, user_token
from operator_world import World
from record_node import Flight, RecordNode, publish_address, started


def test_records_of_a_flight_are_returned(served_flight: Flight) -> None:
    user = served_flight.user
    path = served_flight.path
    (verdict,) = user("GET", f"{path}/verdicts").body["items"]
    assert (verdict["component"], verdict["action"], verdict["reason"]) == ("Navigator", "deny", "too far")
    first = user("GET", f"{path}/track?limit=1").body
    second = user("GET", f"{path}/track?limit=1&continue={first['continue']}").body
    assert [len(first["items"]), len(second["items"]), "continue" in second] == [1, 1, False]
    (reason,) = problem(user("GET", f"{path}/pictures"), 404)
    assert reason["reason"] == "NotRecorded"
    write_pictures(served_flight.recorded, served_flight.pictures)
    (picture,) = user("GET", f"{path}/pictures").body["items"]
    reply = user("GET", f"{path}/pictures/{picture['id']}")
    assert (reply.status, reply.content, reply.headers["Content-Type"]) == (200, b"\xff\xd8 mine", "image/jpeg")
    assert reply.headers["X-Content-Type-Options"] == "nosniff"


def test_documented_requests_read_the_records(
    served_flight: Flight, control_plane: ControlPlane, tmp_path: Path
) -> None:
    write_pictures(served_flight.recorded, served_flight.pictures)
    script = "\n".join(shell_lines("docs/management-api.md", "Fly in ten minutes"))
    function = next(line for line in script.splitlines() if line.startswith("api()"))
    variables = f"API={served_flight.user.url}\nTOKEN={served_flight.user.token}\nPLAN={served_flight.name}"
    requests = "\n".join(shell_lines("docs/management-api.md", "Read the records of a flight"))
    requests = requests.replace("namespace=team", f"namespace={served_flight.user.namespace}")
    shown = Shell(tmp_path, control_plane).type(f"set -eu\n{variables}\n{function}\n{requests}")
    assert "Navigator Goto deny too far" in shown
    assert (tmp_path / "first.jpg").read_bytes() == b"\xff\xd8 mine"


def test_hostile_parameters_are_refused(served_flight: Flight) -> None:
    write_pictures(served_flight.recorded, served_flight.pictures)
    for hostile, statuses in {
        "verdicts?limit=501": (422,), "verdicts?continue=x": (422,), "verdicts?continue=1": (400,),
        "pictures?continue=9-9": (400,), "pictures/1-2-3": (404,), "pictures/..%2f..%2fverdicts": (404, 422),
        "pictures/1": (422,),
    }.items():  # fmt: skip
        assert served_flight.user("GET", f"{served_flight.path}/{hostile}").status in statuses, hostile


def test_records_need_the_permission_on_records(
    served_flight: Flight, record_api: ManagementServer, observer: User, world: World
) -> None:
    path = served_flight.path
    namespace = served_flight.user.namespace
    problem(observer.at(record_api)("GET", f"{path}/verdicts"), 403)
    token = user_token(world, namespace, "reader", ("fractus-flightplan-viewer",), ("fractus-drone-viewer",))
    reader = User(record_api, token, namespace)
    wait_for(lambda: reader("GET", "/v1/drones").status == 200, "the roles of the reader")
    (reason,) = problem(reader("GET", f"{path}/verdicts"), 403)
    assert "flightplans/records" in reason["message"]
    problem(User(record_api, "not-a-token", namespace)("GET", f"{path}/verdicts"), 401)


def test_missing_endpoint_is_explained(
    recorded_flight: Flight, world: World, record_node: RecordNode, record_api: ManagementServer
) -> None:
    user = recorded_flight.user
    path = recorded_flight.path
    (reason,) = problem(user("GET", f"{path}/track"), 503)
    assert (reason["reason"], "management.records.enabled" in reason["message"]) == ("RecordsNotServed", True)
    publish_address(world, f"127.0.0.1:{record_node.port}")
    (reason,) = problem(user("GET", f"{path}/track"), 503)
    message = "drone-1 does not respond, so its records cannot be read now; try again when it has contact"
    assert (reason["reason"], reason["message"]) == ("NodeUnreachable", message)
    # A node that receives requests for another node has no certificate of that node.
    record_node.certify("drone-2")
    record_node.start()
    wait_for(
        lambda: user("GET", f"{path}/track").status == 503 and "mismatch" in record_api.log.read_text(), "the refusal"
    )


def test_plan_without_flight_has_no_records(pilot: User) -> None:
    path = path_of(submitted(pilot))
    for records in ("verdicts", "track", "pictures", "pictures/1-2-3"):
        (reason,) = problem(pilot("GET", f"{path}/{records}"), 409)
        assert (reason["reason"], "has not started" in reason["message"]) == ("NotStarted", True)
    problem(pilot("GET", "/v1/plans/nothing/verdicts"), 404)


def test_api_without_authority_of_nodes_reads_no_records(pilot: User, world: World) -> None:
    path, _ = started(pilot, world)
    publish_address(world, "127.0.0.1:1")
    (reason,) = problem(pilot("GET", f"{path}/verdicts"), 503)
    assert (reason["reason"], "--node-ca" in reason["message"]) == ("NoAuthority", True)
