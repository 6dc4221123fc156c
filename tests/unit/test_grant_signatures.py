"""Signed Grants: valid and invalid signatures, signing certificates, and replay protection of a node."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec
from fractus_cli.grants import grants
from fractus_cli.standalone import StandalonePki
from fractus_core.api import Grant, InvalidObject
from fractus_core.api.names import component_identity, node_identity
from fractus_core.identity.authority import SIGNER_LIFE, Authority
from fractus_core.identity.grant_signer import GrantSigner
from fractus_core.policy.grant_signatures import (
    SIGNATURE_ANNOTATION,
    SIGNER_ANNOTATION,
    BadSignature,
    UnknownAuthority,
    read_authorities,
    sign,
    verify,
)
from fractus_services import grant_verifier
from fractus_services.grant_verifier import GrantVerifier
from policy_world import spec

NOW = datetime(2026, 6, 1, 12, 0, 0, 123456, tzinfo=UTC)
CA = Authority.generate(NOW)
FOREIGN_CA = Authority.generate(NOW)
CAS = (CA.certificate,)
SIGNER = CA.issue_signer(NOW)
IDENTITY = Grant.from_body(
    {"kind": "Grant", "metadata": {"name": "g"}, "spec": spec().to_dict()}
).spec.identity  # fmt: skip


def manifest(**changes: Any) -> dict[str, Any]:
    metadata = {"name": "g", "uid": "u1"}
    return {"kind": "Grant", "metadata": metadata, "spec": {**spec().to_dict(), **changes}}


def signed(issued_at: datetime = NOW, **changes: Any) -> dict[str, Any]:
    return sign(manifest(**changes), *SIGNER, issued_at)


def grant(body: dict[str, Any]) -> Grant:
    return Grant.from_body(body)


def test_signature_is_valid_for_equivalent_json() -> None:
    body = json.loads(json.dumps(signed(limits={"maxAltitude": 60, "maxSpeed": 12})))
    body["spec"]["limits"] = {"maxSpeed": 12.0, "maxAltitude": 60.0}
    body["spec"]["policies"] = body["spec"].get("policies", [])
    body["spec"] = dict(sorted(body["spec"].items()))
    body["metadata"].update(resourceVersion="7", uid="another", labels={"a": "b"}, generation=3)
    body["status"] = {"phase": "Active"}
    assert verify(grant(body), CAS) == NOW


def test_signature_is_valid_with_omitted_and_explicit_defaults() -> None:
    bare = signed()
    bare["spec"] = {key: value for key, value in bare["spec"].items() if value not in ([], None)}
    assert verify(grant(bare), CAS) == NOW
    full = grant(signed())
    assert verify(grant({**full.to_dict(), "spec": full.spec.model_dump(mode="json", by_alias=True)}), CAS) == NOW


CHANGES: list[Callable[[dict[str, Any]], Any]] = [
    lambda body: body["metadata"].update(name="other"),
    lambda body: body["spec"].update(node="drone-2"),
    lambda body: body["spec"].update(component="Other"),
    lambda body: body["spec"]["application"].update(uid="later"),
    lambda body: body["spec"].update(policies=[]),
    lambda body: body["spec"].update(operationArea=[]),
    lambda body: body["spec"]["limits"].update(maxSpeed=12.000000000000002),
    lambda body: body["spec"].update(issuedAt="2026-06-01T12:00:00.123457Z"),
    lambda body: body["spec"].update(issuedAt=None),
    lambda body: body["spec"].update(issuedAt="2026-06-01T12:00:00.123456"),
    lambda body: body["metadata"]["annotations"].pop(SIGNATURE_ANNOTATION),
    lambda body: body["metadata"]["annotations"].pop(SIGNER_ANNOTATION),
    lambda body: body["metadata"]["annotations"].update({SIGNATURE_ANNOTATION: "bm9uc2Vuc2U="}),
    lambda body: body["metadata"]["annotations"].update({SIGNATURE_ANNOTATION: "?"}),
    lambda body: body["metadata"]["annotations"].update({SIGNER_ANNOTATION: "bm9uc2Vuc2U="}),
    lambda body: body.update(metadata={"name": "g"}),
]


@pytest.mark.parametrize("change", CHANGES)
def test_signature_is_invalid_after_any_change(change: Callable[[dict[str, Any]], Any]) -> None:
    policies = [{"name": "p", "spec": {"type": "LimitControl", "kind": "speed", "upperLimit": 5}}]
    limits = {"maxAltitude": 60, "maxSpeed": 12}
    body = json.loads(json.dumps(signed(policies=policies, limits=limits)))
    assert verify(grant(body), CAS)
    change(body)
    with pytest.raises(BadSignature):
        verify(grant(body), CAS)


def of_data(data: dict[str, str]) -> tuple[ec.EllipticCurvePrivateKey, x509.Certificate]:
    key = serialization.load_pem_private_key(base64.b64decode(data["tls.key"]), None)
    assert isinstance(key, ec.EllipticCurvePrivateKey)
    return key, x509.load_pem_x509_certificate(base64.b64decode(data["tls.crt"]))


@pytest.mark.parametrize(
    ("signer", "message"),
    [
        (of_data(CA.issue_component(IDENTITY, NOW)), "instead of the operator"),
        (of_data(CA.issue_component("spiffe://fractus.dev/operator", NOW)), "not valid for signing Grants"),
        (of_data(CA.issue_node("drone-1", NOW)), "instead of the operator"),
        ((CA.key, CA.certificate), "not valid for signing Grants"),
        (FOREIGN_CA.issue_signer(NOW), "authority that is not in ca.crt"),
        ((SIGNER[0], CA.issue_signer(NOW)[1]), "changed after signing"),
    ],
)
def test_signature_of_other_certificates_is_refused(
    signer: tuple[ec.EllipticCurvePrivateKey, x509.Certificate], message: str
) -> None:
    with pytest.raises(BadSignature, match=message):
        verify(grant(sign(manifest(), *signer, NOW)), CAS)


def test_signing_certificate_and_tls_certificates_have_separate_usages() -> None:
    signing = SIGNER[1].extensions.get_extension_for_class(x509.KeyUsage).value
    assert signing.content_commitment
    assert not signing.digital_signature
    for data in (CA.issue_component(IDENTITY, NOW), CA.issue_node("n", NOW)):
        usage = of_data(data)[1].extensions.get_extension_for_class(x509.KeyUsage).value
        assert not usage.content_commitment


def test_signature_is_judged_at_time_of_issue() -> None:
    assert verify(grant(signed(NOW)), CAS), "a signature does not expire"
    late = SIGNER[1].not_valid_after_utc
    assert verify(grant(signed(late + timedelta(minutes=4))), CAS), "clocks may differ by some minutes"
    for wrong in (late + timedelta(minutes=6), NOW - timedelta(hours=3)):
        with pytest.raises(BadSignature, match="certificate was not valid"):
            verify(grant(signed(wrong)), CAS)


def test_signature_is_valid_for_each_of_several_authorities() -> None:
    both = read_authorities(FOREIGN_CA.certificate_pem + CA.certificate_pem)
    assert verify(grant(signed()), both) == NOW


# Operator


def test_signer_issue_time_always_increases() -> None:
    clock = [NOW]
    signer = GrantSigner(CA, lambda: clock[0])
    first = grant(signer.sign(manifest()))
    second = grant(signer.sign(manifest()))
    clock[0] = NOW - timedelta(hours=1)
    third = grant(signer.sign(manifest(), second))
    restarted = GrantSigner(CA, lambda: clock[0])
    fourth = grant(restarted.sign(manifest(), third))
    times = [g.spec.issued_at for g in (first, second, third, fourth)]
    assert times == sorted(set(times), key=str)


def test_signer_renews_certificate_in_time() -> None:
    clock = [NOW]
    signer = GrantSigner(CA, lambda: clock[0])
    signers = set()
    for _ in range(6):
        body = signer.sign(manifest())
        signers.add(body["metadata"]["annotations"][SIGNER_ANNOTATION])
        assert verify(grant(body), CAS)
        clock[0] += SIGNER_LIFE / 2
    assert len(signers) == 3
    assert all(verify(grant(sign(manifest(), *SIGNER, NOW)), CAS) for _ in signers)


def test_signer_detects_foreign_and_invalid_signatures() -> None:
    signer = GrantSigner(CA, lambda: NOW)
    body = signer.sign(manifest())
    assert signer.problem(grant(body)) is None
    body["metadata"]["annotations"][SIGNATURE_ANNOTATION] = "bm9uc2Vuc2U="
    assert signer.problem(grant(body)) is not None
    assert signer.problem(grant(manifest())) is not None
    assert GrantSigner(FOREIGN_CA, lambda: NOW).problem(grant(signed())) is not None


# Node


class Node:
    """Grant directory and verifier of a node service. A test can restart the service."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.trust(CA)
        self.verifier = GrantVerifier(path, path / "seen.json")
        self.verifier.reload_authorities()

    def trust(self, *authorities: Authority) -> None:
        (self.path / "ca.crt").write_bytes(b"".join(a.certificate_pem for a in authorities))

    def restart(self) -> None:
        content = self.verifier.unsaved()
        if content is not None:
            self.verifier.store(content)
        self.verifier = GrantVerifier(self.path, self.path / "seen.json")
        self.verifier.reload_authorities()

    def take(self, body: dict[str, Any]) -> str:
        return self.verifier.verify(grant(body))


