"""The code path of one Application, from the kopf handler to its applied child objects, stays short.

Run with `-s` to print the files and functions in the order of their first call: a reading list for newcomers.
"""

from __future__ import annotations

import asyncio
import contextlib
import contextvars
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import pytest
from control_plane import ControlPlane
from fractus_cluster.ports import free_port
from fractus_operator.__main__ import run
from fractus_operator.application_controller import ApplicationController
from fractus_operator.settings import Settings
from operator_world import SYSTEM, World, traffic

REPOSITORY = Path(__file__).parents[2]
MAX_FILES = 35
MAX_FUNCTIONS = 190
"""Limits for the operator. Functions of core and runtime that it calls are printed, but not limited here.

Measured: 31 files and 168 functions to 33 files and 184 functions. The result of a write is reported to the listeners of the cache on
this path only if the watch has not reported it before.
"""

_on_path = contextvars.ContextVar("on_path", default=False)
"""True in the task of the Application's handler, and in tasks and threads that this task starts."""


class PathRecorder:
    """Records the functions of this repository that are called on the path of the Application."""

    def __init__(self) -> None:
        self._codes: dict[CodeType, None] = {}

    def profile(self, frame: FrameType, event: str, _argument: object) -> None:
        """Record a call; a profile function as `sys.setprofile` takes it."""
        if event == "call" and frame.f_code not in self._codes and _on_path.get():
            self._codes[frame.f_code] = None

    def functions(self) -> list[tuple[str, str]]:
        """Return the file and the qualified name of each function, in the order of their first call.

        Lambdas, comprehensions and functions inside functions count as part of the function that contains them.
        """
        seen: dict[tuple[str, str], None] = {}
        for code in self._codes:
            path = Path(code.co_filename)
            name = code.co_qualname.partition(".<locals>")[0]
            ours = path.is_relative_to(REPOSITORY) and not {".venv", "tests"} & set(path.parts)
            if ours and not name.startswith("<"):
                seen[str(path.relative_to(REPOSITORY)), name] = None
        return list(seen)

    @contextlib.contextmanager
    def recording(self) -> Iterator[None]:
        """Record while the context lasts, in this thread and in those that start meanwhile."""
        threading.setprofile(self.profile)
        sys.setprofile(self.profile)
        try:
            yield
        finally:
            sys.setprofile(None)
            threading.setprofile(None)


async def test_application_path_has_few_files_and_functions(
    control_plane: ControlPlane, world: World, namespace: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("KUBECONFIG", str(control_plane.kubeconfig))
    follow = ApplicationController.follow

    async def marked(self: ApplicationController, *args: Any) -> None:
        _on_path.set(True)
        await follow(self, *args)

    monkeypatch.setattr(ApplicationController, "follow", marked)
    settings = Settings(namespace=SYSTEM, health=f"http://127.0.0.1:{free_port()}/healthz", lease_s=5.0)
    recorder = PathRecorder()
    stop = asyncio.Event()
    with recorder.recording():
        operator = asyncio.create_task(run(settings, stop))
        try:
            await asyncio.to_thread(world.put, traffic(namespace))
            await asyncio.to_thread(world.phase, namespace, "Deploying")
        finally:
            stop.set()
            await operator
    functions = recorder.functions()
    files = dict.fromkeys(path for path, _ in functions)
    for path in files:
        print(f"{path}: {', '.join(name for each, name in functions if each == path)}")
    print(f"{len(files)} files, {len(functions)} functions")
    operator_files = [path for path in files if path.startswith("operator/")]
    operator_functions = [name for path, name in functions if path.startswith("operator/")]
    print(f"operator: {len(operator_files)} files, {len(operator_functions)} functions")
    assert "deployment" in operator_functions, "the path reaches the Deployments"
    assert len(operator_files) <= MAX_FILES
    assert len(operator_functions) <= MAX_FUNCTIONS
