"""`make env` in a checkout that was moved or copied."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
UV = """#!/bin/sh
mkdir -p .venv/bin
echo "VIRTUAL_ENV='$PWD/.venv'" > .venv/bin/activate
echo "$1" >> uv.log
"""


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """Return a checkout with an environment that was created by `make env`, with a replacement for uv."""
    checkout = tmp_path / "checkout"
    (checkout / "sim").mkdir(parents=True)
    shutil.copy(ROOT / "Makefile", checkout)
    for name in ("pyproject.toml", "sim/pyproject.toml", "uv.lock"):
        (checkout / name).touch()
    (checkout / "uv").write_text(UV)
    (checkout / "uv").chmod(0o755)
    _make_env(checkout)
    return checkout


def _make_env(checkout: Path) -> str:
    command = ["make", "UV=./uv", "env"]
    done = subprocess.run(command, cwd=checkout, capture_output=True, text=True, timeout=30, check=True)
    return done.stderr


def test_environment_is_kept_in_an_unmoved_checkout(checkout: Path) -> None:
    assert not _make_env(checkout)
    assert (checkout / "uv.log").read_text() == "sync\n"


def test_environment_of_another_place_is_created_again_in_a_moved_checkout(checkout: Path) -> None:
    moved = checkout.rename(checkout.with_name("moved"))
    (moved / ".venv" / "old").touch()
    assert "this checkout was moved or copied" in _make_env(moved)
    assert not (moved / ".venv" / "old").exists()
    assert f"'{moved}/.venv'" in (moved / ".venv" / "bin" / "activate").read_text()
    assert not _make_env(moved)