@pytest.fixture
def node(tmp_path: Path) -> Node:
    return Node(tmp_path)


def later(seconds: float = 1.0) -> datetime:
    return NOW + timedelta(seconds=seconds)


@pytest.mark.parametrize("restarts", [False, True])
def test_verifier_refuses_older_grant(node: Node, restarts: bool) -> None:
    old = signed(NOW)
    new = signed(later(), policies=[])
    first = node.take(old)
    assert node.take(old) == first, "the same Grant is valid when it is read again"
    digest = node.take(new)
    if restarts:
        node.restart()
    with pytest.raises(BadSignature, match=r"not after the Grant of 2026-06-01T12:00:01\.123456"):
        node.take(old)
    assert node.take(new) == digest
    assert node.verifier.is_latest(IDENTITY, digest)
    assert not node.verifier.is_latest(IDENTITY, first)


@pytest.mark.parametrize("restarts", [False, True])
def test_verifier_refuses_revoked_grant_but_accepts_later_grant(node: Node, restarts: bool) -> None:
    node.verifier.revoke(IDENTITY, node.take(signed()))
    if restarts:
        node.restart()
    with pytest.raises(BadSignature, match=r"that was revoked here; sign it again"):
        node.take(signed())
    assert node.take(signed(later()))


def test_verifier_refuses_replay_with_another_uid(node: Node) -> None:
    body = signed()
    node.take(body)
    with pytest.raises(BadSignature, match="not after"):
        node.take({**body, "metadata": {**body["metadata"], "uid": "u2"}})


