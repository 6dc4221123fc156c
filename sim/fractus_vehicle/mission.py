"""Item lists that clients upload and download: mission, fence and rally points, by the MAVLink mission protocol."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from fractus_vehicle.earth import valid_coordinates
from fractus_vehicle.mav import GLOBAL_FRAMES, Command, Frame, MissionKind, MissionResult

if TYPE_CHECKING:
    from fractus_mavlink import Message

    from fractus_vehicle.channel import Channel

MAX_ITEMS = 724
UPLOAD_TIMEOUT_S = 8.0
RETRY_S = 1.0

# Farther up no place lies.
MAX_ALTITUDE_M = 83_000.0
# Commands whose fourth parameter, a heading, may be NaN; no other parameter may.
NAN_HEADINGS = frozenset({Command.NAV_WAYPOINT, Command.NAV_LAND, Command.NAV_TAKEOFF})
# What is refused until an upload of the same list has ended.
NOT_WHILE_UPLOADED = {
    "MISSION_REQUEST_LIST": MissionResult.DENIED,
    "MISSION_REQUEST": MissionResult.DENIED,
    "MISSION_REQUEST_INT": MissionResult.DENIED,
    "MISSION_CLEAR_ALL": MissionResult.ERROR,
}
FENCE_COMMANDS = frozenset(range(5000, 5005))
SUPPORTED = frozenset(
    {
        Command.NAV_WAYPOINT,
        Command.NAV_SPLINE_WAYPOINT,
        Command.NAV_LOITER_UNLIM,
        Command.NAV_LOITER_TURNS,
        Command.NAV_LOITER_TIME,
        Command.NAV_RETURN_TO_LAUNCH,
        Command.NAV_LAND,
        Command.NAV_TAKEOFF,
        Command.NAV_DELAY,
        Command.CONDITION_DELAY,
        Command.CONDITION_DISTANCE,
        Command.CONDITION_YAW,
        Command.DO_JUMP,
        Command.DO_CHANGE_SPEED,
        Command.DO_SET_HOME,
        Command.DO_SET_RELAY,
        Command.DO_SET_SERVO,
        Command.DO_LAND_START,
        Command.DO_SET_ROI_LOCATION,
        Command.DO_SET_ROI_NONE,
        Command.DO_SET_ROI,
        Command.DO_DIGICAM_CONTROL,
        Command.DO_MOUNT_CONTROL,
        Command.DO_SET_CAM_TRIGG_DIST,
        Command.DO_FENCE_ENABLE,
        Command.DO_PAUSE_CONTINUE,
        Command.JUMP_TAG,
        Command.DO_JUMP_TAG,
        531,
        532,
        1000,
        2000,
        2001,
        2500,
        2501,
    }
)


@dataclass(frozen=True, slots=True)
class Item:
    """One item of a list; x and y are degrees times 1e7."""

    command: int
    frame: int = Frame.GLOBAL_RELATIVE_ALT
    param1: float = 0.0
    param2: float = 0.0
    param3: float = 0.0
    param4: float = 0.0
    x: int = 0
    y: int = 0
    z: float = 0.0
    autocontinue: int = 1

    @property
    def has_place(self) -> bool:
        """Whether the item names a position (0, 0 means: here)."""
        return self.x != 0 or self.y != 0

    @property
    def navigates(self) -> bool:
        """Whether this is a NAV command: one with a position, which a mission waits for."""
        return 0 < self.command < 95 or self.command >= Command.NAV_FENCE_RETURN_POINT


@dataclass(slots=True)
class Upload:
    """A transfer toward the vehicle."""

    channel: Channel
    sysid: int
    compid: int
    kind: MissionKind
    next: int
    last: int
    items: list[Item]
    partial: bool
    heard_s: float
    asked_s: float


@dataclass(slots=True)
class ItemStore:
    """One list and what happens when it is replaced; `accept` may refuse it."""

    kind: MissionKind
    items: list[Item] = field(default_factory=list)
    accept: Callable[[list[Item]], MissionResult] = lambda _items: MissionResult.ACCEPTED
    home: Item | None = None


def _finite(value: float) -> float:
    return value if math.isfinite(value) else 0.0


def item_from(message: Message) -> Item:
    """Read MISSION_ITEM_INT, or MISSION_ITEM with its degrees in floats."""
    frame = message.integer("frame")
    x, y = message.real("x"), message.real("y")
    scale = 1e7 if frame in GLOBAL_FRAMES else 1e4
    if message.name == "MISSION_ITEM":
        x, y = (x * scale if math.isfinite(x) else 0.0), (y * scale if math.isfinite(y) else 0.0)
    aliases = {Frame.GLOBAL_INT: 0, Frame.GLOBAL_RELATIVE_ALT_INT: 3, Frame.GLOBAL_TERRAIN_ALT_INT: 10}
    command, z = message.integer("command"), message.real("z")
    return Item(
        command=command,
        frame=int(aliases.get(Frame(frame), frame)) if frame in set(Frame) else frame,
        param1=_finite(message.real("param1")),
        param2=_finite(message.real("param2")),
        param3=_finite(message.real("param3")),
        param4=_finite(message.real("param4")),
        x=int(max(-2147483648, min(2147483647, round(x)))),
        y=int(max(-2147483648, min(2147483647, round(y)))),
        z=z if Item(command).navigates else _finite(z),
        autocontinue=message.integer("autocontinue"),
    )


def judge(item: Item, kind: MissionKind) -> MissionResult:
    """Whether an item may be stored in a list of that kind."""
    if kind is MissionKind.FENCE:
        known = item.command in FENCE_COMMANDS
    elif kind is MissionKind.RALLY:
        known = item.command == Command.NAV_RALLY_POINT
    else:
        known = item.command in SUPPORTED
    if not known:
        return MissionResult.UNSUPPORTED
    if item.frame not in GLOBAL_FRAMES and item.frame != Frame.MISSION and item.has_place:
        return MissionResult.UNSUPPORTED_FRAME
    if item.navigates and not valid_coordinates(item.x, item.y):
        return MissionResult.INVALID_PARAM5_X if abs(item.x) > 900_000_000 else MissionResult.INVALID_PARAM6_Y
    if item.navigates and not abs(item.z) < MAX_ALTITUDE_M:
        return MissionResult.INVALID_PARAM7
    return MissionResult.ACCEPTED


def judge_numbers(message: Message) -> MissionResult:
    """Whether the parameters of a mission's item are numbers, as ArduPilot wants them."""
    may_be_nan = message.integer("command") in NAN_HEADINGS
    for at in range(1, 5):
        value = message.real(f"param{at}")
        if not math.isfinite(value) and not (at == 4 and may_be_nan and math.isnan(value)):
            return MissionResult(MissionResult.INVALID_PARAM1 + at - 1)
    return MissionResult.ACCEPTED


