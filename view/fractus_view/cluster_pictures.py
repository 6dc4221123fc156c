"""Thumbnails of pictures on a cluster: runs `fractus_services.recording.thumbnails` on the nodes with kubectl.

Running a program on a node needs the permission `pods/exec`, which the API server checks. The pictures come from the
recordings of the camera service, which contain them after privacy filters, and only thumbnails leave the node.
"""

from __future__ import annotations

import asyncio
import itertools
import json
from base64 import b64decode
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import Any

from fractus_runtime.kubernetes import POD, Body, Client, KubeError

from fractus_view.events import Event, Picture, PictureSource

DIRECTORY = "/var/lib/fractus/recordings/camera"
"""Directory of the camera service's recordings in its container."""

MAX_LINE_BYTES = 100_000
"""Maximum length of a line with a thumbnail."""

MAX_STORED = 60
"""Number of thumbnails in memory."""

PODS_INTERVAL_S = 5.0
RETRY_S = 10.0
MAX_PODS = 10
"""Maximum number of nodes on which the program runs at the same time."""

_CAMERAS = "app.kubernetes.io/name=fractus,app.kubernetes.io/component=camera"


class ClusterPictures:
    """Receives thumbnails from the camera services of drones, and keeps the latest ones in memory.

    Args:
        client: Client of the API server.
        kubectl: Command of kubectl with the options that select the cluster.
        system_namespace: Namespace of the camera services.
        drones: Returns the names of the drones whose pictures are shown.
        publish: Publishes events.
        now_ms: Returns the current time in Unix milliseconds.
    """

    def __init__(
        self,
        client: Client,
        kubectl: Sequence[str],
        system_namespace: str,
        *,
        drones: Callable[[], frozenset[str]],
        publish: Callable[[Iterable[Event]], None],
        now_ms: Callable[[], int],
    ) -> None:
        self._client = client
        self._kubectl = tuple(kubectl)
        self._system_namespace = system_namespace
        self._drones = drones
        self._publish = publish
        self._now_ms = now_ms
        self._stored: OrderedDict[str, bytes] = OrderedDict()
        self._ids = itertools.count()
        self._tasks: dict[tuple[str, str], asyncio.Task[None]] = {}
        self._problems: dict[tuple[str, str], str] = {}
        self._reported: str | None = None

    def picture(self, id_: str) -> bytes | None:
        """Return a thumbnail (JPEG) by the id of its event, or None if it was replaced by newer ones."""
        return self._stored.get(id_)

    async def run(self) -> None:
        """Receive thumbnails until cancelled."""
        try:
            while True:
                problem = ""
                try:
                    await self._follow_pods()
                except KubeError as error:
                    problem = str(error)
                self._report(problem)
                await asyncio.sleep(PODS_INTERVAL_S)
        finally:
            for task in self._tasks.values():
                task.cancel()
            await asyncio.gather(*self._tasks.values(), return_exceptions=True)

    async def _follow_pods(self) -> None:
        drones = self._drones()
        wanted: dict[tuple[str, str], str] = {}
        if drones:
            page = await self._client.list_whole(
                POD, namespace=self._system_namespace, selectors={"labelSelector": _CAMERAS}
            )
            running = [pod for pod in page.items if pod.get("status", {}).get("phase") == "Running"]
            cameras = {pod["spec"].get("nodeName"): _name(pod) for pod in running}
            wanted = {(node, cameras[node]): cameras[node] for node in sorted(drones & cameras.keys())[:MAX_PODS]}
        for task in self._tasks.values():
            if task.done():
                task.result()  # raises its error, because the task never ends without one
        for key in self._tasks.keys() - wanted.keys():
            self._tasks.pop(key).cancel()
            self._problems.pop(key, None)
        for key in wanted.keys() - self._tasks.keys():
            self._tasks[key] = asyncio.create_task(self._follow(*key))

    async def _follow(self, node: str, pod: str) -> None:
        """Run the program on a node until cancelled. It ends regularly, and is started again."""
        after_ms = 0
        while True:
            process = await asyncio.create_subprocess_exec(
                *self._kubectl, "exec", "-n", self._system_namespace, pod, "-c", "camera", "--",
                "python3", "-m", "fractus_services.recording.thumbnails", DIRECTORY, "--after", str(after_ms),
                stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
                limit=MAX_LINE_BYTES,
            )  # fmt: skip
            try:
                assert process.stdout is not None
                assert process.stderr is not None
                errors = asyncio.create_task(process.stderr.read(1_000))
                with suppress(ValueError):  # a line above the limit
                    async for line in process.stdout:
                        after_ms = max(after_ms, self._receive(node, line))
                        self._problems.pop((node, pod), None)
                error = (await errors).decode(errors="replace").strip()
            finally:
                if process.returncode is None:
                    process.kill()
                await process.wait()
            if process.returncode == 0:
                self._problems.pop((node, pod), None)
            else:
                last_line = error.splitlines()[-1] if error else f"kubectl failed with status {process.returncode}"
                self._problems[node, pod] = f"{node}: {last_line}"
            await asyncio.sleep(RETRY_S)

    def _receive(self, node: str, line: bytes) -> int:
        """Store the thumbnail of a line and publish its event. Return its time, or 0 if the line is invalid."""
        try:
            content: Any = json.loads(line)
            time_ms = int(content["time_ms"])
            jpeg = b64decode(content["jpeg"], validate=True)
        except (ValueError, KeyError, TypeError):
            return 0
        id_ = f"cluster-{next(self._ids)}"
        self._stored[id_] = jpeg
        while len(self._stored) > MAX_STORED:
            self._stored.popitem(last=False)
        self._publish([Picture(node, min(time_ms, self._now_ms()), id_)])
        return time_ms

    def _report(self, problem: str) -> None:
        text = "; ".join(filter(None, (problem, *sorted(self._problems.values()))))
        if text != self._reported:
            self._reported = text
            self._publish([PictureSource(self._now_ms(), text)])


def _name(pod: Body) -> str:
    return str(pod["metadata"]["name"])
