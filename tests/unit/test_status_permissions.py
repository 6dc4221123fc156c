"""`fractus status` and `explain` by someone with rights in one namespace only, and what others can put before an administrator."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import click
import pytest
from fractus_cli import doctor, explain, main, status
from fractus_cli.output import printable
from fractus_cli.reading import Cluster
from fractus_runtime.kubernetes import KubeError

OURS = "/apis/fractus.dev/v1alpha1/namespaces/team/"
PATROL = {"metadata": {"namespace": "team", "name": "patrol"}, "status": {"phase": "Running", "message": "it flies"}}
PLAN = {"spec": {"application": "patrol", "placements": [{"component": "Viewer", "role": "cloud"}]}}


class Client:
    """An API server that lets what is in the namespace be read, and lists nothing else, for a reason."""

    def __init__(self, status: int = 403) -> None:
        self.status = status

    def get(self, path: str) -> Any:
        return PATROL if path == f"{OURS}applications/patrol" else None

    def list(self, path: str, **_: str) -> Sequence[Any]:
        if "/namespaces/team/" not in path:
            raise KubeError(self.status, "Refused", f"{path} is refused")
        return {f"{OURS}applications": [PATROL], f"{OURS}deploymentplans": [PLAN]}.get(path, [])


def cluster(client: Any) -> Cluster:
    return Cluster(client)


def test_what_is_in_the_namespace_is_shown() -> None:
    seen = status.look(cluster(Client()), "team")
    assert seen["forbidden"] == ["drones", "edgeNodes"]
    shown = "\n".join(status.lines(seen))
    assert "team/patrol" in shown
    assert "You may not list drones and edgeNodes" in shown
    seen = explain.look(cluster(Client()), "team", "patrol")
    shown = "\n".join(explain.lines(seen, None))
    assert "Viewer: cloud" in shown
    assert "You may not list grants" in shown


def test_all_namespaces_are_not_for_such_a_user() -> None:
    with pytest.raises(click.ClickException, match="give one with --namespace"):
        status.look(cluster(Client()), "")


@pytest.mark.parametrize("code", [0, 401, 500])
def test_an_api_server_that_fails_is_no_lack_of_rights(code: int) -> None:
    for ask in (lambda c: status.look(c, "team"), lambda c: explain.look(c, "team", "patrol")):
        with pytest.raises(KubeError):
            ask(cluster(Client(code)))


LIE = "exit code 1: \x1b[2J\x1b[1;1Hall is well\r\n\x9b31m\u202eytpme"


def test_last_words_of_a_component_stay_words(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """An administrator reads them in a terminal."""
    words = {
        "phase": "Running",
        "message": LIE,
        "conditions": [{"type": "Ready", "status": "False", "reason": "R", "message": LIE}],
    }

    class Liar(Client):
        def list(self, path: str, **_: str) -> Sequence[Any]:
            event = {"lastTimestamp": "now", "type": "Warning", "reason": "ComponentFailed", "message": LIE}
            of = {"applications": [PATROL | {"status": words}], "events": [event]}
            return of.get(path.rpartition("/")[2], [])

        def get(self, path: str) -> Any:
            return PATROL | {"status": words} if path.endswith("/patrol") else None

    @contextmanager
    def opened(_: object) -> Iterator[Cluster]:
        yield cluster(Liar())

    for command in (status, explain, doctor):
        monkeypatch.setattr(command, "cluster", opened)
    for arguments in (["status"], ["explain", "patrol", "-n", "team"]):
        main.run(arguments)
        said = capsys.readouterr().out
        assert "all is well" in said
        assert "".join(said.split("\n")).isprintable(), arguments
        assert said.count("\\x1b[2J") == said.count("all is well")


def test_what_can_be_read_stays_as_it_is() -> None:
    assert printable("Überflug: 50 m über Grund, 東京 🚁") == "Überflug: 50 m über Grund, 東京 🚁"
    assert printable("a\tb\nc\x00") == "a\\tb\\nc\\x00"
