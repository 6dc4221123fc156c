"""Verdicts of running flights on a cluster, from the logs of the mobility and camera services.

The services log every decision that changed or refused a request (`fractus_services.decision_log`). Reading these logs needs
the permission `pods/log`, which the API server checks. Nodes therefore need no additional server, and no additional account.
"""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import aclosing
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Any

from fractus_runtime.kubernetes import POD, Body, Client, Key, KubeError

from fractus_view.events import Event, Records, Verdict
from fractus_view.translation import short_name

PODS_INTERVAL_S = 5.0
"""Interval at which pods are listed while a drone flies, in seconds."""

FOLLOW_S = 60.0
"""Time after which a log is requested again, in seconds, because a broken connection looks like a log without new lines."""

RETRY_S = 5.0
"""Pause after a failed request, in seconds."""

HISTORY_S = 3_600
"""Age of the oldest verdicts that are read at the start, in seconds."""

MAX_HISTORY_LINES = 2_000
"""Maximum number of lines that are read at the start."""

MAX_LOGS = 40
"""Maximum number of logs that are followed. Each of them keeps one connection to the API server."""

_COMPONENT = "app.kubernetes.io/component"
_SERVICES = f"app.kubernetes.io/name=fractus,{_COMPONENT} in (mobility,camera)"

_END = r"reason=(?P<reason>.*?)\)(?: \(suppressed=\d+\))?"
_CALL = re.compile(
    rf"policy: verdict \(action=(?P<action>correct|deny|takeover) caller=(?P<caller>\S+) method=(?P<method>\S+)"
    rf" code=(?P<code>\S*) policies=(?P<policies>\S*) {_END}"
)
_FILTERS = re.compile(
    rf"policy: filters required \(action=(?P<action>\S+) caller=(?P<caller>\S+) method=(?P<method>\S+) filters=(?P<filters>\S*)"
    rf" policies=(?P<policies>\S*) {_END}"
)
_TAKEOVER = re.compile(
    rf"control: (?P<action>\S+) \(kind=takeover controller=\S* code=(?P<code>\S*) policies=(?P<policies>\S*) {_END}"
)
_ALARM = re.compile(rf"monitor: alarm raised \(code=(?P<code>\S*) mode=\S* policies=(?P<policies>\S*) {_END}")
_FORMS = (("call", _CALL), ("call", _FILTERS), ("takeover", _TAKEOVER), ("monitor", _ALARM))
_TEXT_LINE = re.compile(r"\S+ \S+ [A-Z]+ [\w.]+: (.*)", re.DOTALL)


@dataclass(frozen=True, slots=True)
class LoggedVerdict:
    """A verdict with the identity of its caller, which contains the namespace of the application."""

    verdict: Verdict
    caller: str


def parse_line(node: str, line: str) -> LoggedVerdict | None:
    """Return the verdict in a log line with a time stamp of the kubelet, or None if the line contains no verdict.

    Args:
        node: Node of the service.
        line: Time stamp, and line in the format text or json (`fractus_runtime.logs`).
    """
    stamp, _, rest = line.partition(" ")
    try:
        time_ms = round(datetime.fromisoformat(stamp).timestamp() * 1000)
    except ValueError:
        return None
    message = _message(rest)
    for kind, form in _FORMS:
        match = form.fullmatch(message)
        if match is not None:
            return _verdict(node, time_ms, kind, match.groupdict())
    return None


def _message(line: str) -> str:
    if line.startswith("{"):
        try:
            message = json.loads(line).get("message")
        except ValueError:
            return ""
        return message if isinstance(message, str) else ""
    match = _TEXT_LINE.fullmatch(line)
    return match[1] if match is not None else ""


def _verdict(node: str, time_ms: int, kind: str, fields: Mapping[str, Any]) -> LoggedVerdict:
    caller = fields.get("caller") or ""
    reason = _known(fields["reason"])
    if "filters" in fields:
        reason = f"{reason}; filters: {fields['filters']}" if reason else f"filters: {fields['filters']}"
    verdict = Verdict(
        drone=node,
        time_ms=time_ms,
        kind=kind,
        component=short_name(caller),
        method=fields.get("method") or "",
        action=fields.get("action") or "alarm",
        code=_known(fields.get("code")),
        reason=reason,
        policies=[name for name in _known(fields["policies"]).split(",") if name],
        lat=None,
        lon=None,
    )
    return LoggedVerdict(verdict, caller)


def _known(value: str | None) -> str:
    """Return a value, or an empty string for a dash, which stands for a missing value."""
    return "" if value is None or value == "-" else value


