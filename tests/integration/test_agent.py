"""Agent process with a real API server and a fake mobility service with mTLS."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import grpc
import pytest
import yaml
from agent_pki import TestAuthority
from agent_server import FRACTUS, NODE_GRANTS, REQUESTS, ApiServer, running
from control_plane import wait_for
from fractus_cluster.ports import free_port
from fractus_core.api.grants import Grant
from fractus_core.policy.grant_signatures import sign
from fractus_proto.v1 import mobility_pb2_grpc
from fractus_proto.v1.mobility_pb2 import MissionOutcome, SubscribeTelemetryRequest, Telemetry
from fractus_proto.v1.types_pb2 import Position
from mobility_rig import issue_signer
from scraping import scraped

pytestmark = [pytest.mark.timeout(300), pytest.mark.xdist_group("agent")]  # the tests share one API server


@pytest.fixture(scope="module")
def authority() -> TestAuthority:
    return TestAuthority()


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory, authority: TestAuthority) -> Iterator[ApiServer]:
    with running(tmp_path_factory.mktemp("plane")) as server:
        server.furnish(authority.pem)
        server.signer = issue_signer(authority.certificate, authority.key)
        yield server


class Mobility(mobility_pb2_grpc.MobilityServiceServicer):
    """Fake mobility service that sends the current telemetry to the node's own identity only."""

    def __init__(self) -> None:
        self.now = Telemetry(
            position=Position(latitude_deg=39.36, longitude_deg=22.94, altitude_m=0.0),
            battery_remaining=1.0, battery_voltage_v=16.8, mode="STABILIZE", ready=True, flight_state="inactive",
            controller="system", autopilot_connected=True,
        )  # fmt: skip
        self.stopped = threading.Event()
        self.callers: list[set[bytes]] = []

    def SubscribeTelemetry(  # noqa: N802
        self, request: SubscribeTelemetryRequest, context: grpc.ServicerContext
    ) -> Iterator[Telemetry]:
        self.callers.append(set(context.auth_context().get("x509_subject_alternative_name", ())))
        while context.is_active() and not self.stopped.wait(request.interval_s or 0.2):
            yield self.now


class Node:
    """A node: its files, its agent process, its mobility service."""

    def __init__(self, server: ApiServer, authority: TestAuthority, directory: Path, name: str, kind: str) -> None:
        self.server = server
        self.authority = authority
        self.name = name
        self.directory = directory
        self.state = directory / "state"
        self.description = directory / "node.yaml"
        self.plural = {"Drone": "drones", "EdgeNode": "edgenodes"}[kind]
        self.class_ = {"Drone": "drone", "EdgeNode": "edge"}[kind]
        self.mobility = Mobility()
        self.port = free_port()
        self.metrics = free_port()
        self.records = free_port()
        self.process: subprocess.Popen[bytes] | None = None
        self._grpc: grpc.Server | None = None
        labels = {"fractus.dev/class": self.class_}
        server.post("/api/v1/nodes", {"metadata": {"name": name, "labels": labels}})

    def describe(self, **spec: Any) -> None:
        camera = {"methods": ["RetrieveImage"]}
        limits = {"maxAltitude": 120, "maxFlightTime": 25, "maxSpeed": 15, "methods": ["Goto", "GetPosition"]}
        base: dict[str, Any] = (
            {"services": {"mobility": limits}, "depot": "campus", "interfaces": [{"technology": "WiFi"}]}
            if self.plural == "drones"
            else {"location": {"lat": 57.64911, "lon": 10.40744}, "services": {"camera": camera}}
        )
        manifest = {
            "apiVersion": "fractus.dev/v1alpha1",
            "kind": "Drone" if self.plural == "drones" else "EdgeNode",
            "metadata": {"name": self.name},
            "spec": base | spec,
        }
        fresh = self.description.with_suffix(".new")
        fresh.write_text(yaml.safe_dump(manifest))
        fresh.replace(self.description)

    def start(self) -> None:
        environment = {
            "PATH": os.environ["PATH"],
            "KUBECONFIG": str(self.server.agent_kubeconfig),
            "FRACTUS_NODE": self.name,
            "FRACTUS_DESCRIPTION": str(self.description),
            "FRACTUS_STATE_DIR": str(self.state),
            "FRACTUS_MOBILITY": f"127.0.0.1:{self.port}",
            "FRACTUS_METRICS": f"127.0.0.1:{self.metrics}",
            "FRACTUS_RECORDS": f"127.0.0.1:{self.records}",
            "MALLOC_ARENA_MAX": "2",
        }
        log = (self.directory / "agent.log").open("ab")
        self.process = subprocess.Popen([sys.executable, "-m", "fractus_agent"], env=environment, stderr=log)

    def stop(self, number: int = signal.SIGTERM) -> int:
        assert self.process is not None
        self.process.send_signal(number)
        code = self.process.wait(10)
        self.process = None
        return code

    def certify(self) -> None:
        wait_for(lambda: self.server.sign_requests(self.authority) or self.certified(), "signing request", timeout_s=30)
        wait_for(self.certified, "certificate", timeout_s=30)

    def certified(self) -> bool:
        return all((self.state / "tls" / name).exists() for name in ("tls.crt", "tls.key", "ca.crt"))

    def serve(self) -> None:
        tls = self.state / "tls"
        pair = [((tls / "tls.key").read_bytes(), (tls / "tls.crt").read_bytes())]
        credentials = grpc.ssl_server_credentials(pair, (tls / "ca.crt").read_bytes(), require_client_auth=True)
        self._grpc = grpc.server(ThreadPoolExecutor(4))
        mobility_pb2_grpc.add_MobilityServiceServicer_to_server(self.mobility, self._grpc)
        assert self._grpc.add_secure_port(f"127.0.0.1:{self.port}", credentials)
        self._grpc.start()

    def unserve(self) -> None:
        self.mobility.stopped.set()
        if self._grpc is not None:
            self._grpc.stop(None).wait(5)
            self._grpc = None
        self.mobility.stopped.clear()

    def object(self) -> dict[str, Any] | None:
        return self.server.get(f"{FRACTUS}/{self.plural}/{self.name}")

    def condition(self, type_: str) -> dict[str, Any]:
        status = (self.object() or {}).get("status") or {}
        return next((c for c in status.get("conditions", ()) if c["type"] == type_), {})

    def grants(self) -> set[str]:
        return {p.stem for p in (self.state / "grants").glob("*.json")}

    def log(self) -> str:
        return (self.directory / "agent.log").read_text()

    def close(self) -> None:
        self.unserve()
        if self.process is not None:
            self.stop(signal.SIGKILL)
        for path in (f"{FRACTUS}/{self.plural}/{self.name}", f"/api/v1/nodes/{self.name}"):
            self.server.delete(path)
        self.server.delete(f"{FRACTUS}/grants?fieldSelector=spec.node%3D{self.name}")
        self.server.delete(f"{NODE_GRANTS}/{self.name}")
        self.server.delete(REQUESTS)


