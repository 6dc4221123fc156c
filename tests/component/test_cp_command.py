"""`fractus cp`, with a kubectl that reads objects and containers from files."""

from __future__ import annotations

import io
import json
import signal
import subprocess
import sys
import tarfile
import time
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from fractus_cli.cp import cp, extract

KUBECTL = f"""#!{sys.executable}
import json, os, subprocess, sys, time
from pathlib import Path
root = Path(os.environ["FAKE_CLUSTER"])
arguments = sys.argv[1:]
assert arguments[:2] == ["-n", "survey"], arguments
verb, *rest = arguments[2:]
with (root / "calls").open("a") as calls:
    calls.write(" ".join(arguments[2:]) + "\\n")
if verb == "get":
    file = root / (("pod-status" if rest[0] == "pod" else rest[0]) + ".json")
    if not file.exists():
        sys.exit(f"Error from server (NotFound): {{rest[0]}} not found")
    print(file.read_text())
elif verb == "create":
    (root / "created.json").write_text(sys.stdin.read())
elif verb == "wait" and (root / "pod-status.json").exists():
    sys.exit("error: timed out waiting for the condition")
elif verb == "wait" and (root / "slow").exists():
    time.sleep(60)
elif verb == "exec":
    pod, _, *command = rest
    place = command.index("-C") + 1
    command[place] = str(root / "container") + command[place]
    sys.exit(subprocess.run(command).returncode)
"""

CLAIM = {"name": "results", "mountPath": "/data", "claim": "survey-results"}
APPLICATION = {
    "metadata": {"name": "survey", "uid": "uid-1"},
    "spec": {
        "components": [
            {"name": "Navigator", "container": {"image": "navigator:1"}},
            {"name": "Store", "container": {"image": "store:1", "volumes": [CLAIM]}},
        ]
    },
}


