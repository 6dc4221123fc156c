"""Start errors of the services: invalid descriptions, directories and addresses."""

import socket
from pathlib import Path

import click
import pytest
from click.testing import CliRunner, Result
from fractus_cli.standalone import StandalonePki
from fractus_services.commands import camera, mobility

SERVICES = pytest.mark.parametrize("service", [mobility, camera], ids=["mobility", "camera"])


@pytest.fixture
def tls(tmp_path: Path) -> Path:
    return StandalonePki.create(tmp_path / "pki").node("drone-1")


def serve(service: click.Group, tmp_path: Path, *more: str) -> Result:
    argv = ["serve", "--grants", str(tmp_path / "grants"), "--tls", str(tmp_path / "tls"), "--node", "drone-1"]
    argv += ["--state", str(tmp_path / "state"), "--audit", str(tmp_path / "audit.jsonl"), "--listen", "127.0.0.1:0"]
    argv += ["--description", str(tmp_path / "none.yaml"), *more]
    result = CliRunner().invoke(service, argv)
    assert isinstance(result.exception, SystemExit), result.exception
    return result


@SERVICES
@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"kind: [", "invalid YAML"),
        (b"\xff\xfe\x00", "cannot be read"),
        (b"- a list", "must contain one manifest of kind Drone"),
        (b"kind: Zone", "must contain one manifest of kind Drone"),
        (b"{apiVersion: fractus.dev/v1alpha1, kind: Drone, metadata: {name: d}, spec: 5}", "spec"),
    ],
)
def test_service_names_invalid_description(tmp_path: Path, service: click.Group, text: bytes, message: str) -> None:
    path = tmp_path / "node.yaml"
    path.write_bytes(text)
    result = serve(service, tmp_path, "--description", str(path))
    assert result.exit_code == 1
    assert f"Error: --description {path}: " in result.output
    assert message in result.output


@SERVICES
@pytest.mark.parametrize("option", ["--grants", "--tls", "--state"])
def test_service_refuses_file_in_place_of_directory(tmp_path: Path, service: click.Group, option: str) -> None:
    file = tmp_path / "file"
    file.touch()
    result = serve(service, tmp_path, option, str(file))
    assert result.exit_code == 2
    assert option in result.output
    assert "is a file" in result.output


@SERVICES
@pytest.mark.parametrize(
    "listen", ["nonsense", "127.0.0.1", ":50051", "127.0.0.1:-1", "127.0.0.1:99999", "h:5x", "unix-box:99999"]
)
def test_service_refuses_invalid_address(tmp_path: Path, service: click.Group, listen: str) -> None:
    result = serve(service, tmp_path, "--listen", listen)
    assert result.exit_code == 2
    assert "is not HOST:PORT with a port of at most 65535" in result.output


@SERVICES
def test_service_refuses_address_of_another_machine(tmp_path: Path, service: click.Group, tls: Path) -> None:
    result = serve(service, tmp_path, "--tls", str(tls), "--listen", "192.0.2.1:50051", *local_autopilot(service))
    assert result.exit_code == 1
    assert "Error: --listen 192.0.2.1:50051: cannot listen there; specify HOST:PORT" in result.output


@SERVICES
def test_service_reports_port_in_use(tmp_path: Path, service: click.Group, tls: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        listen = f"127.0.0.1:{taken.getsockname()[1]}"
        result = serve(service, tmp_path, "--tls", str(tls), "--listen", listen, *local_autopilot(service))
    assert f"Error: --listen {listen}" in result.output


def local_autopilot(service: click.Group) -> tuple[str, ...]:
    """Return options with an autopilot address on which nothing responds."""
    return ("--autopilot", "udpin:127.0.0.1:0") if service is mobility else ()
