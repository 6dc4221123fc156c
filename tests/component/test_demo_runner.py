"""How the demo follows a mission, assigns nodes, and picks its own entries from an audit log."""

from __future__ import annotations

import json
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
from fractus_sim.demo import live_view, mission_data
from fractus_sim.demo.__main__ import demo
from fractus_sim.demo.demo_clusters import ROOT, assign
from fractus_sim.demo.mission_data import fetch_logs, spread
from fractus_sim.errors import ExperimentError
from fractus_sim.report.flight_record import Record, of_mission, taken_s
from fractus_sim.testbeds import mission_watch
from fractus_sim.testbeds.kube_commands import Kube
from fractus_sim.testbeds.mission_watch import Mission


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
    said: list[str] = []
    mission = Mission("traffic-monitoring", {"applied": 100.0})
    plan = {
        "kind": "DeploymentPlan",
        "metadata": {"name": "traffic-monitoring"},
        "spec": {"placements": [{}, {}], "drone": {"node": "drone-1"}},
    }
    mission.see([application("Pending", drone=None)], 100.5, said.append)
    mission.see([application("Deploying"), plan, pod("a", False), flying("inactive")], 101.0, said.append)
    mission.see([application("Running"), plan, pod("a", True), flying("inactive")], 104.0, said.append)
    assert not mission.ended
    mission.see([application("Running"), plan, pod("a", True), flying("flying")], 110.0, said.append)
    assert not mission.grounded
    stopped = pod("a", False)
    stopped["metadata"]["labels"] = {"fractus.dev/finished": "20260101T000000Z"}
    mission.see([application("Completed", "done"), plan, stopped, flying("landing")], 200.0, said.append)
    assert mission.pods == {"a": pod("a", True)}, "what is reported of it is how it ran"
    assert mission.ended
    assert not mission.grounded
    mission.see([application("Completed", "done"), plan, flying("inactive")], 230.0, said.append)
    assert mission.grounded
    assert mission.times == {"applied": 100.0, "planned": 101.0, "running": 104.0, "ended": 200.0, "landed": 230.0}
    assert "plan created after 1.0 s: 2 instances, drone-1 flies" in said
    assert "all pods Running after 4.0 s" in said
    assert said.count("drone-1 is flying") == 1
    assert said[-1] == "drone-1 is on the ground"
    assert set(mission.pods) == {"a"}, "pods are remembered after the operator deleted them"


def test_mission_progress_ignores_other_applications_and_drones() -> None:
    said: list[str] = []
    mission = Mission("traffic-monitoring", {"applied": 0.0})
    other = application("Failed")
    other["metadata"]["name"] = "other"
    elsewhere = flying("flying")
    elsewhere["metadata"]["name"] = "drone-9"
    mission.see([other, application("Running"), elsewhere], 1.0, said.append)
    assert said == ["application Running"]


class Silent:
    """A cluster on which nothing ever happens."""

    def objects(self, kinds: str, namespace: str = "default") -> list[dict[str, Any]]:
        del kinds, namespace
        return [application("Pending", "no drone is free", drone=None)]


def test_mission_fails_after_the_timeout(tmp_path: Path) -> None:
    mission = Mission("traffic-monitoring", {"applied": 0.0})
    with pytest.raises(ExperimentError, match="did not end within 5 s: no drone is free"):
        mission_watch.follow(Silent(), mission, tmp_path / "log", timeout_s=5.0, say=print, show=print)  # type: ignore[arg-type]


def test_driver_log_lines_are_reported_complete_and_once(tmp_path: Path) -> None:
    log = tmp_path / "log"
    said = list[str]()
    log.write_bytes(b"[pod/x-navigator-1/navigator] 08:00 armed\n[pod/y/data-store] 08:00 kept 1\n[pod/x-navi")
    at = mission_watch._tell(log, 0, said.append)
    log.write_bytes(log.read_bytes() + b"gator-1/navigator] 08:01 waypoint 1/5\n")
    mission_watch._tell(log, at, said.append)
    assert said == ["navigator: 08:00 armed", "navigator: 08:01 waypoint 1/5"]