@pytest.fixture
def cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Directory with the objects of the cluster and the files of its only container."""
    root = tmp_path / "cluster"
    files = root / "container" / "data" / "pictures"
    files.mkdir(parents=True)
    (files / "1.jpg").write_bytes(b"picture" * 10_000)
    (files.parent / "summary.csv").write_text("lat,lon\n")
    (files / "latest").symlink_to("/etc/passwd")
    program = tmp_path / "bin" / "kubectl"
    program.parent.mkdir()
    program.write_text(KUBECTL)
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(program.parent), prepend=":")
    monkeypatch.setenv("FAKE_CLUSTER", str(root))
    monkeypatch.chdir(tmp_path)
    (root / "application.fractus.dev.json").write_text(json.dumps(APPLICATION))
    put_pods(root)
    return root


def put_pods(root: Path, **phases: str) -> None:
    """Set the pods of the component by their phases."""
    pods: list[dict[str, Any]] = []
    for name, phase in phases.items():
        spec = {"activeDeadlineSeconds": 1} if phase == "Stopping" else {}
        status = {"phase": "Running" if phase == "Stopping" else phase}
        pods.append({"metadata": {"name": name}, "spec": spec, "status": status})
    (root / "pods.json").write_text(json.dumps({"items": pods}))


def run(*arguments: str) -> Result:
    return CliRunner().invoke(cp, [*arguments, "-n", "survey"])


def calls(root: Path) -> list[str]:
    return (root / "calls").read_text().splitlines()


def test_cp_copies_a_directory_of_a_running_pod(cluster: Path, tmp_path: Path) -> None:
    put_pods(cluster, old="Failed", store="Running")
    result = run("survey/Store:/data/", "results")
    assert result.exit_code == 0, result.output
    assert "copied 2 files from survey/Store:/data" in result.output
    assert "not copied, because it is not a regular file: data/pictures/latest" in result.output.replace("./", "")
    copied = {str(p.relative_to(tmp_path / "results")) for p in (tmp_path / "results").rglob("*")}
    assert copied == {"pictures", "pictures/1.jpg", "summary.csv"}
    assert (tmp_path / "results" / "pictures" / "1.jpg").read_bytes() == b"picture" * 10_000
    (tmp_path / "other").write_text("")
    assert (tmp_path / "results" / "summary.csv").stat().st_mode == (tmp_path / "other").stat().st_mode
    assert not any(call.startswith("create") for call in calls(cluster))
    # A second copy into the existing directory has the name of the source.
    assert run("survey/Store:/data/summary.csv", "results/pictures").exit_code == 0
    assert (tmp_path / "results" / "pictures" / "summary.csv").read_text() == "lat,lon\n"


def test_cp_reads_the_claim_of_a_finished_pod_with_a_restricted_pod(cluster: Path, tmp_path: Path) -> None:
    put_pods(cluster, store="Stopping")
    result = run("survey/Store:/data/summary.csv", ".")
    assert result.exit_code == 0, result.output
    assert (tmp_path / "summary.csv").exists()
    pod = json.loads((cluster / "created.json").read_text())
    assert pod["spec"]["volumes"][0]["persistentVolumeClaim"] == {"claimName": "survey-results"}
    (reader,) = pod["spec"]["containers"]
    assert reader["image"] == "store:1"
    assert reader["volumeMounts"] == [{"name": "results", "mountPath": "/data", "readOnly": True}]
    assert reader["securityContext"]["capabilities"] == {"drop": ["ALL"]}
    assert pod["spec"]["automountServiceAccountToken"] is False
    (owner,) = pod["metadata"]["ownerReferences"]
    assert (owner["kind"], owner["name"], owner["uid"]) == ("Application", "survey", "uid-1")
    assert calls(cluster)[-1].startswith(f"delete pod {pod['metadata']['name']} ")


def test_cp_deletes_its_pod_and_reports_why_it_does_not_start(cluster: Path) -> None:
    condition = {"type": "PodScheduled", "status": "False", "message": "0/6 nodes are available"}
    (cluster / "pod-status.json").write_text(json.dumps({"status": {"conditions": [condition]}}))
    result = run("survey/Store:/data", "results")
    assert result.exit_code == 1
    assert "its reader pod does not start: 0/6 nodes are available" in result.output
    assert calls(cluster)[-1].startswith("delete pod")


def test_cp_deletes_its_pod_when_it_is_terminated(cluster: Path) -> None:
    (cluster / "slow").touch()
    program = "from fractus_cli.main import main; main()"
    command = [sys.executable, "-c", program, "cp", "survey/Store:/data", "results", "-n", "survey"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        end = time.monotonic() + 20
        while not (cluster / "calls").exists() or not calls(cluster)[-1].startswith("wait"):
            assert time.monotonic() < end, "the command does not wait for its pod"
            time.sleep(0.05)
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=20)
    assert "interrupted" in errors
    pod = json.loads((cluster / "created.json").read_text())
    assert calls(cluster)[-1].startswith(f"delete pod {pod['metadata']['name']} ")


def test_cp_stops_a_container_that_sends_more_than_its_archive(cluster: Path, tmp_path: Path) -> None:
    put_pods(cluster, store="Running")
    endless = tmp_path / "bin" / "tar"
    endless.write_text('#!/bin/sh\n/bin/tar "$@"\nexec head -c 20000000 /dev/zero\n')
    endless.chmod(0o755)
    result = run("survey/Store:/data", "results")
    assert result.exit_code == 1
    assert "the pod sent data after the end of its archive" in result.output


def test_cp_reports_a_missing_file(cluster: Path, tmp_path: Path) -> None:
    put_pods(cluster, store="Running")
    result = run("survey/Store:/data/none", "results")
    assert result.exit_code == 1
    assert "not copied completely" in result.output and "No such file" in result.output
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["survey/Store", "x"], "is not APPLICATION/COMPONENT:PATH"),
        (["survey/Store:data", "x"], "is not APPLICATION/COMPONENT:PATH"),
        (["survey/Store:/data/../etc", "x"], "contains '..'"),
        (["survey/Stor:/data", "x"], "has no component Stor (components: Navigator, Store)"),
        (["survey/Store:/tmp/x", "x"], "/tmp/x is in no PersistentVolumeClaim of the component (claims: /data)"),
        (["survey/Navigator:/tmp/x", "x"], "(claims: none)"),
        (["survey/Store:/data", "x", "--pod", "a"], "--pod a is not a running pod of Store (running: none)"),
    ],
)
def test_cp_refuses_a_source_that_does_not_exist(cluster: Path, arguments: list[str], sentence: str) -> None:
    result = run(*arguments)
    assert result.exit_code in {1, 2}
    assert sentence in result.output


def test_cp_needs_the_name_of_one_of_several_running_pods(cluster: Path) -> None:
    put_pods(cluster, a="Running", b="Running")
    assert "select one with --pod: a, b" in run("survey/Store:/data", "x").output
    assert run("survey/Store:/data", "x", "--pod", "b").exit_code == 0
    assert calls(cluster)[-1].startswith("exec b ")


def archive(*members: tuple[str, bytes, str]) -> bytes:
    """Return an archive of members: name, type and content (or the target of a link)."""
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w") as tar:
        for name, kind, content in members:
            info = tarfile.TarInfo(name)
            info.type = kind
            if kind == tarfile.REGTYPE:
                info.size = len(content)
                tar.addfile(info, io.BytesIO(content.encode()))
            else:
                info.linkname = content
                tar.addfile(info)
    return out.getvalue()


@pytest.mark.parametrize("name", ["../x", "data/../../x", "/x", "other/x", "./data/a/../../../x"])
def test_archive_with_a_path_outside_of_the_source_is_refused(tmp_path: Path, name: str) -> None:
    target = tmp_path / "here" / "results"
    target.parent.mkdir()
    with pytest.raises(Exception, match="refused: the archive of the pod contains the path"):
        extract(io.BytesIO(archive((name, tarfile.REGTYPE, "evil"))), "data", target)
    assert [p for p in tmp_path.rglob("*") if p.is_file()] == []


def test_archive_with_a_nul_character_in_a_path_is_refused_in_one_line(tmp_path: Path) -> None:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w", format=tarfile.PAX_FORMAT) as tar:
        info = tarfile.TarInfo("data/x")
        info.pax_headers = {"path": "data/x\0\x1b[2J"}
        tar.addfile(info)
    out.seek(0)
    with pytest.raises(Exception, match=r"refused: the archive of the pod contains the path data/x\\x00\\x1b\[2J"):
        extract(out, "data", tmp_path / "results")


def test_invalid_archive_is_reported_in_one_sentence(cluster: Path, tmp_path: Path) -> None:
    put_pods(cluster, store="Running")
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w", format=tarfile.PAX_FORMAT) as tar:
        info = tarfile.TarInfo("data/x")
        info.pax_headers = {"GNU.sparse.map": "x,y"}
        tar.addfile(info)
    (tmp_path / "invalid.tar").write_bytes(out.getvalue())
    invalid = tmp_path / "bin" / "tar"
    invalid.write_text(f"#!/bin/sh\nexec cat {tmp_path}/invalid.tar\n")
    invalid.chmod(0o755)
    assert "the files were not copied completely" in run("survey/Store:/data", "results").output


def test_archive_cannot_write_through_its_own_links(tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    members = [("data", tarfile.DIRTYPE, ""), ("data/link", tarfile.SYMTYPE, str(outside))]
    members += [("data/link/x", tarfile.REGTYPE, "evil"), ("data/hard", tarfile.LNKTYPE, "/etc/passwd")]
    members += [("data/device", tarfile.CHRTYPE, ""), ("data/pipe", tarfile.FIFOTYPE, "")]
    with pytest.raises(Exception, match="cannot write"):
        extract(io.BytesIO(archive(*members)), "data", tmp_path / "results")
    assert list(outside.iterdir()) == []


def test_incomplete_archive_leaves_no_incomplete_file(tmp_path: Path) -> None:
    content = archive(("data", tarfile.DIRTYPE, ""), ("data/big", tarfile.REGTYPE, "x" * 100_000))
    with pytest.raises(tarfile.TarError):
        extract(io.BytesIO(content[:50_000]), "data", tmp_path / "results")
    assert list((tmp_path / "results").iterdir()) == []
