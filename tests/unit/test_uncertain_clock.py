"""Clocks that are stepped, and who stays let in meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from fractus_core.policy.decision_types import UncertainTime, earliest_time
from fractus_services import auth
from fractus_services import clock as clock_module
from fractus_services.auth import MAX_SEEN, Callers
from fractus_services.clock import TRUST_AFTER_S, Clock
from fractus_services.errors import NotAuthenticated

BEGIN_S = 1.8e9
DAY_S = 86_400.0
IDENTITY = "spiffe://fractus.dev/ns/a/app/b/component/c/instance/d"
_KEY = ec.generate_private_key(ec.SECP256R1())


class Machine:
    """A machine's clock, which may be stepped, and its steady time, which may not."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.steady_s, self.offset_s = 50.0, BEGIN_S - 50.0
        monkeypatch.setattr(clock_module.time, "time", lambda: self.steady_s + self.offset_s)
        for module in (clock_module, auth):
            monkeypatch.setattr(module, "steady_s", lambda: self.steady_s)
        self.told: list[tuple[float, bool]] = []
        self.clock = Clock(lambda step_s, trusted: self.told.append((step_s, trusted)))
        self.callers = Callers(self.clock)

    def caller(self, pem: bytes, urgent: bool = False) -> str:
        return self.callers.of({"x509_pem_cert": [pem]}, urgent).identity

    def let_in(self, pem: bytes) -> bool:
        try:
            return self.caller(pem) == IDENTITY
        except NotAuthenticated:
            return False

    def wait(self, seconds: float) -> None:
        """Pass time, with the clock read often, as the monitor does."""
        for _ in range(10):
            self.steady_s += seconds / 10
            self.clock()


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Machine:
    return Machine(monkeypatch)


def certificate(begin_s: float = -300.0, end_s: float = DAY_S, uris: tuple[str, ...] = (IDENTITY,)) -> bytes:
    """A certificate that is valid from begin to end, in seconds after BEGIN_S."""
    begun = datetime.fromtimestamp(BEGIN_S, UTC)
    name = x509.Name([])
    builder = x509.CertificateBuilder().subject_name(name).issuer_name(name).public_key(_KEY.public_key())
    builder = builder.serial_number(x509.random_serial_number())
    builder = builder.not_valid_before(begun + timedelta(seconds=begin_s))
    builder = builder.not_valid_after(begun + timedelta(seconds=end_s))
    if uris:
        names = x509.SubjectAlternativeName([x509.UniformResourceIdentifier(uri) for uri in uris])
        builder = builder.add_extension(names, critical=False)
    return builder.sign(_KEY, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)


@pytest.mark.parametrize("step_s", [400 * DAY_S, -400 * DAY_S, 3600.0, -3600.0])
def test_a_step_is_in_doubt_until_it_has_lasted(machine: Machine, step_s: float) -> None:
    machine.offset_s += step_s
    now = machine.clock()
    assert isinstance(now, UncertainTime)
    assert (earliest_time(now), now) == tuple(sorted((BEGIN_S, BEGIN_S + step_s))), "both readings count"
    machine.wait(TRUST_AFTER_S - 1)
    assert isinstance(machine.clock(), UncertainTime)
    machine.wait(2)
    assert (machine.clock(), type(machine.clock())) == (BEGIN_S + step_s + TRUST_AFTER_S + 1, float)
    assert machine.told == [(pytest.approx(step_s), False), (pytest.approx(step_s), True)]


def test_a_step_that_is_taken_back_is_over_at_once(machine: Machine) -> None:
    machine.offset_s += 400 * DAY_S
    machine.wait(60)
    machine.offset_s -= 400 * DAY_S
    assert (machine.clock(), type(machine.clock())) == (BEGIN_S + 60, float)
    assert machine.told[1:] == [(0.0, True)]


