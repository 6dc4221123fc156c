"""An API server with one application: its pods, watched, and their containers' logs, which may be followed and cut."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Mapping
from contextlib import suppress
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

from fractus_cli.log_sources import time_ns
from kube_server import CHUNKED, answer, chunk

Body = dict[str, Any]
V1 = "/apis/fractus.dev/v1alpha1"
APPLICATIONS = f"{V1}/namespaces/default/applications"


def application(name: str = "traffic") -> Body:
    return {
        "metadata": {"name": name, "namespace": "default", "creationTimestamp": "2026-01-01T00:00:00Z"},
        "spec": {"components": [{"name": "Navigator"}, {"name": "GroundViewer"}]},
        "status": {"phase": "Deploying", "message": "pods start", "drone": "drone-1"},
    }


def pod(
    part: str, node: str, *, run: str = "1", before: str = "", state: str = "running", system: bool = False
) -> Body:
    """A pod of one container: `run` is its number, `before` that of the one that ended."""
    name, container = f"{part}-{node}".lower(), part.lower()
    key = "app.kubernetes.io/component" if system else "fractus.dev/component"
    told: Body = {
        "name": container,
        "state": {state: {"containerID": f"{name}#{run}"} if state == "terminated" else {}},
    }
    told |= {"containerID": f"{name}#{run}"} if state == "running" else {}
    told |= {"lastState": {"terminated": {"containerID": f"{name}#{before}"}}} if before else {}
    if state == "waiting":
        told["state"]["waiting"] = {"reason": "ImagePullBackOff", "message": "no such image"}
    return {
        "metadata": {
            "name": name,
            "namespace": "fractus-system" if system else "default",
            "uid": name,
            "labels": {key: part},
            "resourceVersion": "1",
        },
        "spec": {"nodeName": node, "containers": [{"name": container}]},
        "status": {"phase": "Running", "containerStatuses": [told]},
    }


class LogServer:
    """What is there; a test changes it while the command runs.

    Attributes:
        pods: by namespace.
        logs: lines by pod and number of the container, each beginning with its time.
        refusals: answers by what their path ends with, instead of all else.
        requests: what was asked for.
    """

    def __init__(self) -> None:
        self.applications = [application()]
        self.pods: dict[str, list[Body]] = {"default": [], "fractus-system": []}
        self.logs: dict[tuple[str, str], list[str]] = {}
        self.refusals: dict[str, tuple[int, str]] = {}
        self.requests: list[tuple[str, Mapping[str, str]]] = []
        self._changed = asyncio.Condition()
        self._events: list[tuple[str, str, Body]] = []
        self._cuts = 0
        self._tasks: set[asyncio.Task[None]] = set()

    async def stop(self) -> None:
        """End every answer that is not finished."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def change(self, type_: str, body: Body) -> None:
        """A pod comes, changes or goes."""
        async with self._changed:
            namespace, name = body["metadata"]["namespace"], body["metadata"]["name"]
            kept = [p for p in self.pods[namespace] if p["metadata"]["name"] != name]
            self.pods[namespace] = kept if type_ == "DELETED" else [*kept, body]
            body["metadata"]["resourceVersion"] = str(100 + len(self._events))
            self._events.append((namespace, type_, body))
            self._changed.notify_all()

    async def write(self, pod_name: str, run: str, *lines: str) -> None:
        """A container prints."""
        async with self._changed:
            self.logs.setdefault((pod_name, run), []).extend(lines)
            self._changed.notify_all()

    async def cut(self) -> None:
        """Every log that is followed is cut off in the middle."""
        async with self._changed:
            self._cuts += 1
            self._changed.notify_all()

    def __call__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.create_task(self._serve(reader, writer))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(asyncio.IncompleteReadError, ConnectionError):
            while True:
                head = (await reader.readuntil(b"\r\n\r\n")).decode()
                target = urlsplit(head.split(" ")[1])
                asked = {key: values[0] for key, values in parse_qs(target.query).items()}
                self.requests.append((unquote(target.path), asked))
                if not await self._answer(writer, unquote(target.path), asked):
                    break
                await writer.drain()
        writer.close()

    async def _answer(self, writer: asyncio.StreamWriter, path: str, asked: Mapping[str, str]) -> bool:
        """Whether the connection goes on."""
        refusal = next((said for end, said in self.refusals.items() if path.endswith(end)), None)
        parts = path.split("/")
        if refusal is not None:
            status, message = refusal
            writer.write(answer({"kind": "Status", "code": status, "reason": "Refused", "message": message}, status))
        elif path.startswith(APPLICATIONS):
            self._tell_applications(writer, path)
        elif path.endswith("/pods") and "watch" in asked:
            await self._watch(writer, parts[4])
        elif path.endswith("/pods"):
            items = [body for body in self.pods[parts[4]] if self._selected(body, asked["labelSelector"])]
            writer.write(answer({"metadata": {"resourceVersion": "50"}, "items": items}))
        elif path.endswith("/log"):
            return await self._log(writer, parts[4], parts[6], asked)
        else:
            writer.write(answer({"metadata": {}, "items": []}))
        return True

    def _tell_applications(self, writer: asyncio.StreamWriter, path: str) -> None:
        if path == APPLICATIONS:
            writer.write(answer({"metadata": {}, "items": self.applications}))
            return
        found = [body for body in self.applications if path == f"{APPLICATIONS}/{body['metadata']['name']}"]
        writer.write(answer(found[0]) if found else answer({"kind": "Status", "message": "none"}, 404))

    async def _watch(self, writer: asyncio.StreamWriter, namespace: str) -> None:
        writer.write(CHUNKED)
        told = 0
        while not writer.is_closing():
            for where, type_, body in self._events[told:]:
                if where == namespace:
                    writer.write(chunk(json.dumps({"type": type_, "object": body}).encode() + b"\n"))
            told = len(self._events)
            await writer.drain()
            async with self._changed:
                while len(self._events) == told:
                    await self._changed.wait()

    async def _log(self, writer: asyncio.StreamWriter, namespace: str, name: str, asked: Mapping[str, str]) -> bool:
        (body,) = [p for p in self.pods[namespace] if p["metadata"]["name"] == name]
        run = self._run(body, asked)
        lines = self.logs.get((name, run), [])
        # As an API server does: whole seconds.
        since_ns = (time_ns(asked.get("sinceTime", "")) or 0) // 1_000_000_000 * 1_000_000_000
        shown = [line for line in lines if (time_ns(line.split(" ")[0]) or since_ns) >= since_ns]
        shown = shown[len(shown) - min(int(asked.get("tailLines", len(shown))), len(shown)) :]
        writer.write(CHUNKED)
        for line in shown:
            writer.write(chunk(line.encode() + b"\n"))
        told, cuts = len(lines), self._cuts
        while asked.get("follow") == "true" and self._running(namespace, name, run):
            await writer.drain()
            async with self._changed:
                while (
                    len(self.logs.get((name, run), [])) == told
                    and cuts == self._cuts
                    and self._running(namespace, name, run)
                ):
                    await self._changed.wait()
            for line in self.logs.get((name, run), [])[told:]:
                writer.write(chunk(line.encode() + b"\n"))
                told += 1
            if cuts != self._cuts:
                return False
        writer.write(chunk(b""))
        return True

    @staticmethod
    def _selected(body: Body, selector: str) -> bool:
        """Whether a pod is of the components that are asked for."""
        _, _, components = selector.partition(",fractus.dev/component in (")
        return not components or body["metadata"]["labels"]["fractus.dev/component"] in components[:-1].split(",")

    @staticmethod
    def _run(body: Body, asked: Mapping[str, str]) -> str:
        (told,) = body["status"]["containerStatuses"]
        if asked.get("previous") == "true":
            found = told["lastState"]["terminated"]["containerID"]
        else:
            found = (
                told.get("containerID")
                or (told["state"].get("terminated") or told["lastState"]["terminated"])["containerID"]
            )
        return str(found).partition("#")[2]

    def _running(self, namespace: str, name: str, run: str) -> bool:
        for body in self.pods[namespace]:
            if body["metadata"]["name"] == name:
                (told,) = body["status"]["containerStatuses"]
                return told.get("containerID") == f"{name}#{run}"
        return False
