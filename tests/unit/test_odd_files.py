"""Readers of files do not block, read without bound or fail on paths that are not regular files."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from fractus_agent.certificates import InvalidCertificate, inspect_certificate
from fractus_agent.grant_synchronizer import GrantDirectory
from fractus_agent.links.direct_link_store import DirectLinkStore
from fractus_agent.links.pairing import client_context, server_context
from fractus_agent.registration.diagnostics import read_audit_heads, read_recording_problems
from fractus_agent.registration.node_object_file import NodeObjectFile
from fractus_cli.zones import zones
from fractus_core.api.grants import Grant
from fractus_core.api.nodes import Drone
from fractus_runtime.files import MAX_JSON_DEPTH, UnsuitableFile, parse_json, path_text, read_file, read_set
from fractus_runtime.mcap_tail import Tail
from fractus_services.auth import TlsFiles
from fractus_services.camera.drivers.geotagged_directory import read_position
from fractus_services.mobility.authority.journal import Journal
from fractus_services.mobility.mavlink.vehicle_identification import read_known_vehicle
from fractus_services.node_description import NodeDescription
from fractus_services.options import CannotServe
from fractus_view.command import view
from fractus_view.events import Problem
from fractus_view.sources import GrowingRecordings
from odd_files import ODD, odd_files
from policy_world import spec

MakeOdd = Callable[[Path], None]


@odd_files
def test_read_file_refuses_odd_file(tmp_path: Path, make_odd: MakeOdd) -> None:
    path = tmp_path / "file"
    make_odd(path)
    with pytest.raises(UnsuitableFile, match=f"{path}"):
        read_file(path)


def test_read_file_refuses_directory(tmp_path: Path) -> None:
    with pytest.raises(IsADirectoryError):
        read_file(tmp_path)


def test_read_file_returns_content_up_to_its_limit(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"12345")
    link = tmp_path / "link"
    link.symlink_to(path)
    assert read_file(link, 5) == b"12345"
    with pytest.raises(UnsuitableFile, match="is larger than 4 bytes"):
        read_file(path, 4)


def test_file_name_that_is_not_utf8_becomes_text() -> None:
    assert path_text(Path(os.fsdecode(b"/a/\xe9.json"))) == "/a/\\xe9.json"


@pytest.mark.parametrize("opening", [b"[", b'{"a":'])
def test_parse_json_limits_depth(opening: bytes) -> None:
    closing = b"]" if opening == b"[" else b"}"

    def nested(depth: int) -> bytes:
        return opening * depth + b"1" + closing * depth

    parse_json(nested(MAX_JSON_DEPTH))
    for depth in (MAX_JSON_DEPTH + 1, 500, 100_000):
        with pytest.raises(ValueError, match="nested too deeply"):
            parse_json(nested(depth))


def grant(name: str = "g") -> Grant:
    return Grant.from_body(
        {
            "apiVersion": "fractus.dev/v1alpha1",
            "kind": "Grant",
            "metadata": {"name": name, "uid": "u1"},
            "spec": spec().to_dict(),
        }
    )


@odd_files
def test_agent_replaces_odd_file_by_its_grant(tmp_path: Path, make_odd: MakeOdd) -> None:
    directory = GrantDirectory(tmp_path)
    make_odd(tmp_path / "g.json")
    assert not directory.contains(grant())
    assert directory.write(grant())
    assert directory.contains(grant())
    assert (tmp_path / "g.json").is_file()
    assert not (tmp_path / "g.json").is_symlink()


def test_agent_opens_store_with_odd_temporary_files(tmp_path: Path) -> None:
    (tmp_path / ".a.tmp").mkdir()
    os.mkfifo(tmp_path / ".b.tmp")
    GrantDirectory(tmp_path).open()
    assert [path.name for path in tmp_path.iterdir()] == [".a.tmp"]


@odd_files
def test_direct_link_store_skips_odd_file(tmp_path: Path, make_odd: MakeOdd) -> None:
    make_odd(tmp_path / "odd.json")
    store: Any = None
    links = DirectLinkStore(store, tmp_path, "drone-1", "drone", lambda: None)
    links.restore()
    assert not links.links


@odd_files
def test_node_object_file_replaces_odd_file(tmp_path: Path, make_odd: MakeOdd) -> None:
    path = tmp_path / "node.json"
    make_odd(path)
    file = NodeObjectFile(path)
    assert file.read() is None
    drone = Drone.from_body(
        {"apiVersion": "fractus.dev/v1alpha1", "kind": "Drone", "metadata": {"name": "drone-1"}, "spec": {}}
    )
    file.write(drone)
    assert file.read() == drone
    path.unlink()
    (tmp_path / "target-of-link").unlink(missing_ok=True)
    make_odd(path)
    file.clear()
    assert read_file(path) == b""


@odd_files
def test_diagnostics_skip_odd_files(tmp_path: Path, make_odd: MakeOdd) -> None:
    (tmp_path / "camera").mkdir()
    make_odd(tmp_path / "audit.checkpoint")
    make_odd(tmp_path / "camera" / "recording.problem")
    assert read_audit_heads(tmp_path) == []
    assert read_recording_problems(tmp_path) == []


@odd_files
def test_node_description_is_missing_when_agents_file_is_odd(tmp_path: Path, make_odd: MakeOdd) -> None:
    make_odd(tmp_path / "agent.json")
    assert NodeDescription("drone-1", tmp_path / "agent.json", tmp_path / "node.yaml", Drone).value is None


@odd_files
def test_service_does_not_start_with_odd_description(tmp_path: Path, make_odd: MakeOdd) -> None:
    make_odd(tmp_path / "node.yaml")
    with pytest.raises(CannotServe, match=r"node\.yaml: cannot be read"):
        NodeDescription("drone-1", tmp_path / "agent.json", tmp_path / "node.yaml", Drone)


@odd_files
@pytest.mark.parametrize("name", ["ca.crt", "tls.crt", "tls.key"])
def test_tls_directory_with_odd_file_is_refused(tmp_path: Path, make_odd: MakeOdd, name: str) -> None:
    for other in {"ca.crt", "tls.crt", "tls.key"} - {name}:
        (tmp_path / other).write_bytes(b"x")
    make_odd(tmp_path / name)
    with pytest.raises(InvalidCertificate):
        inspect_certificate(tmp_path, "drone-1")
    for context in (client_context, server_context):
        with pytest.raises(OSError, match=r"."):
            context(tmp_path)
    with pytest.raises(UnsuitableFile):
        TlsFiles(tmp_path).client_credentials()
    with pytest.raises(UnsuitableFile):
        read_set(tmp_path, (name,)) if (tmp_path / "..data").symlink_to(".") is None else None
    assert TlsFiles(tmp_path).expires_s() is None


@odd_files
def test_state_directory_with_odd_files_is_read(tmp_path: Path, make_odd: MakeOdd) -> None:
    make_odd(tmp_path / "journal.json")
    (tmp_path / "target-of-link").unlink(missing_ok=True)
    make_odd(tmp_path / "vehicle.json")
    assert not Journal(tmp_path).record.missions
    assert read_known_vehicle(tmp_path / "vehicle.json") is None


@odd_files
def test_directory_camera_skips_odd_image(tmp_path: Path, make_odd: MakeOdd) -> None:
    make_odd(tmp_path / "odd.jpg")
    assert read_position(tmp_path / "odd.jpg") is None


# A device is older than the flight, so the view does not open a link to it.
@pytest.mark.parametrize("make_odd", [make for name, make in ODD.items() if name != "link-to-device"])
def test_growing_recordings_report_odd_file_and_read_others(tmp_path: Path, make_odd: MakeOdd) -> None:
    make_odd(tmp_path / os.fsdecode(b"odd-\xe9.mcap"))
    (tmp_path / "loop.mcap").symlink_to("loop.mcap")
    (tmp_path / "sound.mcap").write_bytes(b"\x89MCAP0\r\n")
    recordings = GrowingRecordings(tmp_path)
    (problem,) = recordings._read()
    assert isinstance(problem, Problem)
    json.dumps(problem.text).encode()
    assert "odd-" in problem.text
    assert recordings._read() == [], "reported once"


@odd_files
def test_view_refuses_odd_recording(tmp_path: Path, make_odd: MakeOdd) -> None:
    make_odd(tmp_path / "odd.mcap")
    result = CliRunner().invoke(view, [str(tmp_path / "odd.mcap")])
    assert result.exit_code == 1
    assert "is not a" in result.output


@odd_files
def test_zones_import_refuses_odd_file(tmp_path: Path, make_odd: MakeOdd) -> None:
    path = tmp_path / os.fsdecode(b"odd-\xe9.kml")
    make_odd(path)
    result = CliRunner().invoke(zones, ["import", "--from", "kml", str(path)])
    assert result.exit_code == 1
    assert "odd-\\xe9.kml: " in result.output


def test_tail_names_the_file_that_is_no_recording(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"something")
    with pytest.raises(ValueError, match=f"{path} is not an MCAP file"):
        list(Tail(path).read())
