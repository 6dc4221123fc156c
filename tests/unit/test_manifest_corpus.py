"""The corpus of manifests as `fractus plan` judges it; tests/integration has the API server's verdicts."""

import json
import re

import pytest
from corpus import CASES
from fractus_cli.manifests import BadManifest, read_manifests
from fractus_core.api import KINDS, InvalidObject, Zone
from fractus_core.api.model import MAX_OBJECT_BYTES


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.refused)
def test_manifests_are_taken_or_refused_with_their_sentence_and_line(case, tmp_path):
    file = tmp_path / "m.yaml"
    file.write_text(case.text)
    if not case.refused:
        assert read_manifests([file]).found
        return
    with pytest.raises(BadManifest) as refused:
        read_manifests([file])
    assert case.refused in str(refused.value)
    assert re.match(rf"{re.escape(str(file))}:[1-9]", str(refused.value))
    assert len(str(refused.value).splitlines()) == 1


def test_the_corpus_has_both_verdicts():
    refused = [case for case in CASES if case.refused]
    assert len(refused) > 90
    assert len(CASES) - len(refused) >= 10


def test_a_sentence_has_no_characters_that_a_terminal_acts_on(tmp_path):
    file = tmp_path / "m.json"
    body = {"apiVersion": "fractus.dev/v1alpha1", "kind": "Policy", "metadata": {"name": "a\n\x1b[2J\x7f"}, "spec": {}}
    file.write_text(json.dumps(body))
    with pytest.raises(BadManifest, match=re.escape(r"Policy a\n\x1b[2J\x7f: ")) as refused:
        read_manifests([file])
    assert str(refused.value).isprintable()


def test_an_object_that_etcd_does_not_take_is_refused():
    ring = [{"lat": 50 + i / 1e6, "lon": 4 + i / 1e6} for i in range(10_000)]
    shape = {"polygon": {"exterior": ring, "holes": [ring] * 5}}
    body = {"apiVersion": "fractus.dev/v1alpha1", "kind": "Zone", "metadata": {"name": "z"}, "spec": {"area": shape}}
    with pytest.raises(
        InvalidObject, match=f"bytes as JSON, more than the {MAX_OBJECT_BYTES} that etcd keeps; split it"
    ):
        Zone.from_body(body)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.KIND)
def test_what_is_no_object_has_a_sentence(kind):
    for body in ({}, {"spec": 5}, {"metadata": []}, {"metadata": {"name": "a"}, "spec": [[]]}):
        with pytest.raises(InvalidObject):
            kind.from_body(body)
