"""Manifests as anyone may write them: a sentence says what is wrong, or all their applications are planned or refused.

Bytes are read as a file; or they say what to change in the example's objects, which gets further than bytes alone do.
"""

from __future__ import annotations

import contextlib
import copy
import json
import logging
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import atheris

with atheris.instrument_imports(include=["fractus_core", "fractus_cli.manifests", "fractus_cli.planning", "yaml"]):
    from fractus_cli.manifests import BadManifest, read_manifests
    from fractus_cli.planning import plan_all
    from fractus_core.api.descriptions import InvalidDescription, parse_description
    from fractus_core.api.nodes import Drone, EdgeNode
    from fractus_core.documents import parse_documents
    from fractus_core.planning import Settings

FOLDER = Path(tempfile.mkdtemp())
YAML, JSON = FOLDER / "manifest.yaml", FOLDER / "manifest.json"
EXAMPLES = Path(__file__).parents[2] / "examples" / "traffic-monitoring"
KINDS = {"Application", "Depot", "Drone", "EdgeNode", "Policy", "Zone"}
OBJECTS = [
    body
    for file in sorted(EXAMPLES.glob("*.yaml"))
    for body in parse_documents(file.read_bytes(), str(file)).values
    if isinstance(body, dict) and body.get("kind") in KINDS and file.name != "passenger-only.yaml"
]
NEAR_DEG = 0.01
logging.disable(logging.CRITICAL)

Place = tuple[Any, Any]
"""A list or object, and where in it a value is."""


def places(inside: Any) -> Iterator[Place]:
    """Where every value of some objects is, but their kinds."""
    for key, value in inside.items() if isinstance(inside, dict) else enumerate(inside):
        if key not in {"apiVersion", "kind"}:
            yield inside, key
        if isinstance(value, dict | list):
            yield from places(value)


def changed(given: atheris.FuzzedDataProvider) -> list[Any]:
    """The example with a few values that are others."""
    objects = copy.deepcopy(OBJECTS)
    for _ in range(given.ConsumeIntInRange(0, 6)):
        if not (there := list(places(objects))):
            break
        inside, key = there[given.ConsumeIntInRange(0, len(there) - 1)]
        how = given.ConsumeIntInRange(0, 9)
        if how == 0:
            del inside[key]
        elif how == 1 and isinstance(inside, list):
            inside.append(copy.deepcopy(inside[key]))
        elif how <= 3:
            other, there_key = there[given.ConsumeIntInRange(0, len(there) - 1)]
            inside[key] = copy.deepcopy(other[there_key])
        else:
            inside[key] = value(given, inside[key])
    return objects


def value(given: atheris.FuzzedDataProvider, before: Any) -> Any:
    """Another value; of the same type more often than not."""
    if isinstance(before, bool):
        return not before
    if isinstance(before, int | float) and given.ConsumeBool():
        if isinstance(before, float) and given.ConsumeBool():
            return before + given.ConsumeFloatInRange(-NEAR_DEG, NEAR_DEG)
        return given.PickValueInList([0, -1, 1, 89.9999, -90, 180, -180, 1e-9, 1e9, 1e300, 2**63, before * 10, -before])
    if isinstance(before, str) and given.ConsumeBool():
        return given.ConsumeUnicodeNoSurrogates(20)
    return given.PickValueInList([None, "", "x" * 300, 0, 1.5, True, [], {}, [[]], {"": {}}, "é\n", "1e3", "5m", "-1"])


def planned(file: Path) -> None:
    """Read a file, and plan its applications."""
    try:
        manifests = read_manifests([file])
        manifests.inventory()
        if manifests.applications():
            for decided in plan_all(manifests, Settings()):
                assert (decided.plan is None) == (decided.refusal is not None)
    except BadManifest as error:
        assert str(error).startswith(str(file)), error
        assert "\n" not in str(error).strip(), error


def one(data: bytes) -> None:
    """One file."""
    if data[:1] == b"\xff":
        JSON.write_text(json.dumps({"kind": "List", "items": changed(atheris.FuzzedDataProvider(data[1:]))}))
        planned(JSON)
        return
    YAML.write_bytes(data)
    planned(YAML)
    with contextlib.suppress(InvalidDescription):
        parse_description(data.decode(errors="replace"), Drone, EdgeNode)


if __name__ == "__main__":
    atheris.Setup(sys.argv, one)
    atheris.Fuzz()
