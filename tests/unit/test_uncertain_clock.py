"""Steps of the clock: the time is then uncertain, and callers are authenticated with the uncertain time."""

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
    """Fake machine. A test can step its wall clock, but not its steady clock."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.steady_s = 50.0
        self.offset_s = BEGIN_S - 50.0
        monkeypatch.setattr(clock_module.time, "time", lambda: self.steady_s + self.offset_s)
        for module in (clock_module, auth):
            monkeypatch.setattr(module, "steady_s", lambda: self.steady_s)
        self.changes: list[tuple[float, bool]] = []
        self.clock = Clock(lambda step_s, trusted: self.changes.append((step_s, trusted)))
        self.callers = Callers(self.clock)

    def caller(self, pem: bytes, urgent: bool = False) -> str:
        return self.callers.of({"x509_pem_cert": [pem]}, urgent).identity

    def accepts(self, pem: bytes) -> bool:
        try:
            return self.caller(pem) == IDENTITY
        except NotAuthenticated:
            return False

    def wait(self, seconds: float) -> None:
        """Advance the time, and read the clock often, like the motion monitor."""
        for _ in range(10):
            self.steady_s += seconds / 10
            self.clock()


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Machine:
    return Machine(monkeypatch)


def certificate(begin_s: float = -300.0, end_s: float = DAY_S, uris: tuple[str, ...] = (IDENTITY,)) -> bytes:
    """Return a certificate that is valid from begin to end, in seconds after BEGIN_S."""
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
def test_clock_is_uncertain_after_step_until_the_step_has_lasted(machine: Machine, step_s: float) -> None:
    machine.offset_s += step_s
    now = machine.clock()
    assert isinstance(now, UncertainTime)
    assert (earliest_time(now), now) == tuple(sorted((BEGIN_S, BEGIN_S + step_s))), (
        "the uncertain time ranges from the old to the new reading"
    )
    machine.wait(TRUST_AFTER_S - 1)
    assert isinstance(machine.clock(), UncertainTime)
    machine.wait(2)
    assert (machine.clock(), type(machine.clock())) == (BEGIN_S + step_s + TRUST_AFTER_S + 1, float)
    assert machine.changes == [(pytest.approx(step_s), False), (pytest.approx(step_s), True)]


def test_clock_is_certain_when_step_is_reverted(machine: Machine) -> None:
    machine.offset_s += 400 * DAY_S
    machine.wait(60)
    machine.offset_s -= 400 * DAY_S
    assert (machine.clock(), type(machine.clock())) == (BEGIN_S + 60, float)
    assert machine.changes[1:] == [(0.0, True)]


def test_clock_uncertainty_restarts_with_each_step(machine: Machine) -> None:
    for _ in range(3):
        machine.offset_s += 3600.0
        machine.wait(TRUST_AFTER_S - 10)
        assert isinstance(machine.clock(), UncertainTime)
    machine.wait(20)
    assert machine.clock() == BEGIN_S + 3 * 3600.0 + 3 * (TRUST_AFTER_S - 10) + 20


def test_uncertain_time_spans_all_readings_since_the_first_step(machine: Machine) -> None:
    """The reading between two steps may be the right one."""
    for step_s in (7200.0, -3600.0, -7200.0, 1800.0):
        machine.offset_s += step_s
        now = machine.clock()
    assert (earliest_time(now), now) == (BEGIN_S - 3600.0, BEGIN_S + 7200.0)
    machine.wait(TRUST_AFTER_S + 1)
    machine.offset_s += 60.0
    now = machine.clock()
    assert now - earliest_time(now) == pytest.approx(60.0), (
        "a confirmed reading ends the doubt about the readings before"
    )


def test_clock_is_certain_during_small_corrections(machine: Machine) -> None:
    for slew_s in (0.5, -0.9, 0.9, 0.9, 0.9):
        machine.offset_s += slew_s
        assert type(machine.clock()) is float
    assert machine.changes == []


@pytest.mark.parametrize("step_s", [400 * DAY_S, -400 * DAY_S, 3600.0, -3600.0])
def test_known_caller_is_accepted_by_steady_time_after_clock_step(machine: Machine, step_s: float) -> None:
    known = certificate()
    assert machine.accepts(known)
    for seconds in (1.0, TRUST_AFTER_S, 3600.0):
        machine.offset_s += step_s
        machine.wait(seconds)
        assert machine.accepts(known)
        machine.offset_s -= step_s
        machine.wait(seconds)
        assert machine.accepts(known)
    machine.wait(DAY_S)
    for back_s in (0.0, -400 * DAY_S, -400 * DAY_S):
        machine.offset_s += back_s
        assert not machine.accepts(known), "no step makes an expired certificate valid"
        machine.wait(2 * TRUST_AFTER_S)
        assert not machine.accepts(known)


def test_unknown_caller_is_judged_by_later_reading_of_uncertain_clock(machine: Machine) -> None:
    fresh = certificate()
    expired = certificate(-2 * DAY_S, -1.0)
    machine.offset_s -= 2 * DAY_S
    assert machine.accepts(fresh)
    assert not machine.accepts(expired), "a clock that is set back does not make the certificate valid"
    machine.offset_s += 402 * DAY_S
    assert not machine.accepts(certificate())
    assert not machine.accepts(fresh), "callers are not remembered while the clock is uncertain"
    machine.offset_s -= 400 * DAY_S
    assert machine.accepts(fresh), "the certificate is valid again after the clock is corrected"


@pytest.mark.parametrize("make", [lambda: certificate(-2 * DAY_S, -1.0), lambda: certificate(3600.0)])
def test_urgent_call_accepts_expired_certificate(machine: Machine, make: Callable[[], bytes]) -> None:
    pem = make()
    assert machine.caller(pem, urgent=True) == IDENTITY
    assert not machine.accepts(pem), "only the urgent call is accepted"


def test_caller_without_valid_identity_is_refused(machine: Machine) -> None:
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
    assert machine.accepts(certificate(30.0)), "a certificate is accepted early, because clocks may differ slightly"


def test_number_of_remembered_callers_is_limited(machine: Machine) -> None:
    known = certificate()
    for _ in range(MAX_SEEN + 5):
        machine.accepts(known)
        machine.accepts(certificate())
    assert len(machine.callers._seen) == MAX_SEEN
    machine.offset_s += 400 * DAY_S
    assert machine.accepts(known), "recent callers are kept"
