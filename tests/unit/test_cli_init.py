"""`fractus init` and `fractus schema`: files of a new application, and the JSON schema of manifests."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml
from click.testing import CliRunner
from fractus_cli.init import init
from fractus_cli.manifests import read_manifests
from fractus_cli.schema import schema

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted(
    path for path in (ROOT / "examples").rglob("*.yaml") if path.parent.name not in {"clusters", "experiments"}
)


@pytest.fixture(scope="module")
def validator() -> jsonschema.Draft7Validator:
    text = CliRunner().invoke(schema, catch_exceptions=False).output
    return jsonschema.Draft7Validator(json.loads(text))


def test_schema_of_examples_is_current() -> None:
    text = CliRunner().invoke(schema, catch_exceptions=False).output
    assert (ROOT / "examples" / "fractus.schema.json").read_text() == text, "run `make generate`"


def documents(path: Path) -> list[dict[str, Any]]:
    return [body for body in yaml.safe_load_all(path.read_text()) if body]


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_schema_accepts_manifests_of_examples(path: Path, validator: jsonschema.Draft7Validator) -> None:
    for body in documents(path):
        assert list(validator.iter_errors(body)) == []


@pytest.mark.parametrize(
    ("change", "field"),
    [({"placment": "drone"}, "placment"), ({"placement": "dron"}, "dron"), ({"container": {"image": 5}}, "5")],
)
def test_schema_names_wrong_field(change: dict[str, Any], field: str, validator: jsonschema.Draft7Validator) -> None:
    (body,) = documents(ROOT / "examples/traffic-monitoring/application.yaml")
    body["spec"]["components"][0].update(change)
    (error,) = validator.iter_errors(body)
    assert field in error.message


def test_schema_refuses_unknown_kind_and_ignores_other_groups(validator: jsonschema.Draft7Validator) -> None:
    assert validator.is_valid({"apiVersion": "apps/v1", "kind": "Deployment", "spec": {"replicas": 1}})
    assert not validator.is_valid(
        {"apiVersion": "fractus.dev/v1alpha1", "kind": "Aplication", "metadata": {"name": "a"}}
    )


def test_init_writes_manifests_that_can_be_planned(tmp_path: Path, validator: jsonschema.Draft7Validator) -> None:
    directory = tmp_path / "survey"
    result = CliRunner().invoke(init, ["my-survey", "--directory", str(directory)], catch_exceptions=False)
    assert result.exit_code == 0
    assert "fractus experiment run flight.yaml" in result.output
    for name in ("application.yaml", "place.yaml"):
        assert (directory / name).read_text().startswith("# yaml-language-server: $schema=fractus.schema.json\n")
        for body in documents(directory / name):
            assert validator.is_valid(body)
    (application,) = read_manifests([directory / "application.yaml", directory / "place.yaml"]).applications()
    assert application.name == "my-survey"
    compile((directory / "navigator.py").read_text(), "navigator.py", "exec")


@pytest.mark.parametrize("name", ["My-Survey", "survey_1", "", "-a"])
def test_init_refuses_name_that_kubernetes_refuses(name: str, tmp_path: Path) -> None:
    result = CliRunner().invoke(init, ["--directory", str(tmp_path / "new"), "--", name])
    assert result.exit_code == 1
    assert "lowercase letters, digits and hyphens" in result.output
    assert not (tmp_path / "new").exists()


def test_init_keeps_files_of_existing_directory(tmp_path: Path) -> None:
    (tmp_path / "navigator.py").write_text("mine")
    result = CliRunner().invoke(init, ["survey", "--directory", str(tmp_path)])
    assert result.exit_code == 1
    assert "is not empty" in result.output
    assert (tmp_path / "navigator.py").read_text() == "mine"


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_test_of_new_application_passes(tmp_path: Path) -> None:
    CliRunner().invoke(init, ["survey", "--directory", str(tmp_path / "survey")], catch_exceptions=False)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "."]
    result = subprocess.run(command, cwd=tmp_path / "survey", capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout
