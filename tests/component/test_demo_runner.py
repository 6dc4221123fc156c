"""Demo runner: progress of a mission, assignment of nodes, and collection of the data of this mission only."""

from __future__ import annotations

import os
import threading
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import demo_flight
import pytest
import yaml
from click.testing import CliRunner
from fractus_services.recording import messages
from fractus_services.recording.segment_writer import SegmentWriter
from fractus_sim.demo import mission_data
from fractus_sim.demo.__main__ import demo
from fractus_sim.demo.demo_clusters import assign_nodes
from fractus_sim.demo.demo_run import live_view, replay_command
from fractus_sim.demo.mission_data import extract_pictures, fetch_audit_logs, fetch_recordings, select_pictures
from fractus_sim.errors import ExperimentError
from fractus_sim.progress import Progress
from fractus_sim.report.flight_record import FlightRecord, TimeWindow, picture_time_s
from fractus_sim.testbeds.embedded_cluster import ROOT
from fractus_sim.testbeds.kube_commands import Kube
from fractus_sim.testbeds.mission_watch import Mission, follow_mission, report_driver_lines


def node(name: str, label: str | None = None) -> dict[str, Any]:
    labels = {"fractus.dev/class": label} if label else {}
    return {"kind": "Node", "metadata": {"name": name, "labels": labels}}


def application(phase: str, message: str = "", drone: str | None = "drone-1") -> dict[str, Any]:
    status = {"phase": phase, "message": message, **({"drone": drone} if drone else {})}
    return {"kind": "Application", "metadata": {"name": "traffic-monitoring"}, "status": status}


def flying(state: str) -> dict[str, Any]:
    return {"kind": "Drone", "metadata": {"name": "drone-1"}, "status": {"flightState": state}}


def pod(name: str, ready: bool) -> dict[str, Any]:
    conditions = [{"type": "Ready", "status": str(ready)}]
    return {"kind": "Pod", "metadata": {"name": name}, "status": {"conditions": conditions}}


def test_mission_progress_is_reported_from_apply_to_landing() -> None:
    lines: list[str] = []
    mission = Mission("traffic-monitoring", {"applied": 100.0})
    plan = {
        "kind": "DeploymentPlan",
        "metadata": {"name": "traffic-monitoring"},
        "spec": {"placements": [{}, {}], "drone": {"node": "drone-1"}},
    }
    mission.update([application("Pending", drone=None)], 100.5, lines.append)
    mission.update([application("Deploying"), plan, pod("a", False), flying("inactive")], 101.0, lines.append)
    mission.update([application("Running"), plan, pod("a", True), flying("inactive")], 104.0, lines.append)
    assert not mission.ended
    mission.update([application("Running"), plan, pod("a", True), flying("flying")], 110.0, lines.append)
    assert not mission.grounded
    stopped = pod("a", False)
    stopped["metadata"]["labels"] = {"fractus.dev/finished": "20260101T000000Z"}
    mission.update([application("Completed", "done"), plan, stopped, flying("landing")], 200.0, lines.append)
    assert mission.pods == {"a": pod("a", True)}, "the runner keeps the state that the pod had before it was stopped"
    assert mission.ended
    assert not mission.grounded
    mission.update([application("Completed", "done"), plan, flying("inactive")], 230.0, lines.append)
    assert mission.grounded
    assert mission.times == {"applied": 100.0, "planned": 101.0, "running": 104.0, "ended": 200.0, "landed": 230.0}
    assert "plan created after 1.0 s: 2 instances, drone-1 flies" in lines
    assert "all pods Running after 4.0 s" in lines
    assert lines.count("drone-1 is flying") == 1
    assert lines[-1] == "drone-1 is on the ground"
    assert set(mission.pods) == {"a"}, "the runner keeps deleted pods"


def test_mission_progress_ignores_other_applications_and_drones() -> None:
    lines: list[str] = []
    mission = Mission("traffic-monitoring", {"applied": 0.0})
    other = application("Failed")
    other["metadata"]["name"] = "other"
    other_drone = flying("flying")
    other_drone["metadata"]["name"] = "drone-9"
    mission.update([other, application("Running"), other_drone], 1.0, lines.append)
    assert lines == ["application Running"]


class PendingCluster:
    """A cluster with an Application that stays Pending."""

    def objects(self, kinds: str, namespace: str = "default") -> list[dict[str, Any]]:
        del kinds, namespace
        return [application("Pending", "no drone is free", drone=None)]


def test_mission_fails_after_the_timeout(tmp_path: Path) -> None:
    mission = Mission("traffic-monitoring", {"applied": 0.0})
    with pytest.raises(ExperimentError, match="did not end within 5 s: no drone is free"):
        follow_mission(PendingCluster(), mission, tmp_path / "log", Progress(), timeout_s=5.0)  # type: ignore[arg-type]


