"""Image layouts, archives without known layers, and detection of changed sources."""

from __future__ import annotations

import io
import json
import re
import shutil
import tarfile
from pathlib import Path

import pytest
import yaml
from fractus_cluster.errors import ClusterError
from fractus_cluster.images.build import TARGETS, build_images, find_source, image_name, source_digest
from fractus_cluster.images.layout import Layout

ROOT = Path(__file__).parents[2]
NAME = "localhost/test/tool:1"


@pytest.fixture
def layout(tmp_path: Path) -> Layout:
    """Layout with one image."""
    program = tmp_path / "tool"
    program.write_bytes(b"\x7fELF tool")
    image_layout = Layout(tmp_path / "layout")
    image_layout.add_program(NAME, program)
    return image_layout


def archive_of(layout: Layout, without: set[str]) -> tarfile.TarFile:
    """Return an opened archive of the image, without the given layers."""
    out = io.BytesIO()
    layout.write_archive([layout.image(NAME)], without=without, out=out)
    out.seek(0)
    return tarfile.open(fileobj=out)


def test_program_is_entry_point_of_its_image(layout: Layout) -> None:
    layer, config, manifest = layout.digests(layout.image(NAME))
    with tarfile.open(layout.blob(layer)) as files:
        assert [(member.name, member.mode) for member in files] == [("tool", 0o755)]
    described = json.loads(layout.blob(config).read_text())
    assert described["config"]["Entrypoint"] == ["/tool"]
    assert described["rootfs"]["diff_ids"] == [layer]
    assert json.loads(layout.blob(manifest).read_text())["config"]["digest"] == config


def test_same_program_gives_the_same_image(layout: Layout, tmp_path: Path) -> None:
    before = layout.image(NAME)
    assert layout.add_program(NAME, tmp_path / "tool") == before
    assert len(layout.images()) == 1
    (tmp_path / "tool").write_bytes(b"\x7fELF other")
    assert layout.add_program(NAME, tmp_path / "tool").digest != before.digest


def test_archive_names_image_by_tag_and_by_digest(layout: Layout) -> None:
    digest = layout.image(NAME).digest
    with archive_of(layout, set()) as archive:
        index = json.load(archive.extractfile("index.json") or io.BytesIO())
    names = [entry["annotations"]["io.containerd.image.name"] for entry in index["manifests"]]
    assert names == [NAME, f"localhost/test/tool@{digest}"]


def test_archive_omits_layers_of_the_receiver(layout: Layout) -> None:
    digests = layout.digests(layout.image(NAME))
    with archive_of(layout, set()) as whole:
        blobs = {name for name in whole.getnames() if name.startswith("blobs/")}
        assert blobs == {f"blobs/{digest.replace(':', '/')}" for digest in digests}
    with archive_of(layout, {digests[0]}) as rest:
        assert f"blobs/{digests[0].replace(':', '/')}" not in rest.getnames()
        index = json.loads((rest.extractfile("index.json") or pytest.fail("no index")).read())
        assert index["manifests"][0]["annotations"]["io.containerd.image.name"] == NAME


def test_unused_blobs_are_removed(layout: Layout, tmp_path: Path) -> None:
    old = layout.digests(layout.image(NAME))
    (tmp_path / "tool").write_bytes(b"\x7fELF other")
    layout.add_program(NAME, tmp_path / "tool")
    layout.remove_unused()
    assert not any(layout.blob(digest).exists() for digest in old)
    assert all(layout.blob(digest).exists() for digest in layout.digests(layout.image(NAME)))


def test_error_names_the_missing_image(layout: Layout) -> None:
    with pytest.raises(ClusterError, match="no image nothing:1"):
        layout.image("nothing:1")


def test_every_target_is_in_the_dockerfile() -> None:
    stages = {
        line.split(" AS ")[1].strip()
        for line in (ROOT / "Dockerfile").read_text().splitlines()
        if line.startswith("FROM ")
    }
    assert set(TARGETS) <= stages