@pytest.fixture
def drone(server: ApiServer, authority: TestAuthority, tmp_path: Path) -> Iterator[Node]:
    node = Node(server, authority, tmp_path, "drone-1", "Drone")
    try:
        yield node
    finally:
        print(node.log())
        node.close()


def add_grant(server: ApiServer, name: str, node: str = "drone-1", **spec: Any) -> dict[str, Any]:
    application = {"namespace": "default", "name": "app", "uid": "a"}
    body = {
        "apiVersion": "fractus.dev/v1alpha1",
        "kind": "Grant",
        "metadata": {"name": name},
        "spec": {"node": node, "application": application, "component": "Navigator", "instance": f"app-{name}"} | spec,
    }
    made = server.post(f"{FRACTUS}/grants", sign(body, *server.signer, datetime.now(UTC)))
    server.publish(node)
    return made


def remove_grant(server: ApiServer, name: str) -> None:
    server.delete(f"{FRACTUS}/grants/{name}")
    server.publish("drone-1")


def phase(server: ApiServer, name: str, node: str = "drone-1") -> str | None:
    return server.reported(node, name).get("phase")


def test_drone_agent_registers_node_reports_status_and_stores_grants(server: ApiServer, drone: Node) -> None:
    drone.describe()
    uid = add_grant(server, "mine", control="full")["metadata"]["uid"]
    add_grant(server, "not-mine", node="drone-2")
    drone.start()
    drone.certify()
    wait_for(lambda: drone.condition("Certified").get("status") == "True", "Certified", timeout_s=30)
    wait_for(lambda: phase(server, "mine") == "Active", "active grant", timeout_s=30)
    assert drone.grants() == {"mine"}
    stored = Grant.from_body(json.loads((drone.state / "grants" / "mine.json").read_text()))
    assert stored.spec.control == "full"
    assert stored.metadata.uid == uid
    assert phase(server, "not-mine", "drone-2") is None
    assert (drone.object() or {})["spec"]["depot"] == "campus"

    wait_for(
        lambda: drone.condition("Ready").get("reason") == "MobilityUnreachable", "unreachable service", timeout_s=30
    )
    drone.serve()
    wait_for(lambda: drone.condition("Ready").get("status") == "True", "ready drone", timeout_s=30)
    assert b"spiffe://fractus.dev/node/drone-1" in drone.mobility.callers[0]
    body = drone.object()
    assert body is not None
    assert body["status"]["flightState"] == "inactive"
    assert body["status"]["position"]["lat"] == 39.36

    samples = scraped(drone.metrics)
    assert samples["fractus_agent_grants", "stored"] == 1
    assert 0 <= samples["fractus_agent_watch_age_seconds", "nodegrants"] < 100
    assert 0 <= samples["fractus_agent_report_age_seconds",] < 100
    assert 0 <= samples["fractus_telemetry_age_seconds",] < 100
    assert samples["fractus_certificate_expiry_timestamp_seconds",] > time.time()

    drone.mobility.now.flight_state = "flying"
    drone.mobility.now.in_air = True
    ended = MissionOutcome(kind=MissionOutcome.KIND_FAILED, reason="driver lost")
    drone.mobility.now.missions[stored.spec.mission_key].CopyFrom(ended)
    wait_for(lambda: (drone.object() or {})["status"]["flightState"] == "flying", "flying", timeout_s=10)
    wait_for(lambda: phase(server, "mine") == "Failed", "failed grant", timeout_s=10)
    assert server.reported("drone-1", "mine")["message"] == "driver lost"

    drone.unserve()
    wait_for(lambda: drone.condition("Ready").get("reason") == "MobilityUnreachable", "lost service", timeout_s=15)
    body = drone.object()
    assert body is not None
    assert (body["status"]["flightState"], body["status"]["lastFlightState"]) == ("unknown", "flying")
    assert drone.stop() == 0
    assert "Traceback" not in drone.log()