def test_verifier_accepts_verified_grant_after_authority_change(node: Node) -> None:
    body = signed()
    digest = node.take(body)
    node.trust(FOREIGN_CA)
    assert node.verifier.reload_authorities()
    assert node.take(body) == digest
    node.restart()
    assert node.take(body) == digest
    with pytest.raises(UnknownAuthority):
        node.take(signed(later()))
    assert node.take(sign(manifest(), *FOREIGN_CA.issue_signer(NOW), later(2)))


def test_verifier_refuses_grants_without_authority(node: Node) -> None:
    (node.path / "ca.crt").unlink()
    node.restart()
    with pytest.raises(UnknownAuthority, match=r"ca\.crt is missing"):
        node.take(signed())
    node.trust(CA)
    assert node.verifier.reload_authorities()
    assert not node.verifier.reload_authorities()
    assert node.take(signed())


def test_verifier_keeps_authorities_when_ca_file_is_broken(node: Node) -> None:
    (node.path / "ca.crt").write_text("nonsense")
    assert not node.verifier.reload_authorities()
    assert node.take(signed())


@pytest.mark.parametrize("damage", [b"", b"{", b"[]", b'{"floor": 1}', b'{"floor": "", "seen": {"a": {"b": 1}}}'])
def test_verifier_ignores_damaged_state_file(node: Node, damage: bytes) -> None:
    node.take(signed(later()))
    node.restart()
    (node.path / "seen.json").write_bytes(damage)
    node.restart()
    assert node.take(signed())


