"""The code path of one Application, from the kopf handler to its applied child objects, stays short.

Run with `-s` to print the files and functions of the path in the order of their first call: a reading list for newcomers.
"""

from __future__ import annotations

import ast
import asyncio
import contextlib
import contextvars
import functools
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FrameType, FunctionType
from typing import Any

import pytest
from control_plane import ControlPlane
from fractus_cluster.ports import free_port
from fractus_operator import operator_metrics
from fractus_operator.__main__ import run
from fractus_operator.active_plans import ActivePlans
from fractus_operator.application_controller import ApplicationController
from fractus_operator.kinds import Key
from fractus_operator.resources.deployment import deployment
from fractus_operator.settings import Settings
from fractus_operator.store import Informer
from operator_world import SYSTEM, World, traffic

REPOSITORY = Path(__file__).parents[2]
MAX_FILES = 28
MAX_FUNCTIONS = 84
"""Limits for the steps in the operator. Steps in core and runtime are printed, but not limited here.

Measured: 25 files and 80 functions. With data access, metrics and observers of the cache: 32 files and 152 functions.
"""

_on_path = contextvars.ContextVar("on_path", default=False)
"""True in the task of the Application's handler, and in its tasks and threads, until the first rollout is complete."""


_CACHE_UPDATES = frozenset({Informer.record_write.__code__, ActivePlans.decide.__code__})
"""Functions that update the cache. They call observers of the cache: indexes, wake-ups and other controllers."""
_METRICS = operator_metrics.__file__


class PathRecorder:
    """Records the functions of this repository that are called on the path of the Application."""

    def __init__(self) -> None:
        self._codes: dict[CodeType, None] = {}
        self._steps: set[CodeType] = set()

    def profile(self, frame: FrameType, event: str, _argument: object) -> None:
        """Record a call. This is a profile function for `sys.setprofile`."""
        if event == "call" and frame.f_code not in self._steps and _on_path.get():
            self._codes[frame.f_code] = None
            if not _is_observer(frame):
                self._steps.add(frame.f_code)

    def has_called(self, function: FunctionType) -> bool:
        """Return True if a function was called on the path."""
        return function.__code__ in self._codes

    def functions(self, *, steps: bool) -> list[tuple[str, str]]:
        """Return the file and the qualified name of each function, in the order of their first call.

        Comprehensions and functions inside functions count as part of the function that contains them. Lambdas do not count.

        Args:
            steps: Return only the steps that a reader has to follow. Properties, special methods, and functions that only
                return a name or a lookup are access to data. Metrics and observers of the cache do not change the result.
        """
        seen: dict[tuple[str, str], None] = {}
        for code in self._codes:
            path = Path(code.co_filename)
            name = code.co_qualname.partition(".<locals>")[0]
            if not path.is_relative_to(REPOSITORY) or {".venv", "tests"} & set(path.parts):
                continue
            if name.startswith("<") or code.co_name == "<lambda>":
                continue
            if steps and (code not in self._steps or _is_data_access(path, name)):
                continue
            seen[str(path.relative_to(REPOSITORY)), name] = None
        return list(seen)

    @contextlib.contextmanager
    def recording(self) -> Iterator[None]:
        """Record calls until the block ends, in this thread and in threads that start during the block."""
        threading.setprofile(self.profile)
        sys.setprofile(self.profile)
        try:
            yield
        finally:
            sys.setprofile(None)
            threading.setprofile(None)


def _is_observer(frame: FrameType) -> bool:
    """Return True for a function of the metrics module, and for a function called during an update of the cache."""
    caller = frame.f_back
    while caller is not None:
        if caller.f_code in _CACHE_UPDATES:
            return True
        caller = caller.f_back
    return frame.f_code.co_filename == _METRICS


def _is_data_access(path: Path, name: str) -> bool:
    """Return True for special methods, properties, and functions that only return a name or a lookup."""
    short = name.rpartition(".")[2]
    return (short.startswith("__") and short.endswith("__")) or name in _lookups(path)


@functools.cache
def _lookups(path: Path) -> frozenset[str]:
    """Return the qualified names of the properties in a module, and of functions that only return an expression."""
    lookups = set()
    module = ast.parse(path.read_text())
    owners: list[ast.Module | ast.ClassDef] = [module]
    owners += [node for node in module.body if isinstance(node, ast.ClassDef)]
    for owner in owners:
        for member in owner.body:
            if isinstance(member, ast.FunctionDef) and (_is_property(member) or _only_returns(member)):
                lookups.add(f"{owner.name}.{member.name}" if isinstance(owner, ast.ClassDef) else member.name)
    return frozenset(lookups)


def _is_property(function: ast.FunctionDef) -> bool:
    return any(ast.unparse(decorator).endswith("property") for decorator in function.decorator_list)


def _only_returns(function: ast.FunctionDef) -> bool:
    statements = function.body[1:] if ast.get_docstring(function) else function.body
    branches = (ast.IfExp, ast.BoolOp, ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp, ast.Lambda)
    return (
        len(statements) == 1
        and isinstance(statements[0], ast.Return)
        and not any(isinstance(node, branches) for node in ast.walk(statements[0]))
    )


async def test_application_path_has_few_files_and_functions(
    control_plane: ControlPlane, world: World, namespace: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("KUBECONFIG", str(control_plane.kubeconfig))
    recorder = PathRecorder()
    follow = ApplicationController.follow
    reconcile = ApplicationController.reconcile

    async def marked(self: ApplicationController, *args: Any) -> None:
        _on_path.set(True)
        await follow(self, *args)

    async def until_deployed(self: ApplicationController, key: Key) -> float:
        next_s = await reconcile(self, key)
        if recorder.has_called(deployment):
            _on_path.set(False)
        return next_s

    monkeypatch.setattr(ApplicationController, "follow", marked)
    monkeypatch.setattr(ApplicationController, "reconcile", until_deployed)
    # A long Lease allows long request timeouts. A request that fails would add its error handling to the path.
    settings = Settings(namespace=SYSTEM, health=f"http://127.0.0.1:{free_port()}/healthz", lease_s=60.0)
    stop = asyncio.Event()
    with recorder.recording():
        operator = asyncio.create_task(run(settings, stop))
        try:
            await asyncio.to_thread(world.put, traffic(namespace))
            await asyncio.to_thread(world.phase, namespace, "Deploying")
        finally:
            stop.set()
            await operator
    for steps in (False, True):
        functions = recorder.functions(steps=steps)
        files = dict.fromkeys(path for path, _ in functions)
        for path in files if steps else ():
            print(f"{path}: {', '.join(name for each, name in functions if each == path)}")
        operator_files = [path for path in files if path.startswith("operator/")]
        operator_functions = [name for path, name in functions if path.startswith("operator/")]
        print(
            f"{'steps' if steps else 'all functions'}: {len(files)} files, {len(functions)} functions;"
            f" operator: {len(operator_files)} files, {len(operator_functions)} functions"
        )
    assert "deployment" in operator_functions, "the recorded path does not reach the Deployments"
    assert len(operator_files) <= MAX_FILES
    assert len(operator_functions) <= MAX_FUNCTIONS
