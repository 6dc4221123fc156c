"""Fuzz manifests. Each file is refused with one sentence, or each of its Applications is planned or refused.

The input is the content of a file, or selects changes of the example's objects: values, location, spelling. Such changes reach
deeper than arbitrary bytes. Plans can be serialised, and their Grants can be compiled.
"""

from __future__ import annotations

import contextlib
import copy
import json
import logging
import math
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import atheris

with atheris.instrument_imports(
    include=["fractus_core", "fractus_cli.manifests", "fractus_cli.offline_planner", "yaml"]
):
    from fractus_cli.manifests import BadManifest, read_manifests
    from fractus_cli.offline_planner import plan_all
    from fractus_core.api.grants import GrantSpec
    from fractus_core.api.nodes import Drone, EdgeNode, InvalidDescription, parse_description
    from fractus_core.documents import dump_documents, parse_documents
    from fractus_core.planning import Settings
    from fractus_core.planning.grant_compiler import compile_grants
    from fractus_core.policy.compiled_grant import compile_grant

FOLDER = Path(tempfile.mkdtemp())
YAML = FOLDER / "manifest.yaml"
JSON = FOLDER / "manifest.json"
EXAMPLES = Path(__file__).parents[2] / "examples" / "traffic-monitoring"
KINDS = {"Application", "Depot", "Drone", "EdgeNode", "Policy", "Zone"}
OBJECTS = [
    body
    for file in sorted(EXAMPLES.glob("*.yaml"))
    for body in parse_documents(file.read_bytes(), str(file)).values
    if isinstance(body, dict) and body.get("kind") in KINDS and file.name != "passenger-only.yaml"
]
NEAR_DEG = 0.01
HOME_DEG = (50.8650, 4.6805)
ELSEWHERE_DEG = [(0.0, 180.0), (-52.0, -180.0), (80.0, 180.0), (89.0, 0.0), (-89.0, 60.0), (0.0, 0.0)]
SPELLINGS = [
    ".nan", "-.inf", ".INF", "1e999", "-0", "0x7f", "0o17", "017", "1_000", "9" * 400, "1e-400", "12:30:00", "2026-01-01", "yes", "~", "=",
    "&a", "*a", "&a [*a]", "{<<: *a}", "<<", "!!python/object:os.system {}", "!!binary AA==", "!!float 1", "!x 1", "|", ">-", "'", '"\\ud800"',
    '"\\0"', "\t", "[" * 200, "{" * 50, "- - -", "? x", "{1: 2}", "{[a]: b}", "{a: 1, a: 2}", "---", "...", "%YAML 1.1", "# x", "\ufeff", "\x85",
]  # fmt: skip
logging.disable(logging.CRITICAL)

Place = tuple[Any, Any]
"""A list or object, and the index or key of a value in it."""


def places(inside: Any) -> Iterator[Place]:
    """Return the positions of all values in some objects, except kind and API version."""
    for key, value in inside.items() if isinstance(inside, dict) else enumerate(inside):
        if key not in {"apiVersion", "kind"}:
            yield inside, key
        if isinstance(value, dict | list):
            yield from places(value)


def move(inside: Any, lat: float, lon: float) -> None:
    """Move the example without changing its shape, for example across the antimeridian or near a pole."""
    for part in inside.values() if isinstance(inside, dict) else inside:
        if isinstance(part, dict | list):
            move(part, lat, lon)
    if isinstance(inside, dict) and {"lat", "lon"} <= inside.keys():
        narrower = math.cos(math.radians(HOME_DEG[0])) / math.cos(math.radians(lat))
        east = (inside["lon"] - HOME_DEG[1]) * narrower + lon
        inside["lat"] = inside["lat"] - HOME_DEG[0] + lat
        inside["lon"] = (east + 180.0) % 360.0 - 180.0


