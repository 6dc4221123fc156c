"""Certificate of the node, with real keys and files, a fake signer and a fake clock."""

import asyncio
import contextlib
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from agent_pki import FakeSigner, TestAuthority
from cryptography import x509
from cryptography.hazmat.primitives import serialization
from fractus_agent.certificates import CERTIFICATE_FILES, InvalidCertificate, create_request, inspect_certificate
from fractus_agent.identity import NodeIdentity, SigningRefused
from fractus_agent.store import KubeError
from fractus_runtime.files import read_set, write_set

NODE = "drone-1"


class Clock:
    def __init__(self) -> None:
        self.now = datetime.now(UTC)

    def __call__(self) -> datetime:
        return self.now


class IdentityBench:
    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.clock = Clock()
        self.signer = FakeSigner(TestAuthority())
        self.identity = self.agent()

    def agent(self) -> NodeIdentity:
        return NodeIdentity(self.signer, self.directory, NODE, self.clock)

    def files(self) -> dict[str, bytes]:
        files = read_set(self.directory, CERTIFICATE_FILES)
        assert files is not None
        return files


@pytest.fixture
def bench(tmp_path: Path) -> IdentityBench:
    return IdentityBench(tmp_path / "tls")


async def test_certificate_is_requested_signed_and_stored(bench: IdentityBench) -> None:
    await bench.identity.step()
    assert bench.identity.ready.is_set()
    assert bench.identity.condition.status == "True"
    assert (bench.directory / "tls.key").stat().st_mode & 0o777 == 0o600
    certificate = x509.load_pem_x509_certificate(bench.files()["tls.crt"])
    names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert names.get_values_for_type(x509.UniformResourceIdentifier) == ["spiffe://fractus.dev/node/drone-1"]
    assert names.get_values_for_type(x509.DNSName) == ["drone-1.node.fractus.dev"]
    assert names.get_values_for_type(x509.IPAddress) == []
    key = serialization.load_pem_private_key(bench.files()["tls.key"], None)
    assert key.public_key() == certificate.public_key()
    assert bench.signer.requests == {}


async def test_created_key_and_request_give_a_valid_certificate(bench: IdentityBench) -> None:
    key, request = create_request(NODE)
    write_set(
        bench.directory, {"tls.key": key, "tls.crt": bench.signer.ca.sign(request), "ca.crt": bench.signer.ca.pem}
    )
    assert inspect_certificate(bench.directory, NODE).has_begun(datetime.now(UTC))


async def test_restarted_agent_requests_no_certificate(bench: IdentityBench) -> None:
    await bench.identity.step()
    before = bench.files()
    again = bench.agent()
    await again.step()
    assert bench.signer.request_count == 1
    assert bench.files() == before
    assert again.ready.is_set()


async def test_certificate_is_renewed_at_two_thirds_with_a_new_key(bench: IdentityBench) -> None:
    await bench.identity.step()
    before = bench.files()
    bench.clock.now += timedelta(days=19.5)
    await bench.identity.step()
    assert bench.files() == before
    bench.clock.now += timedelta(days=2)
    bench.signer.sign_with = {"begin": bench.clock.now}
    await bench.identity.step()
    assert bench.signer.request_count == 2
    assert bench.files()["tls.key"] != before["tls.key"]
    assert bench.identity.serial == 2


async def test_failed_renewal_keeps_the_certificate_in_use(bench: IdentityBench) -> None:
    await bench.identity.step()
    before = bench.files()
    bench.clock.now += timedelta(days=22)
    bench.signer.error = KubeError(0, "Unreachable", "no API server")
    with pytest.raises(KubeError):
        await bench.identity.step()
    assert bench.files() == before
    assert bench.identity.condition.status == "True"


async def test_expired_certificate_is_replaced(bench: IdentityBench) -> None:
    await bench.identity.step()
    bench.clock.now += timedelta(days=40)
    bench.signer.sign_with = {"begin": bench.clock.now}
    await bench.identity.step()
    assert bench.signer.request_count == 2
    assert bench.identity.condition.status == "True"


async def test_rotation_to_a_bundle_keeps_the_certificate(bench: IdentityBench) -> None:
    await bench.identity.step()
    before = bench.files()
    bench.signer.published = TestAuthority("next").pem + bench.signer.ca.pem
    await bench.identity.step()
    assert bench.signer.request_count == 1
    assert bench.files() == before | {"ca.crt": bench.signer.published}


