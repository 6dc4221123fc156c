"""Stored files stay complete when the agent is killed: at any system call, or by SIGKILL at any time."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from fractus_runtime.files import read_set, write_file, write_set

WATCHED = ("open", "write", "fsync", "fchmod", "replace", "symlink", "mkdir", "unlink", "rename")


class Died(BaseException):
    """Raised in place of a system call to simulate the death of the process."""


def die_at(step: int, patch: pytest.MonkeyPatch) -> None:
    """Raise Died at the system call with this number, counted from now. A write stores half of its data first."""
    count = 0

    def wrap(name: str) -> None:
        real = getattr(os, name)

        def call(*args: object, **more: object) -> object:
            nonlocal count
            count += 1
            if count == step:
                if name == "write":
                    real(args[0], bytes(args[1])[: len(bytes(args[1])) // 2])  # type: ignore[arg-type]
                raise Died
            return real(*args, **more)

        patch.setattr(os, name, call)

    for name in WATCHED:
        wrap(name)


def die_everywhere(action: Callable[[], object], check: Callable[[bool], None]) -> int:
    """Run an action repeatedly, and let it die at each of its system calls in turn.

    Args:
        action: Action to run.
        check: Called after each run, with True if the action was complete.

    Returns:
        Number of system calls of the action.
    """
    for step in range(1, 200):
        done = False
        with pytest.MonkeyPatch.context() as patch:
            die_at(step, patch)
            try:
                action()
                done = True
            except Died:
                pass
        check(done)
        if done:
            return step - 1
    raise AssertionError("the action made more than 198 system calls")


def test_killed_write_file_leaves_the_old_or_the_new_file(tmp_path: Path) -> None:
    file = tmp_path / "g.json"
    old = b'{"version": 1}'
    new = b'{"version": 2, "long": "' + b"x" * 5000 + b'"}'
    write_file(file, old)

    def check(done: bool) -> None:
        assert file.read_bytes() in ((new,) if done else (old, new))
        assert [p.name for p in tmp_path.glob("*.json")] == ["g.json"]
        write_file(file, old)

    assert die_everywhere(lambda: write_file(file, new), check) >= 5


@pytest.mark.parametrize("before", ["nothing", "a set", "loose files", "half a set"])
def test_killed_write_set_leaves_all_old_or_all_new_files(tmp_path: Path, before: str) -> None:
    old = dict.fromkeys(("tls.crt", "tls.key", "ca.crt"), b"old")
    new = dict.fromkeys(old, b"new")
    count = 0

    def directory() -> Path:
        return tmp_path / str(count)

    def prepare() -> None:
        nonlocal count
        count += 1
        directory().mkdir()
        if before == "a set":
            write_set(directory(), old)
        elif before == "loose files":
            for name, content in old.items():
                (directory() / name).write_bytes(content)
        elif before == "half a set":
            (directory() / "..gone").mkdir()
            (directory() / "..data").symlink_to("..missing")
            (directory() / "tls.crt").symlink_to("..data/tls.crt")

    def check(done: bool) -> None:
        stored = read_set(directory(), tuple(old))
        assert stored == new or (not done and stored == (old if before == "a set" else None))
        write_set(directory(), new)
        assert {name: (directory() / name).read_bytes() for name in old} == new
        assert (directory() / "tls.key").stat().st_mode & 0o777 == 0o600
        assert len([p for p in directory().iterdir() if p.is_dir() and not p.is_symlink()]) == 1
        prepare()

    prepare()
    assert die_everywhere(lambda: write_set(directory(), new), check) > 10


WRITER = """
import os, sys
from pathlib import Path
from fractus_agent.grant_synchronizer import GrantDirectory, GrantSynchronizer
from fractus_agent.store import GrantList
for _ in sys.stdin:  # each line starts an agent, so that the modules are imported only once
    if not os.fork():
        break
    os.wait()
    print("ended", flush=True)
else:
    sys.exit()
def grant(name, size):
    return {"apiVersion": "fractus.dev/v1alpha1", "kind": "Grant", "metadata": {"name": name, "uid": name},
        "spec": {"node": "n", "application": {"namespace": "d", "name": "a", "uid": "u"}, "component": "C",
                 "instance": "i" * size}}
directory = GrantDirectory(Path(sys.argv[1]))
directory.open()
synchronizer = GrantSynchronizer(None, directory, "n", lambda grant: None)
print(os.getpid(), flush=True)
turn = 0
while True:
    turn += 1
    synchronizer.apply(GrantList(turn, tuple(grant(f"g{i}", turn % 700 + 1) for i in range(turn % 5)), {}, 0))
"""


def test_killed_agent_leaves_only_complete_grants(tmp_path: Path) -> None:
    seed = int(os.environ.get("SEED", "20260501"))
    print("seed", seed)
    source = random.Random(seed)
    seen = 0
    argv = [sys.executable, "-c", WRITER, str(tmp_path)]
    with subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as starter:
        assert starter.stdin is not None
        assert starter.stdout is not None
        for _ in range(12):
            print("start", file=starter.stdin, flush=True)
            agent = int(starter.stdout.readline())
            try:
                moment = time.monotonic() + source.uniform(0.0, 0.05)
                while time.monotonic() < moment:
                    for file in tmp_path.glob("*.json"):
                        try:
                            json.loads(file.read_bytes())
                        except FileNotFoundError:
                            continue
            finally:
                os.kill(agent, signal.SIGKILL)
            assert starter.stdout.readline() == "ended\n"
            for file in tmp_path.glob("*.json"):
                assert json.loads(file.read_bytes())["kind"] == "Grant"
                seen += 1
    assert seen > 0
