"""When a connection is closed: after the reply, before the next request, and with less patience as time runs out."""

from __future__ import annotations

import socket
from ipaddress import IPv4Address

import pytest
from fractus_agent.redirector.habits import MIN_REPLY_BYTES, Exchange, Habits
from fractus_agent.redirector.nft import Endpoint
from fractus_agent.redirector.sockets import Connection

VIP = Endpoint(IPv4Address("10.96.0.5"), 8080)
PING_BYTES = 17


def seen(sent_ms: int, received_ms: int, received_bytes: int = 0, *, unacknowledged: int = 0) -> Connection:
    return Connection(
        b"c", socket.AF_INET, VIP, 0, unacknowledged, sent_ms, received_ms, received_ms, received_bytes
    )  # fmt: skip


def exchange(*looks: tuple[float, Connection]) -> Exchange:
    (first_ms, first), *rest = looks
    found = Exchange.first(first, first_ms)
    for now_ms, connection in rest:
        found = found.then(connection, now_ms)
    return found


REQUESTED = (
    (1000.0, seen(8, 4, 60)),  # a reply came
    (1020.0, seen(4, 24, 60, unacknowledged=1)),  # the next request is sent
    (1026.0, seen(12, 4, 120)),  # and answered
    (1040.0, seen(4, 16, 120, unacknowledged=1)),  # and the next
)


def test_a_reply_as_long_as_the_one_before_is_complete_at_once() -> None:
    assert exchange(*REQUESTED, (1046.0, seen(8, 0, 180))).complete
    assert not exchange(*REQUESTED, (1046.0, seen(8, 0, 150))).complete
    assert Habits().closable(exchange(*REQUESTED, (1046.0, seen(8, 0, 180))), 1.0)


def test_what_acknowledges_a_request_is_no_reply_to_it() -> None:
    """A server's ping and window update come first, and are no longer than the replies may be short."""
    pinged = exchange(*REQUESTED, (1044.0, seen(8, 4, 120 + PING_BYTES)))
    assert not pinged.complete
    assert not Habits().closable(pinged, 1.0)
    # A ping that the client answers meanwhile begins no new exchange.
    assert exchange(
        *REQUESTED, (1044.0, seen(8, 4, 137)), (1060.0, seen(4, 4, 137)), (1064.0, seen(8, 0, 190))
    ).complete


def test_nothing_is_closed_while_a_request_is_under_way() -> None:
    for left in (1.0, 0.01):
        assert not Habits().closable(exchange(*REQUESTED), left)


def test_a_client_that_is_about_to_ask_again_is_left_alone() -> None:
    habits = Habits()
    habits.learn(seen(4, 20, unacknowledged=1))  # it rested for 16 ms
    habits.learn(seen(9, 4))  # and its server worked for 5
    early, late = (exchange(*REQUESTED, (1046.0 + age, seen(8 + age, age, 180))) for age in (4, 12))
    assert habits.closable(early, 1.0)
    assert not habits.closable(late, 1.0)
    assert habits.closable(late, 0.05)


def test_a_client_that_rests_longer_than_it_ever_did_is_closed() -> None:
    habits = Habits()
    habits.learn(seen(4, 20, unacknowledged=1))
    habits.learn(seen(9, 4))
    assert habits.closable(exchange((1000.0, seen(2000, 1995, 60))), 1.0)


@pytest.mark.parametrize(("idle_ms", "left", "closed"), [(60, 1.0, False), (92, 1.0, True), (24, 0.1, True)])
def test_a_connection_that_was_not_watched_waits_for_its_servers_usual_work(
    idle_ms: int, left: float, closed: bool
) -> None:
    assert Habits().closable(exchange((1000.0, seen(idle_ms + 5, idle_ms, 60))), left) is closed


def test_a_reply_is_longer_than_what_replies_to_nothing() -> None:
    window_update = 13
    assert PING_BYTES + window_update < MIN_REPLY_BYTES
