"""When a connection is closed: after the reply, before the next request, and with less silence as time runs out."""

from __future__ import annotations

import socket
from dataclasses import replace
from ipaddress import IPv4Address

import pytest
from fractus_agent.redirector.habits import LONG_IDLE_MS, MIN_REPLY_BYTES, Exchange, Habits
from fractus_agent.redirector.nft import Endpoint
from fractus_agent.redirector.sockets import Connection

VIP = Endpoint(IPv4Address("10.96.0.5"), 8080)
PING_BYTES, WINDOW_UPDATE_BYTES = 17, 13


def seen(
    sent_ms: int, received_ms: int, received_bytes: int = 0, sent_bytes: int = 0, *, unacknowledged: int = 0
) -> Connection:
    return Connection(
        b"c", socket.AF_INET, VIP, 0, unacknowledged, sent_ms, received_ms, received_ms, received_bytes, sent_bytes
    )  # fmt: skip


def exchange(*looks: Connection) -> Exchange:
    first, *rest = looks
    found = Exchange.first(first)
    for connection in rest:
        found = found.then(connection)
    return found


REQUESTED = (
    seen(8, 4, 60, 50),  # a reply came
    seen(4, 24, 60, 50, unacknowledged=1),  # the next request is sent
    seen(12, 4, 120, 100),  # and answered
    seen(4, 16, 120, 150),  # and the next
)


def test_a_reply_as_long_as_the_one_before_is_complete_at_once() -> None:
    assert exchange(*REQUESTED, seen(8, 0, 180, 150)).complete
    assert not exchange(*REQUESTED, seen(8, 0, 150, 150)).complete
    assert not exchange(*REQUESTED, seen(8, 0, 1500, 150)).complete, "a longer one may go on"
    assert Habits().closable(exchange(*REQUESTED, seen(8, 0, 180, 150)), 1.0)


def test_when_time_is_out_any_rest_will_do() -> None:
    habits = Habits()
    habits.learn(seen(4, 24, 320, 150))
    longer_than_usual = exchange(seen(44, 40, 320, 150))
    assert not habits.closable(longer_than_usual, 1.0), "the next request may come at any time"
    assert habits.closable(longer_than_usual, 0.0)


def test_a_reply_that_the_client_has_not_read_is_not_thrown_away() -> None:
    """A client on a busy machine comes late to what has arrived for it."""
    replied = seen(8, 0, 180, 150)
    assert not Habits().closable(exchange(*REQUESTED, replace(replied, unread=60)), 0.0)
    assert Habits().closable(exchange(*REQUESTED, replace(replied, unread=60), replied), 1.0)


def test_a_call_that_takes_long_is_waited_for() -> None:
    """Pings and acknowledgements are no reply, however long the silence, on a connection's first call and on later ones."""
    pinged = seen(3000, 2990, 120 + PING_BYTES, 150)
    assert not Habits().closable(exchange(*REQUESTED, pinged), 0.0)
    opened = seen(2000, 1990, 90, 240)
    assert not Habits().closable(exchange(opened), 0.0)
    assert Habits().closable(exchange(opened, seen(4000, 1000, 250, 240)), 1.0)
    assert Habits().closable(exchange(seen(3000, 2990, 90, 90)), 1.0), "nothing was asked yet"


def test_a_stream_on_which_both_talk_is_closed_in_a_rest() -> None:
    looks = [*REQUESTED, *(seen(20, 16, 120 + 28 * number, 150 + 22 * number) for number in range(1, 600))]
    assert not exchange(*looks).long
    assert Habits().closable(exchange(*looks), 0.0)


def test_what_acknowledges_a_request_is_no_reply_to_it() -> None:
    """A server's ping and window update come first, and are no longer than the replies may be short."""
    pinged = exchange(*REQUESTED, seen(8, 4, 120 + PING_BYTES, 150))
    assert not pinged.complete
    assert not Habits().closable(pinged, 1.0)
    # A ping that the client answers meanwhile begins no new exchange.
    answered = 150 + PING_BYTES
    assert exchange(*REQUESTED, seen(8, 4, 137, 150), seen(4, 4, 137, answered), seen(8, 0, 190, answered)).complete