class LogVerdicts:
    """Follows the logs of the services on the drones that fly or are about to fly.

    Args:
        client: Client of the API server.
        system_namespace: Namespace of the services.
        namespace: Show only calls of applications of this namespace. An empty string shows all.
        drones: Returns the names of the drones whose verdicts are shown.
        publish: Publishes events.
        now_ms: Returns the current time in Unix milliseconds.
    """

    def __init__(
        self,
        client: Client,
        system_namespace: str,
        *,
        namespace: str,
        drones: Callable[[], frozenset[str]],
        publish: Callable[[Iterable[Event]], None],
        now_ms: Callable[[], int],
    ) -> None:
        self._client = client
        self._system_namespace = system_namespace
        self._caller_prefix = f"/ns/{namespace}/" if namespace else ""
        self._drones = drones
        self._publish = publish
        self._now_ms = now_ms
        self._tasks: dict[Key, asyncio.Task[None]] = {}
        self._reached: dict[Key, str] = {}
        """Time stamp of the last line, by pod."""
        self._problems: dict[Key, str] = {}
        self._reported: str | None = None

    async def run(self) -> None:
        """Follow the logs until cancelled."""
        try:
            while True:
                try:
                    problems = await self._follow_pods()
                except KubeError as error:
                    problems = [_explained(error, f"pods in namespace {self._system_namespace}")]
                self._report(problems)
                await asyncio.sleep(PODS_INTERVAL_S)
        finally:
            for task in self._tasks.values():
                task.cancel()
            await asyncio.gather(*self._tasks.values(), return_exceptions=True)

    async def _follow_pods(self) -> list[str]:
        """Follow the logs of the current pods. Return the reasons why some verdicts are not received."""
        problems: list[str] = []
        drones = self._drones()
        wanted: dict[Key, Body] = {}
        if drones:
            page = await self._client.list_whole(
                POD, namespace=self._system_namespace, selectors={"labelSelector": _SERVICES}
            )
            running = (pod for pod in page.items if pod.get("status", {}).get("phase") == "Running")
            services = [pod for pod in running if pod["spec"].get("nodeName") in drones]
            wanted = {_key(pod): pod for pod in services[:MAX_LOGS]}
            if len(services) > MAX_LOGS:
                problems.append(f"only the verdicts of {MAX_LOGS} of {len(services)} services are received")
            silent = sorted(drones.difference(pod["spec"]["nodeName"] for pod in services))
            if silent:
                problems.append(f"no services in namespace {self._system_namespace} on {', '.join(silent)}")
        for task in self._tasks.values():
            if task.done():
                task.result()  # raises its error, because a followed log never ends without one
        for key in self._tasks.keys() - wanted.keys():
            self._tasks.pop(key).cancel()
            self._problems.pop(key, None)
        for key in wanted.keys() - self._tasks.keys():
            self._tasks[key] = asyncio.create_task(self._follow(key, wanted[key]))
        return problems

    async def _follow(self, pod: Key, body: Body) -> None:
        """Follow the log of a pod's service until cancelled."""
        node = body["spec"]["nodeName"]
        # Clusters may add other containers to the pod. The service's container has the name of the service.
        container = body["metadata"]["labels"][_COMPONENT]
        while True:
            try:
                async with asyncio.timeout(FOLLOW_S):
                    await self._read(pod, node, container)
                self._problems.pop(pod, None)
            except TimeoutError:
                self._problems.pop(pod, None)
                continue
            except KubeError as error:
                self._problems[pod] = (
                    f"{node}: {_explained(error, f'logs of pods in namespace {self._system_namespace}')}"
                )
            await asyncio.sleep(RETRY_S)

    async def _read(self, pod: Key, node: str, container: str) -> None:
        reached = self._reached.get(pod, "")
        start = (
            {"sinceTime": reached} if reached else {"sinceSeconds": str(HISTORY_S), "tailLines": str(MAX_HISTORY_LINES)}
        )
        lines = self._client.log(
            pod, {"container": container, "follow": "true", "timestamps": "true", **start}, silence_s=None
        )
        async with aclosing(lines):
            async for raw in lines:
                line = raw.decode(errors="replace")
                stamp = line.partition(" ")[0]
                # The kubelet compares whole seconds, and sends lines of the last second again.
                if stamp <= self._reached.get(pod, ""):
                    continue
                self._reached[pod] = stamp
                logged = parse_line(node, line)
                if logged is not None and self._is_shown(logged):
                    # A node whose clock is ahead must not move the timeline of the page into the future.
                    self._publish([replace(logged.verdict, time_ms=min(logged.verdict.time_ms, self._now_ms()))])

    def _is_shown(self, logged: LoggedVerdict) -> bool:
        """Return True unless another namespace called. Takeovers have no caller, and concern the drone of a shown application."""
        return not logged.caller or self._caller_prefix in logged.caller

    def _report(self, problems: Iterable[str]) -> None:
        """Publish the reasons why verdicts may be missing, if they have changed."""
        text = "; ".join([*problems, *sorted(set(self._problems.values()))])
        if text != self._reported:
            self._reported = text
            self._publish([Records(self._now_ms(), text)])


def _key(pod: Body) -> Key:
    return pod["metadata"]["namespace"], pod["metadata"]["name"]


def _explained(error: KubeError, what: str) -> str:
    if error.status == 403:
        return f"no permission to read {what}; the role view is sufficient"
    return str(error)
