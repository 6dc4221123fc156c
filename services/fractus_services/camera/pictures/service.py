"""The camera service: judge, take, filter, keep, hand out."""

from __future__ import annotations

import asyncio
import itertools
import logging
import math
import time
from collections.abc import Callable, Coroutine
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, Protocol, TypeVar

from fractus_core.policy.engine import judge
from fractus_core.policy.footprint import seen_from
from fractus_core.policy.privacy import compose, judge_privacy, remaining
from fractus_core.policy.values import Call, CaptureArgs, Filter, Moment, Situation, Verdict, earliest

from fractus_services.audit import AuditLog
from fractus_services.camera.album.album import Album, AlbumFull, NoSuchImage
from fractus_services.camera.album.shots import Pose, Shot, facts
from fractus_services.camera.capture.driver import CameraFailed, Wanted
from fractus_services.camera.capture.shutter import Shutter
from fractus_services.camera.imaging.faces import BadModel, Detector, smallest_face_px
from fractus_services.camera.imaging.filters import MOTION_PX
from fractus_services.camera.imaging.metadata import tagged
from fractus_services.camera.imaging.pipeline import NotHidden, Recipe, developed, is_upright, recipe
from fractus_services.camera.imaging.pixels import NotAPicture, Pixels, cropped, decoded, encoded, fitted, source_size
from fractus_services.camera.pictures.fair_queue import FairQueue, QueueFull
from fractus_services.errors import (
    InvalidRequest,
    NotFound,
    PreconditionFailed,
    Refused,
    ResourceExhausted,
    Unavailable,
    denied,
)
from fractus_services.grants import ActiveGrant

log = logging.getLogger(__name__)

MIN_PX, MAX_PX = 16, 8192
MOST_PIXELS = 8_300_000
"""Of a camera that has fewer itself: so many may be asked for."""
MAX_WAITING = 8
"""So many pictures may be under way or wait for the shutter, of one component and of all."""
MAX_OF_ONE = 4
MAX_DEVELOPING = 8
APART_S = 0.25
"""Between the pictures that tell what moves."""

_T = TypeVar("_T")


def owner_of(grant: ActiveGrant) -> str:
    """Whose pictures they are: an instance of this very application, not of a later one of the same name."""
    return f"{grant.spec.application.uid}/{grant.identity}"


class Whereabouts(Protocol):
    """Tells where the camera is."""

    def situation(self, time_s: float) -> Situation:
        """The present state."""

    def way(self, begun_s: float, time_s: float) -> tuple[Situation, ...]:
        """All states since a moment of monotonic time, the one then first and the present one last."""

    async def run(self) -> None:
        """Keep it present."""


@dataclass(frozen=True, slots=True)
class Body:
    """The camera's own properties.

    Attributes:
        resolution: its width and height.
        model: make and model; may be empty.
        sensor: what it sees.
        fixed: it does not move.
    """

    resolution: tuple[int, int] = (1280, 720)
    model: str = ""
    sensor: Literal["RGB", "IR"] = "RGB"
    fixed: bool = False


@dataclass(frozen=True, slots=True)
class _Exposed:
    """What came out of an exposure, judged.

    Attributes:
        name: of the picture.
        grant: by which grant it was judged.
        verdict: what became of it.
        after: where the camera was at the end, and on which way it got there.
        pictures: what the camera gave.
        whole_width: of the whole view, in pixels that the camera gave.
    """

    name: str
    grant: ActiveGrant
    verdict: Verdict
    after: Situation
    pictures: list[Pixels]
    whole_width: int