def changed(data_provider: atheris.FuzzedDataProvider) -> list[Any]:
    """Return the example with a few changed values."""
    objects = copy.deepcopy(OBJECTS)
    if not data_provider.ConsumeIntInRange(0, 3):
        move(objects, *data_provider.PickValueInList(ELSEWHERE_DEG))
    for _ in range(data_provider.ConsumeIntInRange(0, 6)):
        if not (places_ := list(places(objects))):
            break
        inside, key = places_[data_provider.ConsumeIntInRange(0, len(places_) - 1)]
        how = data_provider.ConsumeIntInRange(0, 9)
        if how == 0:
            del inside[key]
        elif how == 1 and isinstance(inside, list):
            inside.append(copy.deepcopy(inside[key]))
        elif how <= 3:
            other, other_key = places_[data_provider.ConsumeIntInRange(0, len(places_) - 1)]
            inside[key] = copy.deepcopy(other[other_key])
        else:
            inside[key] = value(data_provider, inside[key])
    return objects


def value(data_provider: atheris.FuzzedDataProvider, before: Any) -> Any:
    """Return a different value, often of the same type."""
    if isinstance(before, bool):
        return not before
    if isinstance(before, int | float) and data_provider.ConsumeBool():
        if isinstance(before, float) and data_provider.ConsumeBool():
            return before + data_provider.ConsumeFloatInRange(-NEAR_DEG, NEAR_DEG)
        return data_provider.PickValueInList(
            [0, -1, 1, 89.9999, -90, 180, -180, 1e-9, 1e9, 1e300, 2**63, before * 10, -before]
        )
    if isinstance(before, str) and data_provider.ConsumeBool():
        return data_provider.ConsumeUnicodeNoSurrogates(20)
    return data_provider.PickValueInList(
        [None, "", "x" * 300, 0, 1.5, True, [], {}, [[]], {"": {}}, "é\n", "1e3", "5m", "-1", math.nan, math.inf]
    )


def respelt(data_provider: atheris.FuzzedDataProvider) -> str:
    """Return the changed example with unusual YAML spellings, sometimes after a document with nested aliases."""
    text = dump_documents(changed(data_provider))
    lines = text.splitlines()
    for _ in range(data_provider.ConsumeIntInRange(0, 4)):
        at = data_provider.ConsumeIntInRange(0, len(lines) - 1)
        name, colon, rest = lines[at].partition(": ")
        put = data_provider.PickValueInList(SPELLINGS)
        lines[at] = f"{name}{colon}{put} {rest if data_provider.ConsumeBool() else ''}"
    if not data_provider.ConsumeIntInRange(0, 3):
        return bomb(data_provider.ConsumeIntInRange(1, 40), data_provider.ConsumeIntInRange(1, 40)) + "\n".join(lines)
    return "\n".join(lines)


def bomb(levels: int, width: int) -> str:
    """Return a document with nested aliases (billion laughs)."""
    lists = [f"  l{i}: &l{i} [{', '.join([f'*l{i - 1}' if i else 'x'] * width)}]\n" for i in range(levels)]
    return "apiVersion: fractus.dev/v1alpha1\nkind: Zone\nmetadata:\n  name: z\nspec:\n" + "".join(lists) + "---\n"


def planned(file: Path) -> None:
    """Read a file and plan its applications."""
    try:
        manifests = read_manifests([file])
        manifests.inventory()
        if manifests.applications():
            for decided in plan_all(manifests, Settings()):
                assert (decided.plan is None) == (decided.refusal is not None)
                if decided.plan is not None:
                    json.dumps(decided.plan.to_dict(), allow_nan=False)
                    for grant in compile_grants(decided.application, decided.plan, manifests.inventory(), Settings()):
                        written = json.dumps(grant.to_dict(), allow_nan=False)
                        compile_grant(GrantSpec.model_validate_json(written))
    except BadManifest as error:
        assert str(error).startswith(str(file)), error
        assert "\n" not in str(error).strip(), error


def fuzz_one(data: bytes) -> None:
    """Read and plan one file."""
    if data[:1] >= b"\x80":  # not the first byte of a UTF-8 character of text
        data_provider = atheris.FuzzedDataProvider(data[1:])
        if data[0] % 2:
            JSON.write_text(json.dumps({"kind": "List", "items": changed(data_provider)}))
            planned(JSON)
        else:
            YAML.write_text(respelt(data_provider), errors="surrogatepass")
            planned(YAML)
        return
    YAML.write_bytes(data)
    planned(YAML)
    with contextlib.suppress(InvalidDescription):
        parse_description(data.decode(errors="replace"), Drone, EdgeNode)


if __name__ == "__main__":
    atheris.Setup(sys.argv, fuzz_one)
    atheris.Fuzz()