class Transfers:
    """The vehicle's side of the mission protocol, for all kinds and links (one upload at a time, as ArduPilot)."""

    def __init__(self, stores: dict[MissionKind, ItemStore]) -> None:
        self.stores = stores
        self.upload: Upload | None = None
        self.now_s = 0.0

    def _ack(self, channel: Channel, message: Message, kind: int, result: MissionResult) -> None:
        channel.send(
            "MISSION_ACK",
            {
                "target_system": message.sysid,
                "target_component": message.compid,
                "type": int(result),
                "mission_type": kind,
            },
        )

    def handle(self, channel: Channel, message: Message, now_s: float) -> None:
        """Answer one message of the protocol."""
        self.now_s = now_s
        kind_number = message.integer("mission_type") if message.has("mission_type") else 0
        if kind_number == 255 and message.name == "MISSION_CLEAR_ALL":
            for store in self.stores.values():
                self._replace(store, [])
            self._ack(channel, message, kind_number, MissionResult.ACCEPTED)
        elif kind_number not in set(MissionKind):
            self._ack(channel, message, kind_number, MissionResult.UNSUPPORTED)
        elif self.upload is not None and self.upload.kind == kind_number and message.name in NOT_WHILE_UPLOADED:
            self._ack(channel, message, kind_number, NOT_WHILE_UPLOADED[message.name])
        else:
            self._handle(channel, message, self.stores[MissionKind(kind_number)])

    def _handle(self, channel: Channel, message: Message, store: ItemStore) -> None:
        kind = store.kind
        match message.name:
            case "MISSION_COUNT":
                self._begin(channel, message, store, range(message.integer("count")))
            case "MISSION_WRITE_PARTIAL_LIST":
                start, end = message.integer("start_index"), message.integer("end_index")
                # One item more than there are may be written: it is appended.
                if 0 <= start <= end <= len(store.items):
                    self._begin(channel, message, store, range(start, end + 1))
                else:
                    self._ack(channel, message, kind, MissionResult.ERROR)
            case "MISSION_ITEM" | "MISSION_ITEM_INT":
                self._take(channel, message, store)
            case "MISSION_REQUEST_LIST":
                channel.send("MISSION_COUNT", self._address(message, kind) | {"count": len(store.items)})
            case "MISSION_REQUEST_PARTIAL_LIST":
                self._ack(channel, message, kind, MissionResult.UNSUPPORTED)
            case "MISSION_REQUEST" | "MISSION_REQUEST_INT":
                self._give(channel, message, store)
            case "MISSION_CLEAR_ALL":
                self._ack(channel, message, kind, self._replace(store, []))
            case "MISSION_ACK" if self._is_uploader(channel, message):
                self.upload = None
            case _:
                pass

    @staticmethod
    def _address(message: Message, kind: MissionKind) -> dict[str, int | float | bytes | tuple[int | float, ...]]:
        return {"target_system": message.sysid, "target_component": message.compid, "mission_type": int(kind)}

    def _is_uploader(self, channel: Channel, message: Message) -> bool:
        up = self.upload
        return up is not None and up.channel is channel and (up.sysid, up.compid) == (message.sysid, message.compid)

    def _begin(self, channel: Channel, message: Message, store: ItemStore, wanted: range) -> None:
        """Begin to ask for the items of `wanted`; all of a new list, or a part of the stored one."""
        if self.upload is not None and not self._is_uploader(channel, message):
            self._ack(channel, message, store.kind, MissionResult.DENIED)
        elif wanted.stop > MAX_ITEMS:
            self._ack(channel, message, store.kind, MissionResult.NO_SPACE)
        elif not wanted:
            self._ack(channel, message, store.kind, self._replace(store, []))
        else:
            partial = message.name == "MISSION_WRITE_PARTIAL_LIST"
            self.upload = Upload(
                channel=channel,
                sysid=message.sysid,
                compid=message.compid,
                kind=store.kind,
                next=wanted.start,
                last=wanted.stop - 1,
                items=list(store.items) if partial else [],
                partial=partial,
                heard_s=self.now_s,
                asked_s=self.now_s,
            )
            self._ask(self.upload)

    def _ask(self, up: Upload) -> None:
        up.asked_s = self.now_s
        up.channel.send(
            "MISSION_REQUEST",
            {
                "target_system": up.sysid,
                "target_component": up.compid,
                "seq": up.next,
                "mission_type": int(up.kind),
            },
        )

    def _take(self, channel: Channel, message: Message, store: ItemStore) -> None:
        up = self.upload
        if up is None or not self._is_uploader(channel, message) or up.kind is not store.kind:
            self._ack(channel, message, store.kind, MissionResult.ERROR)
            return
        seq = message.integer("seq")
        if seq != up.next:
            if seq > up.next:
                self._ack(channel, message, store.kind, MissionResult.INVALID_SEQUENCE)
            return
        item = item_from(message)
        verdict = self._judge(message, item, store, up)
        if verdict is not MissionResult.ACCEPTED:
            self.upload = None
            self._ack(channel, message, store.kind, verdict)
            return
        up.items[seq : seq + 1] = [item]
        up.next += 1
        up.heard_s = self.now_s
        if up.next <= up.last:
            self._ask(up)
            return
        self.upload = None
        self._ack(channel, message, store.kind, self._replace(store, up.items))

    @staticmethod
    def _judge(message: Message, item: Item, store: ItemStore, up: Upload) -> MissionResult:
        if store.kind is MissionKind.MISSION:
            if message.integer("seq") == 0:
                return MissionResult.ACCEPTED
            verdict = judge_numbers(message)
            if verdict is not MissionResult.ACCEPTED:
                return verdict
            if item.command == Command.DO_JUMP and not 0 < int(item.param1) < max(len(up.items), up.last + 1):
                return MissionResult.ERROR
        return judge(item, store.kind)

    @staticmethod
    def _replace(store: ItemStore, items: list[Item]) -> MissionResult:
        result = store.accept(items)
        if result is MissionResult.ACCEPTED:
            store.items = items
        return result

    def _give(self, channel: Channel, message: Message, store: ItemStore) -> None:
        seq = message.integer("seq")
        # Item 0 of a mission is home, and may be read even when there is no mission.
        homes = [store.home] if store.home is not None and not store.items else store.items
        if not 0 <= seq < len(homes):
            self._ack(channel, message, store.kind, MissionResult.INVALID_SEQUENCE)
            return
        item = homes[seq]
        integers = message.name == "MISSION_REQUEST_INT"
        channel.send(
            "MISSION_ITEM_INT" if integers else "MISSION_ITEM",
            self._address(message, store.kind)
            | {
                "seq": seq,
                "frame": item.frame,
                "command": item.command,
                "current": 0,
                "autocontinue": item.autocontinue,
                "param1": item.param1,
                "param2": item.param2,
                "param3": item.param3,
                "param4": item.param4,
                "x": item.x if integers else item.x * 1e-7,
                "y": item.y if integers else item.y * 1e-7,
                "z": item.z,
            },
        )

    def step(self, now_s: float) -> Upload | None:
        """Repeat an unanswered request; return an upload that was given up."""
        self.now_s = now_s
        up = self.upload
        if up is None:
            return None
        if now_s - up.heard_s > UPLOAD_TIMEOUT_S:
            self.upload = None
            up.channel.send(
                "MISSION_ACK",
                {
                    "target_system": up.sysid,
                    "target_component": up.compid,
                    "type": int(MissionResult.CANCELLED),
                    "mission_type": int(up.kind),
                },
            )
            return up
        if now_s - up.asked_s > RETRY_S:
            self._ask(up)
        return None


