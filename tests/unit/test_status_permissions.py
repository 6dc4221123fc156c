"""`fractus status` and `explain` with permissions in one namespace only, and escaping of texts from other users."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import click
import pytest
from fractus_cli import doctor, explain, main, status
from fractus_cli.cluster_reader import ClusterReader
from fractus_cli.output import printable
from fractus_runtime.kubernetes import KubeError

TEAM = "/apis/fractus.dev/v1alpha1/namespaces/team/"
PATROL = {"metadata": {"namespace": "team", "name": "patrol"}, "status": {"phase": "Running", "message": "it flies"}}
PLAN = {"spec": {"application": "patrol", "placements": [{"component": "Viewer", "role": "cloud"}]}}


class Client:
    """Fake API server. It permits lists of namespace team. All other lists fail with the given status."""

    def __init__(self, status: int = 403) -> None:
        self.status = status

    def get(self, path: str) -> Any:
        return PATROL if path == f"{TEAM}applications/patrol" else None

    def list(self, path: str, **_: str) -> Sequence[Any]:
        if "/namespaces/team/" not in path:
            raise KubeError(self.status, "Refused", f"{path} is refused")
        return {f"{TEAM}applications": [PATROL], f"{TEAM}deploymentplans": [PLAN]}.get(path, [])


def reader(client: Any) -> ClusterReader:
    return ClusterReader(client)


def test_status_and_explain_show_permitted_namespace_and_name_forbidden_kinds() -> None:
    summary = status.collect(reader(Client()), "team")
    assert summary["forbidden"] == ["drones", "edgeNodes"]
    shown = "\n".join(status.lines(summary))
    assert "team/patrol" in shown
    assert "You are not permitted to list drones and edgeNodes" in shown
    summary = explain.collect(reader(Client()), "team", "patrol")
    shown = "\n".join(explain.lines(summary, None))
    assert "Viewer: cloud" in shown
    assert "You are not permitted to list grants" in shown


def test_explain_names_components_for_which_takeoff_waits() -> None:
    class Granting(Client):
        def list(self, path: str, **selectors: str) -> Sequence[Any]:
            application = {"namespace": "team", "name": "patrol"}
            spec = {"application": application, "instance": "patrol-navigator", "awaits": ["ImageChecker", "DataStore"]}
            return [{"spec": spec}] if path.endswith("/grants") else super().list(path, **selectors)

    shown = list(explain.lines(explain.collect(reader(Granting()), "team", "patrol"), None))
    assert "Takeoff: when all components are ready (start: whenReady); not ready: ImageChecker, DataStore" in shown


def test_status_of_all_namespaces_suggests_namespace_option_without_permission() -> None:
    with pytest.raises(click.ClickException, match="specify a namespace with --namespace"):
        status.collect(reader(Client()), "")


@pytest.mark.parametrize("code", [0, 401, 500])
def test_api_server_failure_is_not_reported_as_missing_permission(code: int) -> None:
    for collect in (lambda c: status.collect(c, "team"), lambda c: explain.collect(c, "team", "patrol")):
        with pytest.raises(KubeError):
            collect(reader(Client(code)))


MALICIOUS = "exit code 1: \x1b[2J\x1b[1;1Hall is well\r\n\x9b31m\u202eytpme"


def test_control_characters_in_component_messages_are_escaped(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """An administrator reads these messages in a terminal."""
    words = {
        "phase": "Running",
        "message": MALICIOUS,
        "conditions": [{"type": "Ready", "status": "False", "reason": "R", "message": MALICIOUS}],
    }

    class MaliciousClient(Client):
        def list(self, path: str, **_: str) -> Sequence[Any]:
            event = {"lastTimestamp": "now", "type": "Warning", "reason": "ComponentFailed", "message": MALICIOUS}
            of = {"applications": [PATROL | {"status": words}], "events": [event]}
            return of.get(path.rpartition("/")[2], [])

        def get(self, path: str) -> Any:
            return PATROL | {"status": words} if path.endswith("/patrol") else None

    @contextmanager
    def opened(_: object) -> Iterator[ClusterReader]:
        yield reader(MaliciousClient())

    for command in (status, explain, doctor):
        monkeypatch.setattr(command, "open_cluster", opened)
    for arguments in (["status"], ["explain", "patrol", "-n", "team"]):
        main.run(arguments)
        output = capsys.readouterr().out
        assert "all is well" in output
        assert "".join(output.split("\n")).isprintable(), arguments
        assert output.count("\\x1b[2J") == output.count("all is well")


def test_printable_keeps_unicode_text_and_escapes_control_characters() -> None:
    assert printable("Überflug: 50 m über Grund, 東京 🚁") == "Überflug: 50 m über Grund, 東京 🚁"
    assert printable("a\tb\nc\x00") == "a\\tb\\nc\\x00"