def test_nodes_are_assigned_explicitly_then_by_name_then_by_class() -> None:
    nodes = [node("kind-a", "edge"), node("kind-b"), node("kind-c", "edge"), node("kind-d", "cloud"), node("drone-1")]
    assert assign(nodes, {"edge-1": "kind-b"}) == {
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
        assign(nodes, {})
    with pytest.raises(ExperimentError, match="the cluster has no node z"):
        assign(nodes, {"edge-2": "z"})
    assert "edge-3" not in assign([*nodes, node("d", "edge")], {})


def test_only_audit_entries_of_the_mission_are_kept() -> None:
    before, after = (json.dumps({"time": demo_flight.stamp(s)}).encode() for s in (99.0, 101.0))
    assert of_mission(after, 100.0)
    assert not of_mission(before, 100.0)
    assert not of_mission(b"{torn", 100.0)


class Rotating:
    """A node whose audit log begins a new file while it is read for the first time."""

    def __init__(self) -> None:
        self.files = {"mobility.000000000001.jsonl": "1", "mobility.jsonl": "23", "camera.jsonl": "c", "notes": ""}
        self.read: list[str] = []

    def run(self, *arguments: str) -> str:
        assert arguments[-2:] == ("ls", "/var/lib/fractus/audit")
        return "\n".join(self.files)

    def fetch(self, pod: str, path: str, to: Path) -> None:
        assert pod == "fractus-mobility-x"
        name = path.removeprefix("/var/lib/fractus/audit/")
        self.read.append(name)
        if name == "mobility.jsonl" and self.read.count(name) == 1:
            self.files |= {"mobility.000000000002.jsonl": "23", "mobility.jsonl": "4"}
        to.write_text(self.files[name])


def test_audit_logs_are_fetched_completely_during_rotation(tmp_path: Path) -> None:
    node = Rotating()
    fetch_logs(node, "fractus-mobility-x", tmp_path / "audit")  # type: ignore[arg-type]
    found = {path.name: path.read_text() for path in (tmp_path / "audit").iterdir()}
    assert found == {name: text for name, text in node.files.items() if name != "notes"}
    assert node.read.count("mobility.000000000001.jsonl") == 1, "what is closed does not change"


def test_incomplete_file_is_removed_after_a_failed_fetch(tmp_path: Path) -> None:
    kubectl = tmp_path / "kubectl"
    kubectl.write_text("#!/bin/sh\nprintf '\\377\\330half'\nif [ \"$7\" = /bad ]; then echo broken >&2; exit 1; fi\n")
    kubectl.chmod(0o755)
    kube = Kube(kubectl, kubectl, tmp_path)
    to = tmp_path / "out.jpg"
    with pytest.raises(ExperimentError, match="broken"):
        kube.fetch("pod", "/bad", to)
    assert [path.name for path in tmp_path.iterdir()] == ["kubectl"]
    kube.fetch("pod", "/good", to)
    assert to.read_bytes() == b"\xff\xd8half"


def test_selected_pictures_are_spread_over_the_flight() -> None:
    start_s = datetime(2026, 11, 21, 11, 0, tzinfo=UTC).timestamp()
    every = [f"202611211100{second:02d}000-0001.jpg" for second in range(0, 60, 2)]
    chosen = spread(every, start_s + 10, start_s + 50)
    assert [path[-14:-12] for path in chosen] == ["20", "30", "40"]
    assert spread(every, start_s + 100, start_s + 200) == []


@pytest.mark.parametrize("whole", [True, False])
def test_pictures_are_extracted_from_the_camera_recording(tmp_path: Path, whole: bool) -> None:
    record = Record.of(demo_flight.content(), demo_flight.audit())
    paths = [tmp_path / f"{service}-000001-20260601T120000Z.mcap" for service in ("camera", "mobility")]
    writer = SegmentWriter(paths[0].with_suffix(""), "drone-1")
    for seconds in range(-100, 300, 5):
        at_ns = int((demo_flight.TAKEOFF_S + seconds) * 1e9)
        writer.write(at_ns, b"", (messages.picture(at_ns, "drone-1", b"\xff\xd8%d" % seconds),))
    writer.flush()
    if whole:
        writer.close()
    paths[1].write_bytes(b"not read")
    mission_data.keep_pictures(paths, record, tmp_path / "out")
    kept = sorted((tmp_path / "out" / "pictures").iterdir())
    assert [round(taken_s(path.name) - demo_flight.TAKEOFF_S) for path in kept] == [25, 50, 80]
    assert [path.read_bytes() for path in kept] == [b"\xff\xd825", b"\xff\xd850", b"\xff\xd880"]


def test_invalid_node_assignment_is_rejected() -> None:
    done = CliRunner().invoke(demo, ["--cluster", "current", "--assign", "drone-7=x"])
    assert done.exit_code == 2
    assert "expected drone-1=NODE" in done.output


def test_report_without_recorded_data_fails(tmp_path: Path) -> None:
    done = CliRunner().invoke(demo, ["--report-only", "--out", str(tmp_path)])
    assert done.exit_code == 1
    assert "no recorded flight" in done.output


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

    said: list[str] = []
    mission = Mission("traffic-monitoring", {"applied": 0.0})
    for at_s, body in enumerate(
        [link(None, ""), link("cloud", "far"), link("direct", "near"), link("direct", "nearer"), link("cloud", "left")]
    ):
        mission.see([body], float(at_s), said.append)
    assert [(c["time"], c["node"], c["traffic"], c["why"]) for c in mission.links] == [
        (2.0, "edge-1", "direct", "near"),
        (4.0, "edge-1", "cloud", "left"),
    ]
    assert said == [
        "traffic moved to the direct link to edge-1: near",
        "traffic moved from edge-1 to the cloud path: left",
    ]


@pytest.mark.parametrize("began", ["20260601T115955Z", "20260601T120001Z"])
def test_mission_recordings_are_kept_and_the_replay_command_is_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, began: str
) -> None:
    assert live_view.replay_command(tmp_path) is None
    kubectl = tmp_path / "kubectl"
    kubectl.write_text('#!/bin/sh\nif [ "$1" = get ]; then echo fractus-mobility-x; else shift 5; exec "$@"; fi\n')
    kubectl.chmod(0o755)
    monkeypatch.setattr(live_view, "_ON_NODE", str(tmp_path / "node"))
    applied_s = datetime(2026, 6, 1, 12, tzinfo=UTC).timestamp()
    for name, written_s in (("000001-20260531T120000Z", applied_s - 1), (f"000002-{began}", applied_s + 60)):
        path = tmp_path / "node" / "mobility" / f"{name}.mcap"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)
        os.utime(path, (written_s, written_s))
    found = live_view.fetch_recordings(Kube(kubectl, kubectl, tmp_path), "drone-1", applied_s, tmp_path)
    assert [path.name for path in found] == [f"mobility-000002-{began}.mcap"]
    assert found[0].read_text() == f"000002-{began}"
    assert live_view.replay_command(tmp_path) == f"fractus view {tmp_path}/recordings/*.mcap"


def test_demo_continues_without_live_view(tmp_path: Path) -> None:
    said = list[str]()
    told = threading.Event()
    (tmp_path / "config").write_text("no kubeconfig")

    def say(line: str) -> None:
        said.append(line)
        told.set()

    with live_view.shown(tmp_path / "config", say):
        assert told.wait(200)
    assert len(said) == 1
    assert said[0].startswith("live view not available: fractus: the kubeconfig")
