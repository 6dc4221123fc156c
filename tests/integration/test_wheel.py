"""Wheels: contents and requirements, and strict type checks of the examples against the installed wheels."""

from __future__ import annotations

import email
import shutil
import subprocess
import sys
import venv
from pathlib import Path
from zipfile import ZipFile

import pytest

ROOT = Path(__file__).parents[2]
TESTING = ROOT / "examples" / "testing"
GENERATED_CLIENT = ROOT / "examples" / "flights"
"""Example that imports a client which its user generates. `test_management_client.py` generates it and runs the example."""

EXAMPLES = sorted({path.parent for path in (ROOT / "examples").rglob("*.py")} - {TESTING, GENERATED_CLIENT})
SIMULATOR = ("cluster", "pytest", "radio", "sim", "testing", "vehicle", "world")
SHIPPED = ("agent", "cli", "core", "management", "operator", "proto", "runtime", "services", "view")
pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Build the wheels of both distributions, and return their paths by name."""
    folder = tmp_path_factory.mktemp("wheels")
    uv = shutil.which("uv") or str(ROOT / ".tools" / "bin" / "uv")
    built = subprocess.run(
        [uv, "build", "--wheel", "--all-packages", "--offline", "--out-dir", folder, ROOT],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if built.returncode != 0:
        pytest.skip(
            f"the wheels cannot be built, possibly because uv's cache lacks the build backend: {built.stderr[-300:]}"
        )
    return {path.name.partition("-")[0]: path for path in folder.glob("*.whl")}


def site_packages(interpreter: Path) -> Path:
    """Return the directory of the packages of a virtual environment."""
    (packages,) = (interpreter.parents[1] / "lib").glob("python*/site-packages")
    return packages


@pytest.fixture(scope="module")
def interpreter(wheels: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Python interpreter in whose environment only the wheel fractus-drones is installed."""
    folder = tmp_path_factory.mktemp("wheel")
    venv.create(folder / "venv", with_pip=False)
    python = folder / "venv" / "bin" / "python"
    shutil.unpack_archive(wheels["fractus_drones"], site_packages(python), format="zip")
    return python


@pytest.fixture(scope="module")
def testing_interpreter(wheels: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Python interpreter in whose environment both wheels and pytest are installed, as for tests of applications."""
    folder = tmp_path_factory.mktemp("wheels-testing")
    venv.create(folder / "venv", with_pip=False)
    python = folder / "venv" / "bin" / "python"
    packages = site_packages(python)
    for wheel in wheels.values():
        shutil.unpack_archive(wheel, packages, format="zip")
    for name in ("pytest", "_pytest"):
        (packages / name).symlink_to(Path(pytest.__file__).parents[1] / name)
    return python


def contents(wheel: Path) -> set[str]:
    """Return the top-level names in a wheel, except its metadata."""
    with ZipFile(wheel) as archive:
        return {name.split("/")[0] for name in archive.namelist() if ".dist-info/" not in name}


def test_shipped_wheel_has_no_simulator(wheels: dict[str, Path]) -> None:
    assert wheels.keys() == {"fractus_drones", "fractus_sim"}
    shipped = {"fractus"} | {f"fractus_{name}" for name in SHIPPED}
    assert contents(wheels["fractus_drones"]) == shipped
    assert contents(wheels["fractus_sim"]) == {f"fractus_{name}" for name in SIMULATOR}


def test_shipped_wheel_does_not_require_simulator_or_its_libraries(wheels: dict[str, Path]) -> None:
    with ZipFile(wheels["fractus_drones"]) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith("METADATA"))
        metadata = email.message_from_bytes(archive.read(name))
    required = " ".join(metadata.get_all("Requires-Dist", []))
    assert not [library for library in ("fractus-sim", "matplotlib", "pytest", "scipy") if library in required]
    assert set(metadata.get_all("Provides-Extra", [])) == {
        "agent", "geometry", "keys", "kube", "management", "mobility", "model", "operator", "services", "tracing", "view",
    }  # fmt: skip


def mypy(interpreter: Path, folder: Path, *files: Path) -> subprocess.CompletedProcess[str]:
    """Run mypy in strict mode on files, with the packages of an interpreter."""
    return subprocess.run(
        [
            sys.executable, "-m", "mypy", "--config-file=", "--strict", "--python-executable", interpreter,
            "--cache-dir", interpreter.parents[2] / "cache", *files,
        ],
        capture_output=True, text=True, check=False, cwd=folder,
    )  # fmt: skip


@pytest.mark.parametrize("folder", EXAMPLES, ids=lambda folder: folder.name)
def test_examples_pass_strict_type_checks_against_the_wheel(interpreter: Path, folder: Path) -> None:
    result = mypy(interpreter, folder, *folder.glob("*.py"))
    assert result.returncode == 0, result.stdout + result.stderr


def test_examples_of_tests_pass_strict_type_checks_against_both_wheels(testing_interpreter: Path) -> None:
    result = mypy(testing_interpreter, TESTING, *TESTING.glob("*.py"))
    assert result.returncode == 0, result.stdout + result.stderr


def test_wheel_has_type_information(interpreter: Path, tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(
        "import fractus\n\n\nasync def fly(drone: fractus.Mobility) -> None:\n    await drone.takeoff('high')\n"
    )
    result = mypy(interpreter, tmp_path, program)
    assert result.returncode == 1
    assert 'Argument 1 to "takeoff" of "Mobility" has incompatible type "str"' in result.stdout
