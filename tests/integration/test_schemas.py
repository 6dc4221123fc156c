"""Objects of the charts and the operator match the schemas of each supported version of Kubernetes.

An API server drops unknown fields without a message, so only a strict schema check finds them.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml
from chart import CHARTS, EVERYTHING, render
from fractus_cluster.binaries import KUBERNETES_VERSIONS
from kubernetes_validate import utils, validate
from kubernetes_validate.utils import SchemaNotFoundError, ValidationError

Body = dict[str, Any]

VERSIONS = ("1.32", *KUBERNETES_VERSIONS)
"""Oldest supported version of Kubernetes (docs/clusters.md), and the versions of embedded clusters."""

OTHER_GROUPS = {"fractus.dev", "monitoring.coreos.com"}
"""API groups without schemas in Kubernetes. Other tests apply objects of `fractus.dev` to an API server."""

GOLDEN = Path(__file__).parents[1] / "golden" / "operator" / "expected"


@cache
def rendered(source: str) -> tuple[Body, ...]:
    """Return the objects of a chart or of the operator's golden files."""
    match source:
        case "fractus with everything":
            return tuple(render(f"--values={EVERYTHING['fractus']}", "--is-upgrade"))
        case "fractus-demo":
            return tuple(render(f"--values={EVERYTHING[source]}", chart=source))
        case "operator":
            return tuple(yaml.safe_load(path.read_text()) for path in sorted(GOLDEN.glob("*.yaml")))
        case _:
            return tuple(render(chart=source))


@pytest.fixture(scope="module", autouse=True)
def schemas_read_once() -> Iterator[None]:
    """Read each schema once. The library would read the definitions of all kinds again for each object."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(utils, "schema_contents", cache(utils.schema_contents))
        yield


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("source", ["fractus", "fractus with everything", "fractus-crds", "fractus-demo", "operator"])
def test_rendered_objects_match_kubernetes_schemas(source: str, version: str) -> None:
    errors = []
    validated = 0
    for body in rendered(source):
        name = f"{body['kind']} {body['metadata']['name']}"
        try:
            assert validate(body, version, strict=True) == version
            validated += 1
        except SchemaNotFoundError:
            assert body["apiVersion"].split("/")[0] in OTHER_GROUPS, f"Kubernetes {version} has no {name}"
        except ValidationError as error:
            errors.append(f"{name}: {error.json_path}: {error.message}")
    assert not errors, "\n".join(errors)
    assert validated


def test_schema_tests_include_every_chart() -> None:
    assert {path.name for path in CHARTS.iterdir()} == {"fractus", "fractus-crds", "fractus-demo"}


@pytest.mark.parametrize("version", VERSIONS)
def test_schema_validation_detects_unknown_field_and_wrong_type(version: str) -> None:
    deployment = next(body for body in rendered("fractus") if body["kind"] == "Deployment")
    misspelled = copy.deepcopy(deployment)
    of_another_type = copy.deepcopy(deployment)
    misspelled["spec"]["template"]["spec"]["containers"][0]["readynessProbe"] = {}
    of_another_type["spec"]["replicas"] = "two"
    for body, named in ((misspelled, "readynessProbe"), (of_another_type, "two")):
        with pytest.raises(ValidationError, match=named):
            validate(body, version, strict=True)