class CameraService:
    """Table 8.2 of the thesis, for callers whose grant is known.

    A picture is filtered before it is kept: without filters it is never on disk where a policy asks for them.

    Args:
        whereabouts: where the camera is.
        shutter: the camera.
        body: its properties.
        detector: finds faces.
        album: where pictures are kept.
        audit: where decisions are written.
        clock: Unix time.
    """

    def __init__(
        self,
        whereabouts: Whereabouts,
        shutter: Shutter,
        body: Body,
        *,
        detector: Detector,
        album: Album,
        audit: AuditLog,
        clock: Callable[[], float],
    ) -> None:
        self._whereabouts = whereabouts
        self._shutter = shutter
        self._body = body
        self._detector = detector
        self._album = album
        self._audit = audit
        self._clock = clock
        self._numbers = itertools.count()
        self._exposing = FairQueue(MAX_OF_ONE, MAX_WAITING)
        self._developing = FairQueue(MAX_OF_ONE, MAX_DEVELOPING)
        self._tasks: set[asyncio.Task[Any]] = set()

    async def capture(
        self, grant: ActiveGrant, args: CaptureArgs, present: Callable[[], ActiveGrant] | None = None
    ) -> tuple[Verdict, Shot]:
        """Take a picture and keep it.

        It is judged when the shutter is free, and again when the picture is taken, together with all that the camera saw
        on the way: the drone moves meanwhile, and grants change.

        Args:
            grant: the caller's grant.
            args: pixels; 0 means the camera's own.
            present: the caller's grant at a later moment; raises when there is none any more.
        """
        width, height = args.width or self._body.resolution[0], args.height or self._body.resolution[1]
        self._check_size(width, height)
        # A caller that hangs up does not free the shutter before the picture is done.
        return await self._finished(
            self._taken(owner_of(grant), replace(args, width=width, height=height), present or (lambda: grant))
        )

    def _check_size(self, width: int, height: int) -> None:
        """Refuse sizes for which the camera's picture, before it is cropped, would take too much memory."""
        native = self._body.resolution
        if not (MIN_PX <= width <= MAX_PX and MIN_PX <= height <= MAX_PX):
            reason = (
                f"{width}x{height} pixels is not between {MIN_PX}x{MIN_PX} and {MAX_PX}x{MAX_PX}; ask for another size"
            )
            raise InvalidRequest("InvalidArgument", reason)
        whole = source_size(width, height, native)
        most = max(native[0] * native[1], MOST_PIXELS)
        if whole[0] * whole[1] > most * 1.01:
            reason = (
                f"{width}x{height} pixels would be cut from {whole[0]}x{whole[1]}, more than {most / 1e6:.1f} megapixels;"
                f" ask for less, or for the proportions of {native[0]}x{native[1]}"
            )
            raise InvalidRequest("InvalidArgument", reason)

    async def _finished(self, work: Coroutine[Any, Any, _T]) -> _T:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._done)
        return await asyncio.shield(task)

    def _done(self, task: asyncio.Task[Any]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and task.exception() is not None:
            log.debug("no picture: %s", task.exception())

    async def _taken(self, owner: str, args: CaptureArgs, present: Callable[[], ActiveGrant]) -> tuple[Verdict, Shot]:
        call = Call("CaptureImage", args)
        expected = judge_privacy(self._whereabouts.situation(self._clock()), present().compiled)
        if not expected.filters:
            exposed = await self._exposed(owner, call, present)
            if not exposed.verdict.filters:
                return await self._kept(call, exposed)
            async with self._developing.turn(owner):
                return await self._kept(call, exposed)
        # The picture must not wait in memory for its filters, so the turn for these comes first.
        async with self._developing.turn(owner):
            return await self._kept(call, await self._exposed(owner, call, present))

    async def _exposed(self, owner: str, call: Call, present: Callable[[], ActiveGrant]) -> _Exposed:
        args = call.args
        if not isinstance(args, CaptureArgs):
            raise TypeError("CaptureImage without its arguments")
        async with self._exposing.turn(owner):
            # A camera may give a picture that it had before it was asked.
            begun_s = time.monotonic() - self._shutter.latency_s
            grant, now = present(), self._whereabouts.situation(self._clock())
            verdict = self._allow(call, grant, now)
            problem = await asyncio.to_thread(self._album.room, owner)
            if problem:
                raise AlbumFull(problem)
            width, height = source_size(args.width, args.height, self._body.resolution)
            wanted = Wanted(width, height, self._body.resolution, self._body.sensor, now, grant.spec.node)
            three = any(one.action == "removeBackground" for one in verdict.filters)
            pictures = await self._shutter.expose(wanted, 3 if three else 1, APART_S)
            if now.lens is not None:
                # It is judged by a view in these proportions, whatever the camera gave.
                pictures = [cropped(one, *self._body.resolution) for one in pictures]
            way, grant = self._whereabouts.way(begun_s, self._clock()), present()
            after = replace(way[-1], way=way)
            # A zone that was active when the picture was begun counts as well as one that is now.
            moments = [after, replace(after, time_s=now.time_s)]
            verdicts = [verdict, *(self._allow(call, grant, moment, always=False) for moment in moments)]
            first = replace(after, time_s=Moment(now.time_s, earliest(now.time_s) - self._shutter.latency_s))
            verdicts.append(self._checked(call, grant, judge_privacy(first, grant.compiled), first))
            # Enlarging a picture does not make its faces easier to find.
            shown = min(width, pictures[len(pictures) // 2].shape[1])
            moment = datetime.fromtimestamp(after.time_s, UTC).strftime("%Y%m%d%H%M%S%f")[:17]
            name = f"{moment}-{next(self._numbers) % 10000:04d}.jpg"
            return _Exposed(name, grant, _together(verdicts), after, pictures, shown)

    async def _kept(self, call: Call, exposed: _Exposed) -> tuple[Verdict, Shot]:
        args, grant, verdict = call.args, exposed.grant, exposed.verdict
        if not isinstance(args, CaptureArgs):
            raise TypeError("CaptureImage without its arguments")
        face_px = self._face_px(exposed)
        chosen = self._recipe(call, grant, verdict, face_px, exposed.after)
        poses = tuple(Pose.of(one) for one in exposed.after.way)
        moment_s = float(exposed.after.time_s)
        upright = is_upright(poses)
        whole_width = source_size(args.width, args.height, self._body.resolution)[0]

        def work() -> bytes:
            small = min(MOTION_PX / args.width, 1.0)
            sizes = [(max(round(args.width * small), 1), max(round(args.height * small), 1))] * len(exposed.pictures)
            sizes[len(sizes) // 2] = (args.width, args.height)
            pictures = [fitted(one, *size) for one, size in zip(exposed.pictures, sizes, strict=True)]
            exposed.pictures.clear()
            picture = developed(pictures, chosen, self._detector, face_px, upright=upright, fixed=self._body.fixed)
            data = encoded(picture)
            if verdict.filters:
                return data
            return tagged(data, facts(poses[-1], moment_s, self._body.model, whole_width))

        data = await asyncio.to_thread(work)
        shot = Shot(exposed.name, moment_s, args.width, args.height, len(data), poses, face_px, chosen.filters)
        await asyncio.to_thread(self._album.add, owner_of(grant), shot, data)
        return _noted(verdict, chosen), shot

    def _face_px(self, exposed: _Exposed) -> float:
        """Width of the smallest face that the picture may show; 0 when nobody knows."""
        view = seen_from(exposed.after.way, exposed.grant.compiled.frame)
        farthest_m = view.farthest_m if view is not None else math.inf
        return smallest_face_px(exposed.after.lens, farthest_m, exposed.whole_width)

    def _recipe(self, call: Call, grant: ActiveGrant, verdict: Verdict, face_px: float, now: Situation) -> Recipe:
        try:
            return recipe(verdict.filters, face_px, self._detector)
        except NotHidden as error:
            denied = Verdict("deny", None, "FacesNotFound", f"{verdict.reason}; {error}", verdict.policies)
            self._checked(call, grant, denied, now)
            raise AssertionError("a denial always raises") from error

    async def retrieve(
        self, grant: ActiveGrant, name: str, present: Callable[[], ActiveGrant] | None = None
    ) -> tuple[Verdict, Shot, bytes | Path]:
        """A picture; policies hold for where it was taken and for where the camera is now, whichever asks for more.

        It is judged again when its filters are applied, as other pictures may come first.

        Args:
            grant: the caller's grant.
            name: of the picture.
            present: as for `capture`.
        """
        call, now = Call("RetrieveImage"), self._whereabouts.situation(self._clock())
        verdict = self._allow(call, grant, now)
        owner = owner_of(grant)
        shot = await asyncio.to_thread(self._album.find, owner, name)
        taken = _taken_at(shot, now)
        verdict = _together([verdict, self._checked(call, grant, judge_privacy(taken, grant.compiled), taken)])
        todo = remaining(verdict.filters, shot.filters)
        path = self._album.path(owner, name)
        if not todo:
            return verdict, shot, path
        # Nobody knows which faces are still found in a picture that was filtered before.
        face_px = 0.0 if shot.filters else shot.face_px
        chosen = self._recipe(call, grant, replace(verdict, filters=todo), face_px, taken)
        data = await self._finished(self._redeveloped(owner, path, chosen, replace(shot, face_px=face_px)))
        self._check_again(call, present() if present else grant, shot, (*shot.filters, *chosen.filters))
        return (
            _noted(verdict, chosen),
            replace(shot, size_bytes=len(data), filters=(*shot.filters, *chosen.filters)),
            data,
        )

    def _check_again(self, call: Call, grant: ActiveGrant, shot: Shot, done: tuple[Filter, ...]) -> None:
        """Refuse a kept picture that by now needs more filters than it got."""
        now = self._whereabouts.situation(self._clock())
        verdict, taken = self._allow(call, grant, now, always=False), _taken_at(shot, now)
        verdict = _together([verdict, self._checked(call, grant, judge_privacy(taken, grant.compiled), taken)])
        if remaining(verdict.filters, done):
            reason = f"{verdict.reason}, which it did not when this picture was asked for; ask again"
            self._checked(call, grant, Verdict("deny", None, "PrivacyZone", reason, verdict.policies), now)

    async def _redeveloped(self, owner: str, path: Path, chosen: Recipe, shot: Shot) -> bytes:
        def work() -> bytes:
            picture = decoded(path.read_bytes())
            return encoded(developed([picture], chosen, self._detector, shot.face_px, upright=is_upright(shot.poses)))

        async with self._developing.turn(owner):
            return await asyncio.to_thread(work)

    async def list(self, grant: ActiveGrant) -> tuple[Verdict, tuple[Shot, ...]]:
        """The pictures of the caller."""
        verdict = self._allow(Call("ListImages"), grant, self._whereabouts.situation(self._clock()))
        return verdict, await asyncio.to_thread(self._album.list, owner_of(grant))

    async def delete(self, grant: ActiveGrant, name: str) -> Verdict:
        """Remove a picture of the caller."""
        verdict = self._allow(Call("DeleteImage"), grant, self._whereabouts.situation(self._clock()))
        await asyncio.to_thread(self._album.delete, owner_of(grant), name)
        return verdict

    def _allow(self, call: Call, grant: ActiveGrant, now: Situation, always: bool = True) -> Verdict:
        try:
            verdict = judge(call, now, grant.compiled)
        except Exception:
            log.exception("the policy engine failed on %s; refused", call.method)
            verdict = Verdict("deny", None, "InternalError", f"the policy engine failed on {call.method}")
        return self._checked(call, grant, verdict, now, always)

    def _checked(
        self, call: Call, grant: ActiveGrant, verdict: Verdict, now: Situation, always: bool = False
    ) -> Verdict:
        """Refuse what is denied; write down what is decided."""
        if always or not verdict.permits:
            self._audit.append(
                "call",
                {
                    "caller": grant.identity, "method": call.method, "args": asdict(call.args) if call.args else {},
                    "action": verdict.action, "code": verdict.code, "reason": verdict.reason,
                    "policies": list(verdict.policies), "filters": [one.action for one in verdict.filters],
                    "lat": now.lat, "lon": now.lon, "alt": now.altitude_m,
                },
            )  # fmt: skip
        if not verdict.permits:
            raise denied(verdict)
        return verdict


def _taken_at(shot: Shot, now: Situation) -> Situation:
    """Where a picture was taken and on which way, at the time of another situation."""
    way = tuple(pose.at(now) for pose in shot.poses)
    return replace(way[-1], way=way)


def _together(verdicts: list[Verdict]) -> Verdict:
    """What several verdicts that permit a picture ask for together."""
    filters: tuple[Filter, ...] = compose(one for verdict in verdicts for one in verdict.filters)
    if not filters:
        return verdicts[0]
    names = tuple(dict.fromkeys(name for verdict in verdicts for name in verdict.policies))
    reason = f"policy {names[0]} asks for {', '.join(one.action for one in filters)}" if names else ""
    return replace(verdicts[0], action="correct", code="PrivacyFilter", reason=reason, policies=names, filters=filters)


def _noted(verdict: Verdict, chosen: Recipe) -> Verdict:
    return replace(verdict, reason=f"{verdict.reason}; {chosen.note}") if chosen.note else verdict


_KNOWN: dict[type[Exception], tuple[type[Refused], str]] = {
    AlbumFull: (ResourceExhausted, "AlbumFull"),
    QueueFull: (ResourceExhausted, "ShutterBusy"),
    NoSuchImage: (NotFound, "NoSuchImage"),
    CameraFailed: (Unavailable, "CameraFailed"),
    BadModel: (PreconditionFailed, "FilterUnavailable"),
    NotAPicture: (PreconditionFailed, "FilterUnavailable"),
}


def known(error: Exception) -> Refused | None:
    """Failures of album and camera as refusals."""
    for kind, (refusal, code) in _KNOWN.items():
        if isinstance(error, kind):
            return refusal(code, str(error))
    if isinstance(error, OSError):
        reason = f"the picture cannot be stored: {error.strerror or error}; delete pictures, or make room on the node"
        return ResourceExhausted("StorageFailed", reason)
    return None
