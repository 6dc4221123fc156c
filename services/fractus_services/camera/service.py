"""The camera service: judge, take, keep, hand out."""

from __future__ import annotations

import asyncio
import itertools
import logging
from collections.abc import Callable
from dataclasses import asdict, replace
from datetime import UTC, datetime
from typing import Protocol

import grpc
from fractus_core.policy.access import judge_privacy
from fractus_core.policy.engine import judge
from fractus_core.policy.values import Call, CaptureArgs, Situation, Verdict

from fractus_services.audit import AuditLog
from fractus_services.camera.album import Album, AlbumFull, NoSuchImage, Shot
from fractus_services.camera.pictures import render
from fractus_services.grants import Held
from fractus_services.replies import Refused, refused

log = logging.getLogger(__name__)

MAX_PX = 8192
MAX_WAITING = 8
"""So many pictures may be under way or wait for the shutter."""


def owner_of(held: Held) -> str:
    """Whose pictures they are: an instance of this very application, not of a later one of the same name."""
    return f"{held.spec.application.uid}/{held.identity}"


class Whereabouts(Protocol):
    """Tells where the camera is."""

    def situation(self, time_s: float) -> Situation:
        """The present state."""

    async def run(self) -> None:
        """Keep it present."""


class CameraService:
    """Table 8.2 of the thesis, for callers whose grant is known.

    A privacy policy that asks for a filter which is not built in refuses the picture.

    Args:
        whereabouts: where the camera is.
        album: where pictures are kept.
        audit: where decisions are written.
        clock: Unix time.
        resolution: the camera's own width and height.
    """

    def __init__(
        self,
        whereabouts: Whereabouts,
        album: Album,
        audit: AuditLog,
        clock: Callable[[], float],
        resolution: tuple[int, int],
    ) -> None:
        self._whereabouts = whereabouts
        self._album = album
        self._audit = audit
        self._clock = clock
        self._resolution = resolution
        self._numbers = itertools.count()
        self._shutter = asyncio.Lock()
        self._exposing: set[asyncio.Task[tuple[Verdict, Shot]]] = set()

    async def capture(
        self, held: Held, args: CaptureArgs, present: Callable[[], Held] | None = None
    ) -> tuple[Verdict, Shot]:
        """Take a picture and keep it.

        It is judged when the shutter is free, and again when the picture is taken: the drone moves meanwhile, and grants
        change.

        Args:
            held: the caller's grant.
            args: pixels; 0 means the camera's own.
            present: the caller's grant at a later moment; raises when there is none any more.
        """
        width, height = args.width or self._resolution[0], args.height or self._resolution[1]
        if width > MAX_PX or height > MAX_PX or width < 16 or height < 16:
            reason = f"{width}x{height} pixels is not between 16x16 and {MAX_PX}x{MAX_PX}"
            raise refused(Verdict("deny", None, "InvalidArgument", reason))
        if len(self._exposing) >= MAX_WAITING:
            reason = f"{MAX_WAITING} pictures are waiting to be taken; try again"
            raise Refused(grpc.StatusCode.RESOURCE_EXHAUSTED, Verdict("deny", None, "ShutterBusy", reason))
        work = self._in_turn(replace(args, width=width, height=height), present or (lambda: held))
        task = asyncio.get_running_loop().create_task(work)
        self._exposing.add(task)
        task.add_done_callback(self._exposed)
        # A caller that hangs up does not free the shutter before the picture is done.
        return await asyncio.shield(task)

    def _exposed(self, task: asyncio.Task[tuple[Verdict, Shot]]) -> None:
        self._exposing.discard(task)
        if not task.cancelled() and task.exception() is not None:
            log.debug("no picture: %s", task.exception())

    async def _in_turn(self, args: CaptureArgs, present: Callable[[], Held]) -> tuple[Verdict, Shot]:
        async with self._shutter:
            held, call = present(), Call("CaptureImage", args)
            now = self._whereabouts.situation(self._clock())
            verdict = self._allow(call, held, now)
            problem = await asyncio.to_thread(self._album.room, owner_of(held))
            if problem:
                raise AlbumFull(problem)
            lines = (
                held.spec.node,
                f"{now.lat:.7f} {now.lon:.7f} {now.altitude_m:.1f} m" if now.lat is not None else "no fix",
            )
            data = await asyncio.to_thread(render, args.width, args.height, lines, now.time_s)
            after = self._whereabouts.situation(self._clock())
            held = present()
            self._allow(call, held, after, always=False)
            moment = datetime.fromtimestamp(now.time_s, UTC).strftime("%Y%m%d%H%M%S%f")[:17]
            name = f"{moment}-{next(self._numbers) % 10000:04d}.jpg"
            shot = Shot(
                name, float(now.time_s), args.width, args.height, len(data), now.lat, now.lon, now.altitude_m,
                now.position_error_m,
            )  # fmt: skip
            await asyncio.to_thread(self._album.add, owner_of(held), shot, data)
        return verdict, shot

    async def retrieve(self, held: Held, name: str) -> tuple[Verdict, Shot, bytes]:
        """A picture; policies hold for where it was taken and for where the camera is now."""
        now = self._whereabouts.situation(self._clock())
        verdict = self._allow(Call("RetrieveImage"), held, now)
        shot = await asyncio.to_thread(self._album.find, owner_of(held), name)
        then = replace(
            now, lat=shot.lat, lon=shot.lon, altitude_m=shot.altitude_m, position_error_m=shot.position_error_m
        )
        self._check(Call("RetrieveImage"), held, judge_privacy(then, held.compiled), then)
        return verdict, shot, await asyncio.to_thread(self._album.read, owner_of(held), name)

    async def list(self, held: Held) -> tuple[Verdict, tuple[Shot, ...]]:
        """The pictures of the caller."""
        verdict = self._allow(Call("ListImages"), held, self._whereabouts.situation(self._clock()))
        return verdict, await asyncio.to_thread(self._album.list, owner_of(held))

    async def delete(self, held: Held, name: str) -> Verdict:
        """Remove a picture of the caller."""
        verdict = self._allow(Call("DeleteImage"), held, self._whereabouts.situation(self._clock()))
        await asyncio.to_thread(self._album.delete, owner_of(held), name)
        return verdict

    def _allow(self, call: Call, held: Held, now: Situation, always: bool = True) -> Verdict:
        try:
            verdict = judge(call, now, held.compiled)
        except Exception:
            log.exception("the policy engine failed on %s; refused", call.method)
            verdict = Verdict("deny", None, "InternalError", f"the policy engine failed on {call.method}")
        return self._check(call, held, verdict, now, always)

    def _check(self, call: Call, held: Held, verdict: Verdict, now: Situation, always: bool = False) -> Verdict:
        """Refuse what is denied, and what needs a filter that we do not have."""
        if verdict.filters:
            reason = f"{verdict.reason}, and this camera cannot do that; no picture is handed out"
            verdict = Verdict("deny", None, "FilterUnavailable", reason, verdict.policies)
        if always or not verdict.permits:
            self._audit.append(
                "call",
                {
                    "caller": held.identity, "method": call.method, "args": asdict(call.args) if call.args else {},
                    "action": verdict.action, "code": verdict.code, "reason": verdict.reason,
                    "policies": list(verdict.policies), "lat": now.lat, "lon": now.lon, "alt": now.altitude_m,
                },
            )  # fmt: skip
        if not verdict.permits:
            raise refused(verdict)
        return verdict


def known(error: Exception) -> Refused | None:
    """Failures of the album as refusals."""
    if isinstance(error, AlbumFull):
        return Refused(grpc.StatusCode.RESOURCE_EXHAUSTED, Verdict("deny", None, "AlbumFull", str(error)))
    if isinstance(error, NoSuchImage):
        return Refused(grpc.StatusCode.NOT_FOUND, Verdict("deny", None, "NoSuchImage", str(error)))
    if isinstance(error, OSError):
        reason = f"the picture cannot be stored: {error.strerror or error}"
        return Refused(grpc.StatusCode.RESOURCE_EXHAUSTED, Verdict("deny", None, "StorageFailed", reason))
    return None