def test_agent_registers_the_node_and_keeps_the_owners_edits(server: ApiServer, drone: Node) -> None:
    drone.describe()
    drone.start()
    wait_for(drone.object, "drone", timeout_s=30)
    path = f"{FRACTUS}/drones/drone-1"
    server.admin.merge(path, {"spec": {"depot": "harbour"}})
    drone.stop(signal.SIGKILL)
    before = len(drone.log())
    drone.start()
    wait_for(lambda: "certificate requested" in drone.log()[before:], "a started agent", timeout_s=30)
    wait_for(lambda: drone.condition("Ready"), "status", timeout_s=30)
    body = wait_for(drone.object, "drone")
    assert body["spec"]["depot"] == "harbour"
    drone.describe(depot="airfield")
    wait_for(lambda: (drone.object() or body)["spec"]["depot"] == "airfield", "the described depot", timeout_s=30)
    server.admin.merge(path, {"spec": {"depot": "harbour"}})
    drone.description.write_text("kind: Drone\nmetadata: {name: drone-9}\nspec: {}\n")
    wait_for(lambda: drone.condition("Described").get("status") == "False", "bad description", timeout_s=30)
    assert "drone-9" in drone.condition("Described")["message"]
    assert (drone.object() or {})["spec"]["depot"] == "harbour"
    server.delete(path)
    drone.describe(depot="airfield")
    wait_for(lambda: (drone.object() or body)["metadata"]["uid"] != body["metadata"]["uid"], "new drone", timeout_s=60)
    wait_for(lambda: drone.condition("Ready"), "status of the new drone", timeout_s=30)
    assert drone.condition("Described") == {}


def test_agent_keeps_grants_while_the_api_server_is_down(server: ApiServer, drone: Node) -> None:
    drone.describe()
    for name in ("one", "two", "three"):
        add_grant(server, name)
    drone.start()
    drone.certify()
    wait_for(
        lambda: phase(server, "three") == "Active" and drone.grants() == {"one", "two", "three"}, "grants", timeout_s=30
    )
    drone.stop(signal.SIGKILL)
    remove_grant(server, "one")
    server.stop_apiserver()
    drone.start()
    try:
        wait_for(lambda: "watch failed" in drone.log(), "the failed watch in the log", timeout_s=30)
        assert drone.grants() == {"one", "two", "three"}
        assert drone.process is not None
        assert drone.process.poll() is None
    finally:
        server.start_apiserver()
    wait_for(lambda: drone.grants() == {"two", "three"}, "the Grants in the files of the agent", timeout_s=40)
    # After the list, the agent also receives changes again.
    add_grant(server, "four")
    wait_for(lambda: phase(server, "four") == "Active" and "four" in drone.grants(), "the new Grant", timeout_s=10)
    server.stop_apiserver()
    server.start_apiserver()
    remove_grant(server, "two")
    wait_for(lambda: drone.grants() == {"three", "four"}, "reconciled grants after a restart", timeout_s=40)


