"""Vehicle side of the MAVLink mission protocol: upload and download of lists."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from fractus_runtime.mavlink_codec import Message, Value
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.mavlink_server.channel import Channel
from fractus_services.mavlink_server.mission_items import Item, ItemStore, item_from, validate_item, validate_parameters

# Capacity of the autopilot's storage.
MAX_ITEMS = {
    mavlink.MAV_MISSION_TYPE_MISSION: 650,
    mavlink.MAV_MISSION_TYPE_FENCE: 70,
    mavlink.MAV_MISSION_TYPE_RALLY: 46,
}
# Lists whose items are stored one by one as they arrive. A fence is stored as a whole, when all of its items have arrived.
STORED_BY_ITEM = frozenset({mavlink.MAV_MISSION_TYPE_MISSION, mavlink.MAV_MISSION_TYPE_RALLY})
UPLOAD_TIMEOUT_S = 8.0
RETRY_S = 1.0
# STATUSTEXT sent when a list is stored.
RECEIVED_TEXTS = {
    mavlink.MAV_MISSION_TYPE_MISSION: (mavlink.MAV_SEVERITY_INFO, "Flight plan received"),
    mavlink.MAV_MISSION_TYPE_FENCE: (mavlink.MAV_SEVERITY_DEBUG, "Fence Indexed OK"),
}
# Names of the lists in STATUSTEXTs.
TITLES = {
    mavlink.MAV_MISSION_TYPE_MISSION: "Mission",
    mavlink.MAV_MISSION_TYPE_FENCE: "Fence",
    mavlink.MAV_MISSION_TYPE_RALLY: "Rally",
}
# Requests that are refused during an upload of the same list. The older MISSION_REQUEST is not refused.
REFUSED_DURING_UPLOAD = {
    "MISSION_REQUEST_LIST": mavlink.MAV_MISSION_DENIED,
    "MISSION_REQUEST_INT": mavlink.MAV_MISSION_DENIED,
    "MISSION_CLEAR_ALL": mavlink.MAV_MISSION_ERROR,
}


@dataclass(slots=True)
class Upload:
    """An upload in progress."""

    channel: Channel
    sysid: int
    compid: int
    kind: int
    next: int
    last: int
    items: list[Item]
    received_s: float
    requested_s: float
    old_format: bool = False
    complete: bool = False  # all items have arrived, and the vehicle has not accepted or refused the list yet

    def is_from(self, message: Message) -> bool:
        """Return True if the message comes from the uploading peer."""
        return (self.sysid, self.compid) == (message.sysid, message.compid)


def _address(peer: Message | Upload, kind: int) -> dict[str, Value]:
    return {"target_system": peer.sysid, "target_component": peer.compid, "mission_type": int(kind)}


class Transfers:
    """Vehicle side of the mission protocol for all list kinds and links. Each kind allows one upload at a time.

    Args:
        stores: Lists by MAV_MISSION_TYPE.
        replace_items: Stores a complete list. Returns the MAV_MISSION_RESULT, or None if `conclude` is called later. Empty
            lists are stored at once.
        clear: Clears a list. Returns the MAV_MISSION_RESULT.
        send_text: Sends a STATUSTEXT with a severity.
        judge_item: Returns the MAV_MISSION_RESULT of one item of a list, with its number.
        stored_by_item: Lists that are replaced item by item. Other lists are replaced when all items have arrived.
    """

    def __init__(
        self,
        stores: Mapping[int, ItemStore],
        replace_items: Callable[[ItemStore, list[Item]], int | None],
        clear: Callable[[ItemStore], int],
        send_text: Callable[[int, str], None],
        *,
        judge_item: Callable[[Item, int, int], int] = lambda item, kind, _number: validate_item(item, kind),
        stored_by_item: frozenset[int] = STORED_BY_ITEM,
    ) -> None:
        self._judge_item = judge_item
        self._stored_by_item = stored_by_item
        self._stores = stores
        self._replace = replace_items
        self._clear = clear
        self._send_text = send_text
        self.uploads: dict[int, Upload] = {}
        self.now_s = 0.0

    @staticmethod
    def _ack(channel: Channel, peer: Message | Upload, kind: int, result: int) -> None:
        channel.send("MISSION_ACK", _address(peer, kind) | {"type": int(result)})

    def handle(self, channel: Channel, message: Message, now_s: float) -> None:
        """Handle one message of the protocol."""
        self.now_s = now_s
        kind_number = message.integer("mission_type") if message.has("mission_type") else 0
        if kind_number not in self._stores:
            self._ack(channel, message, kind_number, mavlink.MAV_MISSION_UNSUPPORTED)
        elif kind_number in self.uploads and message.name in REFUSED_DURING_UPLOAD:
            self._ack(channel, message, kind_number, REFUSED_DURING_UPLOAD[message.name])
        else:
            self._handle(channel, message, self._stores[kind_number])

    def detach(self, channel: Channel) -> None:
        """Cancel the uploads of a link that closes."""
        self.uploads = {kind: up for kind, up in self.uploads.items() if up.channel is not channel}

    def _handle(self, channel: Channel, message: Message, store: ItemStore) -> None:
        kind = store.kind
        match message.name:
            case "MISSION_COUNT":
                self._begin(channel, message, store, range(message.integer("count")))
            case "MISSION_WRITE_PARTIAL_LIST":
                start = message.integer("start_index")
                end = message.integer("end_index")
                # A partial write may also append one item.
                if 0 <= start <= end <= len(store.items):
                    self._begin(channel, message, store, range(start, end + 1))
                else:
                    self._send_text(mavlink.MAV_SEVERITY_WARNING, "Flight plan update rejected")
                    self._ack(channel, message, kind, mavlink.MAV_MISSION_ERROR)
            case "MISSION_ITEM" | "MISSION_ITEM_INT":
                self._receive_item(channel, message, store)
            case "MISSION_REQUEST_LIST":
                channel.send("MISSION_COUNT", _address(message, kind) | {"count": len(store.items)})
            case "MISSION_REQUEST_PARTIAL_LIST":
                self._ack(channel, message, kind, mavlink.MAV_MISSION_UNSUPPORTED)
            case "MISSION_REQUEST" | "MISSION_REQUEST_INT":
                self._send_item(channel, message, store)
            case "MISSION_CLEAR_ALL":
                self._ack(channel, message, kind, self._clear(store))
            case _:
                pass  # MISSION_ACK of a client that cancels its upload: the upload then times out

    def _begin(self, channel: Channel, message: Message, store: ItemStore, item_range: range) -> None:
        """Start the upload of the given item range: a whole new list, or a part of the stored list."""
        active = self.uploads.get(store.kind)
        if active is not None and not active.is_from(message):
            self._ack(channel, message, store.kind, mavlink.MAV_MISSION_DENIED)
        elif item_range.stop > MAX_ITEMS[store.kind]:
            self._send_text(mavlink.MAV_SEVERITY_WARNING, f"Only {MAX_ITEMS[store.kind]} items are supported")
            self._ack(channel, message, store.kind, mavlink.MAV_MISSION_NO_SPACE)
        elif not item_range:
            emptied = self._replace(store, [])
            self._report(channel, message, store.kind, mavlink.MAV_MISSION_ACCEPTED if emptied is None else emptied)
        else:
            kept = list(store.items)
            if message.name == "MISSION_COUNT":
                kept = kept[: len(item_range)] if store.kind in self._stored_by_item else []
                self._store_arrived(store, kept)
            self.uploads[store.kind] = up = Upload(
                channel=channel,
                sysid=message.sysid,
                compid=message.compid,
                kind=store.kind,
                next=item_range.start,
                last=item_range.stop - 1,
                items=kept,
                received_s=self.now_s,
                requested_s=self.now_s,
            )
            self._request_next(up)

    def _request_next(self, up: Upload) -> None:
        up.requested_s = self.now_s
        up.channel.send("MISSION_REQUEST", _address(up, up.kind) | {"seq": up.next})

    def _receive_item(self, channel: Channel, message: Message, store: ItemStore) -> None:
        up = self.uploads.get(store.kind)
        if up is None:
            self._ack(channel, message, store.kind, mavlink.MAV_MISSION_ERROR)
            return
        if up.complete:
            return  # the client repeats an item because the acknowledgement takes long
        if message.name == "MISSION_ITEM" and not up.old_format:
            up.old_format = True
            self._send_text(mavlink.MAV_SEVERITY_WARNING, "got MISSION_ITEM; GCS should send MISSION_ITEM_INT")
        seq = message.integer("seq")
        if seq != up.next or not up.is_from(message):
            # An error for a wrong or repeated item does not end the upload.
            refusal = mavlink.MAV_MISSION_INVALID_SEQUENCE if seq != up.next else mavlink.MAV_MISSION_DENIED
            self._ack(channel, message, store.kind, refusal)
            return
        item = item_from(message)
        verdict = self._validate(message, item, store, up)
        if verdict != mavlink.MAV_MISSION_ACCEPTED:
            del self.uploads[store.kind]
            self._ack(channel, message, store.kind, verdict)
            return
        up.items[seq : seq + 1] = [item]
        if up.next < up.last:
            self._store_arrived(store, up.items)
        up.next += 1
        up.received_s = self.now_s
        if up.next <= up.last:
            self._request_next(up)
            return
        up.complete = True
        stored = self._replace(store, up.items)
        if stored is not None:
            self.conclude(store.kind, stored)

    def conclude(self, kind: int, verdict: int) -> None:
        """Acknowledge a complete list that the vehicle has accepted or refused."""
        up = self.uploads.get(kind)
        if up is not None and up.complete:
            del self.uploads[kind]
            self._report(up.channel, up, kind, verdict)

    def _store_arrived(self, store: ItemStore, items: list[Item]) -> None:
        """Store the items of an unfinished upload, if the list is stored item by item.

        After an aborted upload, the list consists of the new items that arrived and the old items behind them.
        """
        if store.kind in self._stored_by_item:
            self._replace(store, list(items))

    def _report(self, channel: Channel, peer: Message | Upload, kind: int, verdict: int) -> None:
        """Acknowledge a list, and report a stored one in a STATUSTEXT."""
        self._ack(channel, peer, kind, verdict)
        if verdict == mavlink.MAV_MISSION_ACCEPTED and kind in RECEIVED_TEXTS:
            self._send_text(*RECEIVED_TEXTS[kind])

    def _validate(self, message: Message, item: Item, store: ItemStore, up: Upload) -> int:
        if store.kind == mavlink.MAV_MISSION_TYPE_MISSION:
            if message.integer("seq") == 0:
                return mavlink.MAV_MISSION_ACCEPTED
            verdict = validate_parameters(message)
            if verdict != mavlink.MAV_MISSION_ACCEPTED:
                return verdict
            if item.command == mavlink.MAV_CMD_DO_JUMP and not 0 < int(item.param1) < max(len(up.items), up.last + 1):
                return mavlink.MAV_MISSION_ERROR
        return self._judge_item(item, store.kind, message.integer("seq"))

    def _send_item(self, channel: Channel, message: Message, store: ItemStore) -> None:
        seq = message.integer("seq")
        # Item 0 of a mission is home and can be read even if the mission is empty.
        homes = [store.home] if store.home is not None and not store.items else store.items
        if not 0 <= seq < len(homes):
            self._ack(channel, message, store.kind, mavlink.MAV_MISSION_ERROR)
            return
        item = homes[seq]
        integers = message.name == "MISSION_REQUEST_INT"
        channel.send(
            "MISSION_ITEM_INT" if integers else "MISSION_ITEM",
            _address(message, store.kind)
            | {
                "seq": seq,
                "frame": item.frame,
                "command": item.command,
                "current": 0,
                "autocontinue": 1 if store.kind == mavlink.MAV_MISSION_TYPE_MISSION else 0,
                "param1": item.param1,
                "param2": item.param2,
                "param3": item.param3,
                "param4": item.param4,
                "x": item.x if integers else item.x * 1e-7,
                "y": item.y if integers else item.y * 1e-7,
                "z": item.z,
            },
        )

    def step(self, now_s: float) -> None:
        """Repeat requests without a response, and cancel an upload after UPLOAD_TIMEOUT_S."""
        self.now_s = now_s
        for kind, up in list(self.uploads.items()):
            if up.complete:
                continue
            if now_s - up.received_s > UPLOAD_TIMEOUT_S:
                del self.uploads[kind]
                self._ack(up.channel, up, up.kind, mavlink.MAV_MISSION_OPERATION_CANCELLED)
                self._send_text(mavlink.MAV_SEVERITY_WARNING, f"{TITLES[kind]} upload timeout")
            elif now_s - up.requested_s > RETRY_S:
                self._request_next(up)
