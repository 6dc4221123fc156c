"""What the charts and the operator make, against the schemas of each version of Kubernetes: of a field that it does not know, an
API server says nothing and drops it."""

from __future__ import annotations

import copy
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml
from chart import CHARTS, EVERYTHING, render
from fractus_cluster.binaries import KUBERNETES_VERSIONS
from kubernetes_validate import validate
from kubernetes_validate.utils import SchemaNotFoundError, ValidationError

Body = dict[str, Any]

VERSIONS = ("1.32", *KUBERNETES_VERSIONS)
"""The oldest that docs/clusters.md promises, and those that clusters are built of."""

ELSEWHERE = {"fractus.dev", "monitoring.coreos.com"}
"""Groups of kinds that are not of Kubernetes: ours are the examples', which API servers take in other tests."""

GOLDEN = Path(__file__).parents[1] / "golden" / "operator" / "expected"


@cache
def made(what: str) -> tuple[Body, ...]:
    """Objects that a version is asked about."""
    match what:
        case "fractus with everything":
            return tuple(render(f"--values={EVERYTHING['fractus']}", "--is-upgrade"))
        case "fractus-demo":
            return tuple(render(f"--values={EVERYTHING[what]}", chart=what))
        case "operator":
            return tuple(yaml.safe_load(path.read_text()) for path in sorted(GOLDEN.glob("*.yaml")))
        case _:
            return tuple(render(chart=what))


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("what", ["fractus", "fractus with everything", "fractus-crds", "fractus-demo", "operator"])
def test_rendered_objects_match_kubernetes_schemas(what: str, version: str) -> None:
    wrong = []
    asked = 0
    for body in made(what):
        name = f"{body['kind']} {body['metadata']['name']}"
        try:
            assert validate(body, version, strict=True) == version
            asked += 1
        except SchemaNotFoundError:
            assert body["apiVersion"].split("/")[0] in ELSEWHERE, f"Kubernetes {version} has no {name}"
        except ValidationError as error:
            wrong.append(f"{name}: {error.json_path}: {error.message}")
    assert not wrong, "\n".join(wrong)
    assert asked


def test_schema_tests_include_every_chart() -> None:
    assert {path.name for path in CHARTS.iterdir()} == {"fractus", "fractus-crds", "fractus-demo"}


@pytest.mark.parametrize("version", VERSIONS)
def test_schema_validation_detects_unknown_field_and_wrong_type(version: str) -> None:
    deployment = next(body for body in made("fractus") if body["kind"] == "Deployment")
    misspelled = copy.deepcopy(deployment)
    of_another_type = copy.deepcopy(deployment)
    misspelled["spec"]["template"]["spec"]["containers"][0]["readynessProbe"] = {}
    of_another_type["spec"]["replicas"] = "two"
    for body, named in ((misspelled, "readynessProbe"), (of_another_type, "two")):
        with pytest.raises(ValidationError, match=named):
            validate(body, version, strict=True)
