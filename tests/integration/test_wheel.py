"""What a user installs: the examples are typed against the wheel, strictly."""

from __future__ import annotations

import shutil
import subprocess
import sys
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted({path.parent for path in (ROOT / "examples").rglob("*.py")})
pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def interpreter(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Python that has the wheel alone."""
    folder = tmp_path_factory.mktemp("wheel")
    uv = shutil.which("uv") or str(ROOT / ".tools" / "bin" / "uv")
    built = subprocess.run(
        [uv, "build", "--wheel", "--offline", "--out-dir", folder, ROOT], capture_output=True, text=True, check=False
    )
    if built.returncode != 0:
        pytest.skip(f"the wheel cannot be built without the build backend in uv's cache: {built.stderr[-300:]}")
    (wheel,) = folder.glob("*.whl")
    venv.create(folder / "venv", with_pip=False)
    (packages,) = (folder / "venv" / "lib").glob("python*/site-packages")
    shutil.unpack_archive(wheel, packages, format="zip")
    return folder / "venv" / "bin" / "python"


def checked(interpreter: Path, folder: Path, *files: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [
            sys.executable, "-m", "mypy", "--config-file=", "--strict", "--python-executable", interpreter,
            "--cache-dir", interpreter.parents[2] / "cache", *files,
        ],
        capture_output=True, text=True, check=False, cwd=folder,
    )  # fmt: skip


@pytest.mark.parametrize("folder", EXAMPLES, ids=lambda folder: folder.name)
def test_examples_are_typed_against_the_wheel(interpreter: Path, folder: Path) -> None:
    done = checked(interpreter, folder, *folder.glob("*.py"))
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_wheel_brings_its_types(interpreter: Path, tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(
        "import fractus\n\n\nasync def fly(drone: fractus.Mobility) -> None:\n    await drone.takeoff('high')\n"
    )
    done = checked(interpreter, tmp_path, program)
    assert done.returncode == 1
    assert 'Argument 1 to "takeoff" of "Mobility" has incompatible type "str"' in done.stdout