def test_release_images_name_the_base_digest_on_which_they_are_built() -> None:
    workflow = yaml.safe_load((ROOT / ".github/workflows/release.yaml").read_text())
    scripts = [step["run"] for job in workflow["jobs"].values() for step in job["steps"] if "run" in step]
    (inspect_step,) = [n for n, script in enumerate(scripts) if "imagetools inspect" in script]
    (build_step,) = [n for n, script in enumerate(scripts) if script.startswith("make dist")]
    assert inspect_step < build_step
    makefile = (ROOT / "Makefile").read_text()
    assert '$(if $(BASE),--build-arg "BASE=$(BASE)")' in makefile
    assert '--output "type=oci,rewrite-timestamp=true,' in makefile
    assert 'echo "SOURCE_DATE_EPOCH=' in scripts[inspect_step]
    dockerfile = (ROOT / "Dockerfile").read_text()
    assert "FROM ${BASE} AS base\nARG BASE\nLABEL org.opencontainers.image.base.name=${BASE}\n" in dockerfile
    (base,) = re.findall(r"^ARG BASE=(.+)$", dockerfile, re.MULTILINE)
    assert f"imagetools inspect {base} " in scripts[inspect_step]
    assert f'echo "BASE={base}@$digest" >> "$GITHUB_ENV"' in scripts[inspect_step]


def test_actions_of_workflows_with_write_permission_are_pinned_to_commits() -> None:
    """Without a pinned commit, an attacker could move the tag of an action.

    The code of the attacker could then sign and push images with the permissions of the release workflow.
    """
    for path in (ROOT / ".github/workflows").iterdir():
        workflow = yaml.safe_load(path.read_text())
        for job in workflow["jobs"].values():
            if "write" in (job.get("permissions") or workflow["permissions"]).values():
                actions = [step["uses"] for step in job["steps"] if "uses" in step]
                assert [action for action in actions if not re.fullmatch("[^@]+@[0-9a-f]{40}", action)] == []


def test_every_image_of_the_examples_can_be_built() -> None:
    manifests = (ROOT / "examples").rglob("*.yaml")
    named = {name for path in manifests for name in re.findall(r"image: localhost/fractus/(\S+):dev", path.read_text())}
    assert "example-field" in named
    assert named <= set(TARGETS)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """Small checkout with sources of images."""
    for name in ("Dockerfile", ".dockerignore", "pyproject.toml", "uv.lock", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, tmp_path / name)
    for folder in ("core", "runtime", "operator", "agent", "services", "sdk", "proto", "sim"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "module.py").write_text(f"ROOM = {folder!r}\n")
    (tmp_path / "examples" / "traffic-monitoring").mkdir(parents=True)
    return tmp_path


@pytest.mark.parametrize(
    ("changed", "stale"),
    [
        ("core/module.py", set(TARGETS)),
        ("uv.lock", set(TARGETS)),
        ("sim/module.py", {"sim"}),
        ("examples/traffic-monitoring/navigator.py", {"example-traffic-monitoring"}),
        ("core/__pycache__/module.pyc", set()),
    ],
)
def test_changed_file_makes_its_images_stale(checkout: Path, changed: str, stale: set[str]) -> None:
    before = {target: source_digest(checkout, target) for target in TARGETS}
    (checkout / changed).parent.mkdir(exist_ok=True)
    with (checkout / changed).open("a") as file:
        file.write("# changed\n")
    assert {target for target in TARGETS if source_digest(checkout, target) != before[target]} == stale


def test_source_is_found_from_a_subfolder(checkout: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    assert find_source(checkout / "core") == checkout
    with pytest.raises(ClusterError, match="--source"):
        find_source(tmp_path_factory.mktemp("elsewhere"))


def test_unknown_target_is_refused(checkout: Path) -> None:
    with pytest.raises(ClusterError, match="unknown image plane"):
        build_images(checkout, targets=["plane"], report=print)


def test_image_name_has_registry_and_tag() -> None:
    assert image_name("agent") == "localhost/fractus/agent:dev"