def long_reply(pieces: int, *, piece_bytes: int = 16_384, pause_ms: int = 0) -> list[Connection]:
    """A client that asks, and sends window updates and answers to pings while the reply comes in."""
    looks = []
    for number in range(1, pieces + 1):
        sent_bytes = 150 + number * (2 * WINDOW_UPDATE_BYTES + PING_BYTES)
        looks.append(seen(pause_ms + 4, pause_ms, 120 + number * piece_bytes, sent_bytes))
    return looks


@pytest.mark.parametrize("looks_before", [0, 1, 4], ids=["from within", "from its request on", "after others"])
def test_what_a_client_sends_while_it_takes_a_long_reply_is_no_request(looks_before: int) -> None:
    habits = Habits()
    looks = [*REQUESTED[4 - looks_before :], *long_reply(40)]
    for connection in looks:
        habits.learn(connection)
    for end in range(max(looks_before, 1), len(looks)):
        found = exchange(*looks[: end + 1])
        assert not found.complete
        assert not habits.closable(found, 1.0), end


def test_a_long_reply_may_pause_and_is_over_after_a_while() -> None:
    habits = Habits()
    reply = long_reply(40)
    last = reply[-1]
    stalled = seen(154, 150, last.received_bytes, last.sent_bytes)
    assert not habits.closable(exchange(*REQUESTED, *reply, stalled), 1.0)
    over = seen(int(LONG_IDLE_MS) + 4, int(LONG_IDLE_MS), last.received_bytes, last.sent_bytes)
    assert habits.closable(exchange(*REQUESTED, *reply, over), 1.0)
    # It has paused for longer than that before.
    slow = [*long_reply(20), *long_reply(40, pause_ms=200)[20:]]
    assert not habits.closable(exchange(*REQUESTED, *slow, over), 1.0)
    assert habits.closable(exchange(*REQUESTED, *slow, over), 0.1), "else it is cut in any case"


def test_calls_after_a_long_reply_are_told_apart_again() -> None:
    last = long_reply(40)[-1]
    calls = [seen(8, 4, last.received_bytes + 60 * number, last.sent_bytes + 50 * number) for number in range(1, 5)]
    assert exchange(*REQUESTED, *long_reply(40), *calls).complete
    assert not exchange(*REQUESTED, *long_reply(40), *calls).long


def test_a_long_request_is_not_taken_for_several() -> None:
    """What its server sends meanwhile lets it go on, and is no reply."""
    looks = [seen(4, 0, 120 + number * 2 * WINDOW_UPDATE_BYTES, 150 + number * 32_768) for number in range(1, 8)]
    assert not any(exchange(*REQUESTED, *looks[:end]).complete for end in range(1, 8))


def test_nothing_is_closed_while_a_request_is_under_way() -> None:
    for left in (1.0, 0.01):
        assert not Habits().closable(exchange(*REQUESTED), left)


def test_a_client_that_is_about_to_ask_again_is_left_alone() -> None:
    habits = Habits()
    habits.learn(seen(4, 20, unacknowledged=1))  # it rested for 16 ms
    habits.learn(seen(9, 4))  # and its server worked for 5
    early, late = (exchange(*REQUESTED, seen(8 + age, age, 180, 150)) for age in (4, 12))
    assert habits.closable(early, 1.0)
    assert not habits.closable(late, 1.0)
    assert habits.closable(late, 0.05)


def test_a_client_that_rests_longer_than_it_ever_did_is_closed() -> None:
    habits = Habits()
    habits.learn(seen(4, 20, unacknowledged=1))
    habits.learn(seen(9, 4))
    assert habits.closable(exchange(seen(2000, 1995, 60)), 1.0)


@pytest.mark.parametrize(("idle_ms", "left", "closed"), [(60, 1.0, False), (92, 1.0, True), (24, 0.1, True)])
def test_a_connection_that_was_not_watched_waits_for_its_servers_usual_work(
    idle_ms: int, left: float, closed: bool
) -> None:
    assert Habits().closable(exchange(seen(idle_ms + 5, idle_ms, 60)), left) is closed


def test_a_reply_is_longer_than_what_replies_to_nothing() -> None:
    assert PING_BYTES + WINDOW_UPDATE_BYTES < MIN_REPLY_BYTES