def test_verifier_works_with_full_disk_and_stores_state_later(
    node: Node, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    body = signed()
    node.take(body)
    content = node.verifier.unsaved()
    assert content is not None
    assert node.verifier.unsaved() is None
    with monkeypatch.context() as patch:
        patch.setattr("fractus_runtime.files.os.fsync", full)
        node.verifier.store(content)
    assert "No space left" in caplog.text
    node.restart()
    node.verifier.revoke(IDENTITY, node.take(body))
    node.restart()
    with pytest.raises(BadSignature, match="revoked"):
        node.take(body)


def test_verifier_refuses_grant_after_signature_is_removed(node: Node) -> None:
    body = signed()
    node.take(body)
    with pytest.raises(BadSignature, match="is not signed"):
        node.take({**body, "metadata": {"name": "g", "uid": "u1"}})


def test_verifier_state_is_bounded_and_still_refuses_old_grants(node: Node, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(grant_verifier, "MAX_REMEMBERED", 3)
    for n in range(6):
        node.take(signed(later(n), instance=f"i{n}"))
    node.restart()
    with pytest.raises(BadSignature, match="not after"):
        node.take(signed(later(0), instance="i0"))
    assert node.take(signed(later(7), instance="i0"))


# Standalone services


def test_grants_command_creates_authority_and_signs_grant(tmp_path: Path) -> None:
    pki = tmp_path / "pki"
    to = tmp_path / "grants"
    file = tmp_path / "grant.json"
    file.write_text(json.dumps(manifest()))
    missing = CliRunner().invoke(grants, ["sign", str(file), "--tls", str(pki), "--to", str(to)])
    assert missing.exit_code == 1
    assert "fractus grants init" in missing.output
    result = CliRunner().invoke(grants, ["init", str(pki), "--node", "drone-1"])
    assert result.exit_code == 0, result.output
    ca = (pki / "nodes" / "drone-1" / "ca.crt").read_bytes()
    assert (pki / "authority" / "tls.key").stat().st_mode & 0o777 == 0o600
    times = []
    for _ in range(2):
        done = CliRunner().invoke(grants, ["sign", str(file), "--tls", str(pki), "--to", str(to)])
        assert done.exit_code == 0, done.output
        times.append(verify(grant(json.loads((to / "g.json").read_bytes())), read_authorities(ca)))
    assert times[0] < times[1]
    file.write_text("kind: Grant\nmetadata: {name: g}\nspec: {node: 3}\n")
    bad = CliRunner().invoke(grants, ["sign", str(file), "--tls", str(pki), "--to", str(to)])
    assert bad.exit_code == 1
    assert "grant.json" in bad.output


@pytest.mark.parametrize("name", ["", "../x", "a/b", ".", "Drone"])
def test_standalone_pki_refuses_invalid_names(tmp_path: Path, name: str) -> None:
    result = CliRunner().invoke(grants, ["init", str(tmp_path / "pki"), "--node", name])
    assert result.exit_code == 1
    assert f"node: {name!r} is not a valid node name" in result.output
    assert not (tmp_path / "pki" / "nodes").exists()
    with pytest.raises(InvalidObject, match=r"spec\.instance"):
        StandalonePki.open(tmp_path / "pki").component(component_identity("ns", "app", "Navigator", name))


def test_standalone_pki_is_created_once(tmp_path: Path) -> None:
    pki = StandalonePki.create(tmp_path)
    folder = pki.component(component_identity("ns", "app", "Navigator", "app-navigator"))
    assert folder.name == "ns.app-navigator"
    before = (folder / "tls.crt").read_bytes()
    two = StandalonePki.create(tmp_path)
    assert (
        two.component(component_identity("ns", "app", "Navigator", "app-navigator")) / "tls.crt"
    ).read_bytes() == before
    names = x509.load_pem_x509_certificate((two.node("d") / "tls.crt").read_bytes()).extensions
    uris = names.get_extension_for_class(x509.SubjectAlternativeName).value
    assert node_identity("d") in uris.get_values_for_type(x509.UniformResourceIdentifier)


def test_mission_id_is_signed_and_kept_with_the_grant() -> None:
    signer = GrantSigner(CA, lambda: NOW)
    first = signer.sign(manifest())
    assert grant(first).spec.mission == "u1"
    unnamed = {**manifest(), "metadata": {"name": "g"}}
    created = signer.sign(unnamed)
    assert len(created["spec"]["mission"]) == 36
    again = signer.sign(unnamed, grant(created))
    assert again["spec"]["mission"] == created["spec"]["mission"]
    assert signer.sign(unnamed)["spec"]["mission"] != created["spec"]["mission"]
    moved = {**unnamed, "spec": {**unnamed["spec"], "node": "drone-2"}}
    assert signer.sign(moved, grant(created))["spec"]["mission"] != created["spec"]["mission"]
    forged = {**first, "spec": {**first["spec"], "mission": "u2"}}
    with pytest.raises(BadSignature, match="changed"):
        verify(grant(forged), CAS)


def test_mission_key_differs_between_instances(node: Node) -> None:
    first = signed()
    second = signed(instance="app-b", component="B", mission="u1")
    second["metadata"]["uid"] = first["metadata"]["uid"] = "u1"
    assert grant(second).spec.mission_key != grant(first).spec.mission_key


def test_tour_without_operation_area_is_not_signed() -> None:
    with pytest.raises(InvalidObject, match="a tour needs operationArea"):
        signed(operationArea=[], tour=[{"lat": 39.36, "lon": 22.95, "alt": 10}], **{"class": None})


@pytest.mark.parametrize("component_class", ["driver", "passenger"])
def test_grant_without_operation_area_is_neither_signed_nor_accepted(component_class: str) -> None:
    with pytest.raises(InvalidObject, match=f"a {component_class} needs operationArea"):
        signed(operationArea=[], **{"class": component_class})
    body = signed()
    body["spec"].pop("operationArea")
    with pytest.raises(BadSignature, match="does not bound its drone"):
        verify(grant(body), CAS)


def test_policy_without_zone_area_is_not_signed() -> None:
    fence = {"name": "pool", "spec": {"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": ["pool"]}}}
    for zones in ([], [{"name": "pol", "area": {"circle": {"center": {"lat": 39.36, "lon": 22.95}, "radius": 20}}}]):
        with pytest.raises(InvalidObject, match="policy pool selects pool; add the area"):
            signed(policies=[{**fence, "zones": zones}])


def test_standalone_pki_signs_no_grant_for_node_without_certificate(tmp_path: Path) -> None:
    pki = StandalonePki.create(tmp_path / "pki")
    with pytest.raises(InvalidObject, match="drone-1 has no certificate in this directory"):
        pki.grant(manifest(), tmp_path / "grants")
    pki.node("drone-1")
    assert pki.grant(manifest(), tmp_path / "grants").is_file()
