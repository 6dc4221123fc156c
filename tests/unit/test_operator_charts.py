"""Charts: the installed CRDs match the models, and values are documented and validated."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import pytest
import yaml
from fractus_cli.doctor import MIN_VERSION
from fractus_cluster.images.build import image_name
from fractus_core.api import KINDS
from fractus_core.api.crd import crd

ROOT = Path(__file__).parents[2]
CHARTS = ROOT / "charts"


def test_chart_contains_generated_crds() -> None:
    carried = {
        path.name: yaml.safe_load(path.read_text()) for path in (CHARTS / "fractus-crds" / "files").glob("*.yaml")
    }
    assert {body["metadata"]["name"] for body in carried.values()} == {f"{kind.PLURAL}.fractus.dev" for kind in KINDS}
    for kind in KINDS:
        assert carried[f"{kind.PLURAL}.yaml"] == json.loads(json.dumps(crd(kind))), "run `make generate`"


@pytest.mark.parametrize("chart", ["fractus", "fractus-crds", "fractus-demo"])
def test_chart_values_and_schema_have_same_keys(chart: str) -> None:
    values = yaml.safe_load((CHARTS / chart / "values.yaml").read_text())
    schema = json.loads((CHARTS / chart / "values.schema.json").read_text())

    def compare(value: dict, part: dict, path: str) -> None:
        known = set(part.get("properties", {})) - {"global"}
        assert set(value) == known, path
        for key, inner in value.items():
            below = part["properties"][key]
            if isinstance(inner, dict) and "properties" in below:
                compare(inner, below, f"{path}.{key}")

    compare(values, schema, chart)


def test_chart_version_and_images_match_package() -> None:
    import tomllib

    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    for chart in ("fractus", "fractus-crds", "fractus-demo"):
        described = yaml.safe_load((CHARTS / chart / "Chart.yaml").read_text())
        assert described["version"] == version
        assert image_name("agent", described["appVersion"]) == image_name("agent")


def test_chart_requires_documented_kubernetes_version() -> None:
    least = ".".join(map(str, MIN_VERSION))
    for page in ("README.md", "docs/clusters.md"):
        assert f"Kubernetes {least} or later" in (ROOT / page).read_text()
    for chart in ("fractus", "fractus-crds", "fractus-demo"):
        described = yaml.safe_load((CHARTS / chart / "Chart.yaml").read_text())
        assert described["kubeVersion"] == f">={least}.0-0"


def test_chart_templates_have_default_values() -> None:
    known = (CHARTS / "fractus" / "files" / "values.yaml").read_text()
    assert known == (CHARTS / "fractus" / "values.yaml").read_text(), "run `make generate`"


@pytest.mark.parametrize("chart", ["fractus", "fractus-crds", "fractus-demo"])
def test_chart_readme_lists_values(chart: str) -> None:
    spec = importlib.util.spec_from_file_location("pages", ROOT / "docs" / "pages.py")
    assert spec is not None
    assert spec.loader is not None
    pages = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(pages)
    text = (CHARTS / chart / "README.md").read_text()
    assert text == pages.chart_readme(CHARTS / chart), "run `make generate`"

    def leaves(values: dict, above: str) -> list[str]:
        return [
            name
            for key, value in values.items()
            for name in (leaves(value, f"{above}{key}.") if isinstance(value, dict) and value else [f"{above}{key}"])
        ]

    for name in leaves(yaml.safe_load((CHARTS / chart / "values.yaml").read_text()), ""):
        # A value that is an object may have one row for all its fields.
        assert f"`{name}`" in text or f"`{name.rpartition('.')[0]}`" in text, name
