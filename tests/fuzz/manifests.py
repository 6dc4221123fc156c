"""Manifests as anyone may write them: a sentence says what is wrong, or all their objects are there to plan with."""

from __future__ import annotations

import contextlib
import sys
import tempfile
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["fractus_core", "fractus_cli.manifests", "yaml"]):
    from fractus_cli.manifests import BadManifest, read_manifests
    from fractus_core.api.descriptions import InvalidDescription, parse_description
    from fractus_core.api.nodes import Drone, EdgeNode

FILE = Path(tempfile.mkdtemp()) / "manifest.yaml"


def one(data: bytes) -> None:
    """One file, and the same as the description of a node."""
    FILE.write_bytes(data)
    try:
        read_manifests([FILE]).inventory()
    except BadManifest as error:
        assert str(error).startswith(str(FILE)), error
    with contextlib.suppress(InvalidDescription):
        parse_description(data.decode(errors="replace"), Drone, EdgeNode)


if __name__ == "__main__":
    atheris.Setup(sys.argv, one)
    atheris.Fuzz()