def test_driver_log_lines_are_reported_complete_and_once(tmp_path: Path) -> None:
    log = tmp_path / "log"
    lines = list[str]()
    log.write_bytes(b"[pod/x-navigator-1/navigator] 08:00 armed\n[pod/y/data-store] 08:00 stored 1\n[pod/x-navi")
    at = report_driver_lines(log, 0, lines.append)
    log.write_bytes(log.read_bytes() + b"gator-1/navigator] 08:01 waypoint 1/5\n")
    report_driver_lines(log, at, lines.append)
    assert lines == ["navigator: 08:00 armed", "navigator: 08:01 waypoint 1/5"]


def test_nodes_are_assigned_explicitly_then_by_name_then_by_class() -> None:
    nodes = [node("kind-a", "edge"), node("kind-b"), node("kind-c", "edge"), node("kind-d", "cloud"), node("drone-1")]
    assert assign_nodes(nodes, {"edge-1": "kind-b"}) == {
        "edge-1": "kind-b",
        "drone-1": "drone-1",
        "edge-2": "kind-a",
        "edge-3": "kind-c",
        "cloud-1": "kind-d",
    }


def test_missing_node_is_reported_with_a_remedy() -> None:
    nodes = [node("a", "drone"), node("b", "edge"), node("c", "cloud")]
    with pytest.raises(
        ExperimentError, match=r"can be used as edge-2; assign one with --assign edge-2=NODE \(nodes: a, b, c\)"
    ):
        assign_nodes(nodes, {})
    with pytest.raises(ExperimentError, match="the cluster has no node z"):
        assign_nodes(nodes, {"edge-2": "z"})
    assert "edge-3" not in assign_nodes([*nodes, node("d", "edge")], {})


def test_only_audit_entries_of_the_mission_are_kept() -> None:
    before, after = ({"time": demo_flight.stamp(time_s)} for time_s in (99.0, 101.0))
    assert TimeWindow(100.0).contains(after)
    assert not TimeWindow(100.0).contains(before)
    assert not TimeWindow(100.0).contains({"kind": "state"})


class RotatingNode:
    """A node whose audit log starts a new segment during the first copy."""

    def __init__(self) -> None:
        self.files = {"mobility.000000000001.jsonl": "1", "mobility.jsonl": "23", "camera.jsonl": "c", "notes": ""}
        self.read: list[str] = []

    def run(self, *arguments: str) -> str:
        assert arguments[-2:] == ("ls", "/var/lib/fractus/audit")
        return "\n".join(self.files)

    def fetch(self, pod: str, path: str, copy: Path) -> None:
        assert pod == "fractus-mobility-x"
        name = path.removeprefix("/var/lib/fractus/audit/")
        self.read.append(name)
        if name == "mobility.jsonl" and self.read.count(name) == 1:
            self.files |= {"mobility.000000000002.jsonl": "23", "mobility.jsonl": "4"}
        copy.write_text(self.files[name])


def test_audit_logs_are_fetched_completely_during_rotation(tmp_path: Path) -> None:
    node = RotatingNode()
    fetch_audit_logs(node, "fractus-mobility-x", tmp_path / "audit")  # type: ignore[arg-type]
    copies = {path.name: path.read_text() for path in (tmp_path / "audit").iterdir()}
    assert copies == {name: text for name, text in node.files.items() if name != "notes"}
    assert node.read.count("mobility.000000000001.jsonl") == 1, "a closed segment is copied once"


def test_incomplete_file_is_removed_after_a_failed_fetch(tmp_path: Path) -> None:
    kubectl = tmp_path / "kubectl"
    kubectl.write_text("#!/bin/sh\nprintf '\\377\\330half'\nif [ \"$7\" = /bad ]; then echo broken >&2; exit 1; fi\n")
    kubectl.chmod(0o755)
    kube = Kube(kubectl, kubectl, tmp_path)
    copy = tmp_path / "out.jpg"
    with pytest.raises(ExperimentError, match="broken"):
        kube.fetch("pod", "/bad", copy)
    assert [path.name for path in tmp_path.iterdir()] == ["kubectl"]
    kube.fetch("pod", "/good", copy)
    assert copy.read_bytes() == b"\xff\xd8half"


def test_selected_pictures_are_spread_over_the_flight() -> None:
    start_s = datetime(2026, 11, 21, 11, 0, tzinfo=UTC).timestamp()
    names = [f"202611211100{second:02d}000-0001.jpg" for second in range(0, 60, 2)]
    selected = select_pictures(names, start_s + 10, start_s + 50)
    assert [path[-14:-12] for path in selected] == ["20", "30", "40"]
    assert select_pictures(names, start_s + 100, start_s + 200) == []


