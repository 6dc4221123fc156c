"""Packing of the Grants of a node into one object."""

from __future__ import annotations

import base64
import json
import lzma
import random
import tracemalloc
from typing import Any

import pytest
from fractus_core.api import InvalidObject, grants
from fractus_core.api.grants import MAX_UNPACKED_BYTES, pack, pack_oldest, unpack
from hypothesis import given
from hypothesis import strategies as st

WORDS = st.text(st.characters(codec="utf-8"), max_size=20)
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.floats(allow_nan=False, allow_infinity=False) | WORDS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(WORDS, inner, max_size=4),
    max_leaves=10,
)


def body(name: str, spec: Any = None, **metadata: Any) -> dict[str, Any]:
    return {
        "apiVersion": "fractus.dev/v1alpha1",
        "kind": "Grant",
        "metadata": {"name": name, "uid": f"uid-{name}", "generation": 1, **metadata},
        "spec": {} if spec is None else spec,
    }


def packed(value: Any) -> str:
    return base64.b64encode(lzma.compress(json.dumps(value).encode())).decode()


@given(
    st.dictionaries(st.text("abc", min_size=1), st.dictionaries(WORDS, VALUES, max_size=4), max_size=5), st.randoms()
)
def test_node_grants_are_unpacked_in_name_order(specs: dict[str, Any], random: Any) -> None:
    bodies = [body(name, spec) for name, spec in specs.items()]
    text = pack(bodies)
    assert unpack(text, len(bodies)) == tuple(sorted(bodies, key=lambda each: each["metadata"]["name"]))
    random.shuffle(bodies)
    assert pack(bodies) == text


def test_node_grants_omit_fields_changed_by_reports() -> None:
    signed = body("a", {"node": "drone-1"}, annotations={"fractus.dev/signature": "x"}, labels={"l": "v"})
    changed = {**signed, "status": {"phase": "Active"}}
    changed["metadata"] = {**signed["metadata"], "resourceVersion": "7", "managedFields": [{}], "finalizers": ["f"]}
    assert pack([changed]) == pack([signed])
    assert unpack(pack([changed]), 1) == (signed,)


def test_node_grants_pack_shared_zones_once() -> None:
    area = [[round(0.001 * i, 7), round(0.0013 * i * i % 7, 7)] for i in range(1_500)]
    single_size, large_size = (
        len(pack([body(f"g{i}", {"area": area, "n": i}) for i in range(count)])) for count in (1, 100)
    )
    assert large_size < 3 * single_size


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("no base64!", "cannot be unpacked"),
        ("", "is cut short"),
        (base64.b64encode(b"this is not xz at all").decode(), "cannot be unpacked"),
        (base64.b64encode(lzma.compress(b"[]")[:-8]).decode(), "is cut short"),
        (base64.b64encode(lzma.compress(b"[1")).decode(), "cannot be unpacked"),
        (base64.b64encode(lzma.compress(b"\xff")).decode(), "cannot be unpacked"),
        (base64.b64encode(lzma.compress(b"[" * 100_000)).decode(), "cannot be unpacked"),
        (base64.b64encode(lzma.compress(b"[]", lzma.FORMAT_ALONE)).decode(), "cannot be unpacked"),
        (packed({}), "is not a list of Grants"),
        (packed([1]), "is not a list of Grants"),
        (packed([{"metadata": {"name": "a"}}]), "is not a list of Grants"),
        (packed([{"metadata": None}]), "is not a list of Grants"),
        (packed([{"metadata": {"name": "../a", "uid": "u"}}]), "is not a list of Grants"),
        (packed([{"metadata": {"name": "a" * 254, "uid": "u"}}]), "is not a list of Grants"),
        (packed([{"metadata": {"name": "a", "uid": "u"}}]), "holds 1 Grants, not the 0 of spec.count"),
    ],
)
def test_node_grants_refuse_invalid_packed_data(text: str, reason: str) -> None:
    with pytest.raises(InvalidObject, match=rf"^spec\.packed: {reason}.*; the operator writes it again$"):
        unpack(text, 0)


def test_node_grants_refuse_oversized_data_without_unpacking_it() -> None:
    text = base64.b64encode(lzma.compress(b" " * (MAX_UNPACKED_BYTES + 1), preset=0)).decode()
    assert len(text) < 100_000
    tracemalloc.start()
    try:
        with pytest.raises(InvalidObject, match="holds more than 67108864 bytes"):
            unpack(text, 0)
        assert tracemalloc.get_traced_memory()[1] < 3 * MAX_UNPACKED_BYTES
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("bound", ["MAX_UNPACKED_BYTES", "MAX_PACKED_BYTES"])
@pytest.mark.parametrize("fits", [0, 1, 5, 9, 10])
def test_node_grants_contain_oldest_grants_when_space_is_limited(
    monkeypatch: pytest.MonkeyPatch, bound: str, fits: int
) -> None:
    chance = random.Random(7)
    bodies = [
        body(f"g{9 - hour}", {"noise": chance.randbytes(500).hex()}, creationTimestamp=f"2026-01-01T0{hour}:00:00Z")
        for hour in range(10)
    ]
    text = pack(bodies[:fits])
    size = len(text) if bound == "MAX_PACKED_BYTES" else len(lzma.decompress(base64.b64decode(text)))
    monkeypatch.setattr(grants, bound, size)
    chance.shuffle(bodies)
    packed, count = pack_oldest(bodies)
    assert (packed, count) == (text, fits)