class Mission:
    """The stored mission and where its execution stands; item 0 is home, as in ArduPilot."""

    def __init__(self) -> None:
        self.store = ItemStore(MissionKind.MISSION, home=Item(Command.NAV_WAYPOINT, frame=Frame.GLOBAL))
        self.current = 0
        self.complete = False
        self._jumps: dict[int, int] = {}

    @property
    def items(self) -> list[Item]:
        """The stored items."""
        return self.store.items

    def rewind(self) -> None:
        """Start from the first item after home."""
        self.current = 0
        self.complete = False
        self._jumps.clear()

    def peek_after(self, index: int) -> int | None:
        """The next item that navigates, without counting jumps as done; None where jumps only lead in a circle."""
        jumps = dict(self._jumps)
        at = self.next_after(index)
        for _ in self.items:
            if at is None or self.items[at].navigates:
                break
            at = self.next_after(at)
        else:
            at = None
        self._jumps = jumps
        return at

    def next_after(self, index: int) -> int | None:
        """The item to execute after `index`, jumps followed; None at the end."""
        at = index + 1
        for _ in range(100):
            if at >= len(self.items):
                return None
            item = self.items[at]
            if item.command not in (Command.DO_JUMP, Command.DO_JUMP_TAG):
                return at
            target = self.tagged(int(item.param1)) if item.command == Command.DO_JUMP_TAG else int(item.param1)
            if target is None or not 0 < target < len(self.items):
                return None
            done = self._jumps.get(at, 0)
            if item.param2 < 0 or done < int(item.param2):
                self._jumps[at] = done + 1
                at = target
            else:
                at += 1
        return None

    def tagged(self, tag: int) -> int | None:
        """The first item that carries a tag."""
        marks = (at for at, item in enumerate(self.items) if item.command == Command.JUMP_TAG and item.param1 == tag)
        return next(marks, None)

    def with_home(self, home: Item) -> None:
        """Keep item 0 equal to home."""
        self.store.home = replace(home, frame=Frame.GLOBAL, command=Command.NAV_WAYPOINT)
        if self.items:
            self.items[0] = self.store.home