async def test_rotation_to_another_authority_requests_a_certificate(bench: IdentityBench) -> None:
    await bench.identity.step()
    bench.signer.ca = TestAuthority("next")
    bench.signer.published = bench.signer.ca.pem
    await bench.identity.step()
    assert bench.signer.request_count == 2
    assert bench.files()["ca.crt"] == bench.signer.ca.pem
    assert inspect_certificate(bench.directory, NODE)


@pytest.mark.parametrize(
    "harm", ["no key", "cut certificate", "other key", "empty authority", "dangling", "other node"]
)
async def test_damaged_certificate_files_are_replaced(bench: IdentityBench, harm: str) -> None:
    await bench.identity.step()
    files = bench.files()
    if harm == "dangling":
        (bench.directory / "..data").unlink()
    elif harm == "no key":
        (bench.directory / "tls.key").unlink()
    elif harm == "other node":
        key, request = create_request("drone-2")
        write_set(bench.directory, files | {"tls.key": key, "tls.crt": bench.signer.ca.sign(request)})
    else:
        write_set(
            bench.directory,
            files
            | {
                "cut certificate": {"tls.crt": files["tls.crt"][:200]},
                "other key": {"tls.key": create_request(NODE)[0]},
                "empty authority": {"ca.crt": b""},
            }[harm],
        )
    with pytest.raises(InvalidCertificate):
        inspect_certificate(bench.directory, NODE)
    again = bench.agent()
    await again.step()
    assert inspect_certificate(bench.directory, NODE)
    assert again.ready.is_set()


@pytest.mark.parametrize("kind", ["Denied", "Failed"])
async def test_refused_signing_request_raises_signing_refused(bench: IdentityBench, kind: str) -> None:
    bench.signer.conditions = [{"type": kind, "message": "node drone-1 is not in the fleet"}]
    with pytest.raises(SigningRefused, match="not in the fleet") as refusal:
        await bench.identity.step()
    assert refusal.value.reason == kind
    assert not bench.identity.ready.is_set()
    assert not (bench.directory / "tls.crt").exists()


async def test_refused_signing_request_sets_the_condition(bench: IdentityBench) -> None:
    bench.signer.conditions = [{"type": "Denied", "message": "node drone-1 is not in the fleet"}]
    changed = asyncio.Event()
    identity = NodeIdentity(bench.signer, bench.directory, NODE, bench.clock, on_change=changed.set)
    task = asyncio.create_task(identity.run())
    try:
        while identity.condition.reason != "Denied":
            await asyncio.wait_for(changed.wait(), 10.0)
            changed.clear()
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
    assert (identity.condition.type, identity.condition.status) == ("Certified", "False")
    assert "not in the fleet" in identity.condition.message


async def test_denied_renewal_keeps_the_node_certified(bench: IdentityBench) -> None:
    await bench.identity.step()
    bench.clock.now += timedelta(days=22)
    bench.signer.conditions = [{"type": "Denied", "message": "fleet frozen"}]
    changed = asyncio.Event()
    identity = NodeIdentity(bench.signer, bench.directory, NODE, bench.clock, on_change=changed.set)
    task = asyncio.create_task(identity.run())
    try:
        while "fleet frozen" not in identity.condition.message:
            await asyncio.wait_for(changed.wait(), 10.0)
            changed.clear()
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
    assert identity.condition.status == "True"
    assert bench.signer.request_count == 2


async def test_certificate_of_another_authority_is_not_installed(bench: IdentityBench) -> None:
    bench.signer.published = TestAuthority("other").pem
    with pytest.raises(SigningRefused, match="is invalid"):
        await bench.identity.step()
    assert not (bench.directory / "tls.crt").exists()


async def test_missing_authority_raises_signing_refused(bench: IdentityBench) -> None:
    bench.signer.published = None
    with pytest.raises(SigningRefused) as refusal:
        await bench.identity.step()
    assert refusal.value.reason == "NoAuthority"


async def test_clock_before_certificate_validity_causes_no_request(bench: IdentityBench) -> None:
    await bench.identity.step()
    now = bench.clock.now
    bench.clock.now = datetime(1970, 1, 1, tzinfo=UTC)
    await bench.identity.step()
    assert bench.identity.condition.reason == "ClockSkew"
    assert bench.signer.request_count == 1
    bench.clock.now = now
    await bench.identity.step()
    assert bench.identity.condition.status == "True"


async def test_clock_after_authority_validity_is_reported(bench: IdentityBench) -> None:
    now = bench.clock.now
    bench.clock.now = now + timedelta(days=900)
    with pytest.raises(SigningRefused) as refusal:
        await bench.identity.step()
    assert refusal.value.reason == "ClockSkew"
    bench.clock.now = now
    await bench.identity.step()
    assert bench.identity.condition.status == "True"
    assert bench.signer.request_count == 1