def test_agent_does_not_store_grants_with_bad_signatures(server: ApiServer, drone: Node) -> None:
    drone.describe()
    add_grant(server, "mine", control="partial")
    drone.start()
    drone.certify()
    wait_for(lambda: phase(server, "mine") == "Active" and drone.grants() == {"mine"}, "the grant", timeout_s=30)
    path = f"{FRACTUS}/grants/mine"
    good = (server.get(path) or {})["spec"]
    server.admin.merge(path, {"spec": {"control": "full"}})
    server.publish("drone-1")
    wait_for(lambda: phase(server, "mine") == "Pending" and not drone.grants(), "no grant", timeout_s=30)
    assert "changed after signing" in server.reported("drone-1", "mine")["message"]
    server.admin.merge(path, {"spec": good})
    server.publish("drone-1")
    wait_for(lambda: phase(server, "mine") == "Active" and drone.grants() == {"mine"}, "the grant again", timeout_s=30)


def test_agent_reports_a_denied_certificate(server: ApiServer, drone: Node) -> None:
    drone.describe()
    drone.start()
    item = wait_for(lambda: server.admin.list(REQUESTS), "signing request", timeout_s=30)[0]
    assert item["spec"]["signerName"] == "fractus.dev/node"
    assert item["metadata"]["name"].startswith("fractus-drone-1-")
    denied = {"type": "Denied", "status": "True", "reason": "NotOurs", "message": "not in the fleet"}
    item["status"] = {"conditions": [denied]}
    server.admin.call("PUT", f"{REQUESTS}/{item['metadata']['name']}/approval", item)
    wait_for(lambda: drone.condition("Certified").get("reason") == "Denied", "Denied", timeout_s=30)
    assert "not in the fleet" in drone.condition("Certified")["message"]
    wait_for(lambda: drone.condition("Ready").get("reason") == "NoCertificate", "NoCertificate", timeout_s=30)
    wait_for(lambda: "not in the fleet" in drone.log(), "the refusal in the log", timeout_s=30)


def test_edge_node_agent_registers_node(server: ApiServer, authority: TestAuthority, tmp_path: Path) -> None:
    node = Node(server, authority, tmp_path, "edge-1", "EdgeNode")
    try:
        node.describe()
        node.start()
        node.certify()
        wait_for(lambda: node.condition("Ready").get("status") == "True", "the edge node to be Ready", timeout_s=30)
        # When the node has its certificate, the agent deletes the signing requests.
        wait_for(lambda: not server.admin.list(REQUESTS), "the signing requests to be deleted", timeout_s=10)
    finally:
        print(node.log())
        node.close()


def test_agent_reports_a_direct_link_with_missing_device(server: ApiServer, drone: Node) -> None:
    """Run the agent with a DirectLink. Other tests, in test_link_manager.py, check the traffic of links."""
    pairing = {"mode": "adhoc", "networkId": "fleet"}
    drone.describe(interfaces=[{"technology": "WiFi", "device": "fxnone0", "range": 80, "pairing": pairing}])
    drone.start()
    drone.certify()
    path = f"{FRACTUS}/directlinks"
    spec = {
        "drone": "drone-1", "node": "edge-1", "application": {"namespace": "default", "name": "app", "uid": "a"},
        "technology": "WiFi", "pairing": pairing, "range": 80, "bandwidth": 12, "position": {"lat": 39.36, "lon": 22.94},
        "heuristic": {"kind": "max", "metric": "ingress-bandwidth"},
    }  # fmt: skip
    for name, of in (("mine", "drone-1"), ("other", "drone-2")):
        server.post(
            path,
            {
                "apiVersion": "fractus.dev/v1alpha1",
                "kind": "DirectLink",
                "metadata": {"name": name},
                "spec": spec | {"drone": of},
            },
        )
    try:

        def status() -> dict[str, Any]:
            return (server.get(f"{path}/mine") or {}).get("status") or {}

        wait_for(lambda: status().get("reason") == "DeviceMissing", "the reason DeviceMissing", timeout_s=40)
        assert (status()["phase"], status()["traffic"]) == ("Idle", "cloud")
        assert {c["type"]: c["status"] for c in status()["conditions"]} == {"Linked": "False", "TrafficDirect": "False"}
        assert "fxnone0" in status()["message"]
        assert not (server.get(f"{path}/other") or {}).get("status")
        assert {file.name for file in (drone.state / "links").iterdir()} == {"mine.json"}
        server.delete(f"{path}/mine")
        wait_for(
            lambda: not list((drone.state / "links").iterdir()),
            "the file of the DirectLink to be deleted",
            timeout_s=30,
        )
    finally:
        server.delete(path)