@pytest.mark.parametrize("complete", [True, False])
def test_pictures_are_extracted_from_the_camera_recording(tmp_path: Path, complete: bool) -> None:
    record = FlightRecord.of(demo_flight.content(), demo_flight.audit())
    paths = [tmp_path / f"{service}-000001-20260601T120000Z.mcap" for service in ("camera", "mobility")]
    writer = SegmentWriter(paths[0].with_suffix(""), "drone-1")
    for seconds in range(-100, 300, 5):
        at_ns = int((demo_flight.TAKEOFF_S + seconds) * 1e9)
        writer.write(at_ns, b"", (messages.picture(at_ns, "drone-1", b"\xff\xd8%d" % seconds),))
    writer.flush()
    if complete:
        writer.close()
    paths[1].write_bytes(b"not read")
    extract_pictures(paths, record, tmp_path / "out")
    kept = sorted((tmp_path / "out" / "pictures").iterdir())
    assert [round(picture_time_s(path.name) - demo_flight.TAKEOFF_S) for path in kept] == [25, 50, 80]
    assert [path.read_bytes() for path in kept] == [b"\xff\xd825", b"\xff\xd850", b"\xff\xd880"]


def test_invalid_node_assignment_is_rejected() -> None:
    result = CliRunner().invoke(demo, ["--cluster", "current", "--assign", "drone-7=x"])
    assert result.exit_code == 2
    assert "expected drone-1=NODE" in result.output


def test_report_without_recorded_data_fails(tmp_path: Path) -> None:
    result = CliRunner().invoke(demo, ["--report-only", "--out", str(tmp_path)])
    assert result.exit_code == 1
    assert "no recorded flight" in result.output


def test_simulated_hardware_is_at_the_position_of_the_drone() -> None:
    chart = ROOT / "charts" / "fractus-demo"
    home = yaml.safe_load((chart / "values.yaml").read_text())["vehicle"]["home"]
    lat, lon, _ = (float(part) for part in home.split(","))
    depot = demo_flight.documents("depot.yaml")[0]["spec"]["location"]
    assert (lat, lon) == (depot["lat"], depot["lon"])
    drone = demo_flight.documents("drone.yaml")[0]["spec"]["services"]["mobility"]
    vehicle = (chart / "templates" / "vehicle.yaml").read_text()
    assert f'"{drone["connection"]}"' in vehicle
    assert "hostNetwork: true" in vehicle


def test_traffic_path_change_is_reported_once() -> None:
    def link(traffic: str | None, message: str) -> dict[str, Any]:
        spec = {"node": "edge-1", "application": {"namespace": "default", "name": "traffic-monitoring"}}
        status = {"traffic": traffic, "message": message} if traffic else None
        return {"kind": "DirectLink", "metadata": {"name": "l"}, "spec": spec, "status": status}

    lines: list[str] = []
    mission = Mission("traffic-monitoring", {"applied": 0.0})
    for at_s, body in enumerate(
        [link(None, ""), link("cloud", "far"), link("direct", "near"), link("direct", "nearer"), link("cloud", "left")]
    ):
        mission.update([body], float(at_s), lines.append)
    assert [(c["time"], c["node"], c["traffic"], c["why"]) for c in mission.links] == [
        (2.0, "edge-1", "direct", "near"),
        (4.0, "edge-1", "cloud", "left"),
    ]
    assert lines == [
        "traffic moved to the direct link to edge-1: near",
        "traffic moved from edge-1 to the cloud path: left",
    ]


@pytest.mark.parametrize("began", ["20260601T115955Z", "20260601T120001Z"])
def test_mission_recordings_are_kept_and_the_replay_command_is_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, began: str
) -> None:
    assert replay_command(tmp_path) is None
    kubectl = tmp_path / "kubectl"
    kubectl.write_text('#!/bin/sh\nif [ "$1" = get ]; then echo fractus-mobility-x; else shift 5; exec "$@"; fi\n')
    kubectl.chmod(0o755)
    monkeypatch.setattr(mission_data, "_NODE_RECORDINGS_FOLDER", str(tmp_path / "node"))
    applied_s = datetime(2026, 6, 1, 12, tzinfo=UTC).timestamp()
    for name, written_s in (("000001-20260531T120000Z", applied_s - 1), (f"000002-{began}", applied_s + 60)):
        path = tmp_path / "node" / "mobility" / f"{name}.mcap"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)
        os.utime(path, (written_s, written_s))
    recordings = fetch_recordings(Kube(kubectl, kubectl, tmp_path), "drone-1", applied_s, tmp_path)
    assert [path.name for path in recordings] == [f"mobility-000002-{began}.mcap"]
    assert recordings[0].read_text() == f"000002-{began}"
    assert replay_command(tmp_path) == f"fractus view {tmp_path}/recordings/*.mcap"


def test_demo_continues_without_live_view(tmp_path: Path) -> None:
    lines = list[str]()
    reported = threading.Event()
    (tmp_path / "config").write_text("no kubeconfig")

    def report(line: str) -> None:
        lines.append(line)
        reported.set()

    with live_view(tmp_path / "config", report):
        assert reported.wait(200)
    assert len(lines) == 1
    assert lines[0].startswith("live view not available: fractus: the kubeconfig")