def test_each_further_step_begins_the_doubt_again(machine: Machine) -> None:
    for _ in range(3):
        machine.offset_s += 3600.0
        machine.wait(TRUST_AFTER_S - 10)
        assert isinstance(machine.clock(), UncertainTime)
    machine.wait(20)
    assert machine.clock() == BEGIN_S + 3 * 3600.0 + 3 * (TRUST_AFTER_S - 10) + 20


def test_a_clock_that_is_set_right_all_the_time_is_not_in_doubt(machine: Machine) -> None:
    for slew_s in (0.5, -0.9, 0.9, 0.9, 0.9):
        machine.offset_s += slew_s
        assert type(machine.clock()) is float
    assert machine.told == []


@pytest.mark.parametrize("step_s", [400 * DAY_S, -400 * DAY_S, 3600.0, -3600.0])
def test_who_was_let_in_before_a_step_stays_in_by_steady_time(machine: Machine, step_s: float) -> None:
    known = certificate()
    assert machine.let_in(known)
    for seconds in (1.0, TRUST_AFTER_S, 3600.0):
        machine.offset_s += step_s
        machine.wait(seconds)
        assert machine.let_in(known)
        machine.offset_s -= step_s
        machine.wait(seconds)
        assert machine.let_in(known)
    machine.wait(DAY_S)
    for back_s in (0.0, -400 * DAY_S, -400 * DAY_S):
        machine.offset_s += back_s
        assert not machine.let_in(known), "no step revives it"
        machine.wait(2 * TRUST_AFTER_S)
        assert not machine.let_in(known)


def test_who_was_not_seen_before_a_step_is_judged_by_the_later_reading_while_it_is_in_doubt(machine: Machine) -> None:
    fresh, expired = certificate(), certificate(-2 * DAY_S, -1.0)
    machine.offset_s -= 2 * DAY_S
    assert machine.let_in(fresh)
    assert not machine.let_in(expired), "a clock that is set back revives it not"
    machine.offset_s += 402 * DAY_S
    assert not machine.let_in(certificate())
    assert not machine.let_in(fresh), "it was not remembered while the clock was in doubt"
    machine.offset_s -= 400 * DAY_S
    assert machine.let_in(fresh), "it may be right later"


@pytest.mark.parametrize("make", [lambda: certificate(-2 * DAY_S, -1.0), lambda: certificate(3600.0)])
def test_what_stops_a_drone_needs_no_certificate_of_this_moment(machine: Machine, make: Callable[[], bytes]) -> None:
    pem = make()
    assert machine.caller(pem, urgent=True) == IDENTITY
    assert not machine.let_in(pem), "that was for this call alone"


def test_callers_without_an_identity(machine: Machine) -> None:
    def refused(context: dict[str, Any], why: str) -> None:
        for urgent in (False, True):
            with pytest.raises(NotAuthenticated, match=why):
                machine.callers.of(context, urgent)

    refused({}, "mutual TLS")
    refused({"x509_pem_cert": [b"nonsense"]}, "cannot parse")
    refused({"x509_pem_cert": [certificate(uris=())]}, "contains no identity")
    refused({"x509_pem_cert": [certificate(uris=("https://fractus.dev/a",))]}, "one SPIFFE ID, not 0")
    refused({"x509_pem_cert": [certificate(uris=(IDENTITY, IDENTITY + "2"))]}, "one SPIFFE ID, not 2")
    with pytest.raises(NotAuthenticated, match="expired"):
        machine.caller(certificate(-DAY_S, -1.0))
    with pytest.raises(NotAuthenticated, match="not valid yet"):
        machine.caller(certificate(90.0))
    assert machine.let_in(certificate(30.0)), "clocks may differ by that much"


def test_only_so_many_callers_are_remembered(machine: Machine) -> None:
    known = certificate()
    for _ in range(MAX_SEEN + 5):
        machine.let_in(known)
        machine.let_in(certificate())
    assert len(machine.callers._seen) == MAX_SEEN
    machine.offset_s += 400 * DAY_S
    assert machine.let_in(known), "it called all the time"
