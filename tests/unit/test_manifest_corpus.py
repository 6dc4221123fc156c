"""Validation of the manifest corpus by `fractus plan`.

A test in tests/integration validates the same corpus by the API server.
"""

import json
import re

import pytest
from corpus import CASES
from fractus_cli.manifests import BadManifest, read_manifests
from fractus_core.api import KINDS, InvalidObject, Zone
from fractus_core.api.model import MAX_OBJECT_BYTES


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.refused)
def test_corpus_manifest_is_accepted_or_refused_with_line(case, tmp_path):
    file = tmp_path / "m.yaml"
    file.write_text(case.text)
    if not case.refused:
        assert read_manifests([file]).objects
        return
    with pytest.raises(BadManifest) as refused:
        read_manifests([file])
    assert case.refused in str(refused.value)
    assert re.match(rf"{re.escape(str(file))}:[1-9]", str(refused.value))
    assert len(str(refused.value).splitlines()) == 1


def test_corpus_has_accepted_and_refused_manifests():
    refused = [case for case in CASES if case.refused]
    assert len(refused) > 90
    assert len(CASES) - len(refused) >= 10


def test_manifest_error_escapes_control_characters(tmp_path):
    file = tmp_path / "m.json"
    body = {"apiVersion": "fractus.dev/v1alpha1", "kind": "Policy", "metadata": {"name": "a\n\x1b[2J\x7f"}, "spec": {}}
    file.write_text(json.dumps(body))
    with pytest.raises(BadManifest, match=re.escape(r"Policy a\n\x1b[2J\x7f: ")) as refused:
        read_manifests([file])
    assert str(refused.value).isprintable()


def test_object_larger_than_etcd_limit_is_refused():
    ring = [{"lat": 50 + i / 1e6, "lon": 4 + i / 1e6} for i in range(10_000)]
    shape = {"polygon": {"exterior": ring, "holes": [ring] * 5}}
    body = {"apiVersion": "fractus.dev/v1alpha1", "kind": "Zone", "metadata": {"name": "z"}, "spec": {"area": shape}}
    with pytest.raises(
        InvalidObject, match=f"bytes as JSON, more than the {MAX_OBJECT_BYTES} that etcd keeps; split it"
    ):
        Zone.from_body(body)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.KIND)
def test_body_that_is_not_an_object_raises_invalid_object(kind):
    for body in ({}, {"spec": 5}, {"metadata": []}, {"metadata": {"name": "a"}, "spec": [[]]}):
        with pytest.raises(InvalidObject):
            kind.from_body(body)
