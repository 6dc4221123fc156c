"""NodeGrants: the Grants of one node in one object, the only one that the node's agent may read."""

from __future__ import annotations

import base64
import binascii
import json
import lzma
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import Field

from fractus_core.api.model import AGE, InvalidObject, ObservedGeneration, OpenModel, Resource, keyed
from fractus_core.api.names import is_subdomain
from fractus_core.api.plans import GrantPhase

NODE_GRANTS_NAMESPACE = "fractus-nodes"
"""Where the operator keeps them, with an account for each node that may read its own."""

MAX_UNPACKED_BYTES = 64 * 2**20
"""Of a node's Grants as JSON: zones are alike in all of them, so that they are packed into a hundredth."""
MAX_PACKED_BYTES = 2**20
"""Of the packed text: what etcd takes of an object has room beside it for what the agent reports."""
MAX_MESSAGE = 1024
PACKED_METADATA = ("name", "uid", "generation", "labels", "annotations")
"""What of a Grant's metadata is packed: a change of anything else needs no other text."""

_FIELD = "spec.packed"
_MEMORY_BYTES = 128 * 2**20
_LEVEL = 1
"""Of xz: higher levels take several times as long for a few per cent."""


class NodeGrantsSpec(OpenModel):
    """All Grants of the node."""

    # Open: an agent reads what a newer operator writes.
    count: int = Field(ge=0, description="How many Grants there are.")
    packed: str = Field(description="The Grants without their status: a JSON list by name, as xz, in base64.")


class ReportedGrant(OpenModel):
    """What became of one Grant on the node, as in its own status."""

    uid: str = Field(max_length=128, description="metadata.uid of the Grant.")
    name: str = Field(max_length=253, description="Its name.")
    phase: GrantPhase = Field(description="Pending until the node has it; then how its mission stands.")
    message: str = Field(default="", max_length=MAX_MESSAGE, description="One sentence for people.")
    observed_generation: Annotated[int, Field(ge=0, description="metadata.generation of the Grant this was said of.")]


class NodeGrantsStatus(OpenModel):
    """What the node's agent reports; the operator copies it to the Grants."""

    observed_generation: ObservedGeneration = None
    grants: Annotated[tuple[ReportedGrant, ...], Field(json_schema_extra=keyed("uid"))] = Field(
        default=(), description="One entry for each Grant that the agent knows."
    )


class NodeGrants(Resource, plural="nodegrants", short="fng", namespaced=True, written_by_operator=True):
    """The Grants of one node, by whose name it is called; the node's agent may read no other."""

    COLUMNS = (("Grants", "integer", ".spec.count"), AGE)

    kind: Literal["NodeGrants"] = "NodeGrants"
    spec: NodeGrantsSpec
    status: NodeGrantsStatus | None = None


def pack(bodies: Iterable[Mapping[str, Any]]) -> str:
    """Grants as `NodeGrantsSpec.packed`; the same Grants, in any order, make the same text.

    Some 2 ms for each Grant of 31 kB: many are packed in a thread.

    Args:
        bodies: as the API server gives them.

    Raises:
        InvalidObject: they are larger than MAX_UNPACKED_BYTES, or MAX_PACKED_BYTES when they are packed.
    """
    grants = [
        {
            "apiVersion": body["apiVersion"],
            "kind": body["kind"],
            "metadata": {key: body["metadata"][key] for key in PACKED_METADATA if key in body["metadata"]},
            "spec": body["spec"],
        }
        for body in sorted(bodies, key=_name)
    ]
    text = json.dumps(grants, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
    if len(text) > MAX_UNPACKED_BYTES:
        raise InvalidObject(_FIELD, f"would hold {len(text)} bytes, more than {MAX_UNPACKED_BYTES}")
    packed = base64.b64encode(lzma.compress(text, preset=_LEVEL)).decode()
    if len(packed) > MAX_PACKED_BYTES:
        raise InvalidObject(_FIELD, f"would have {len(packed)} bytes, more than {MAX_PACKED_BYTES}")
    return packed


def pack_oldest(bodies: Sequence[Mapping[str, Any]]) -> tuple[str, int]:
    """Grants as `NodeGrantsSpec`: packed, and how many; of too many the oldest that fit.

    So what is revoked always leaves the node, and what is not granted yet has to wait.
    """
    oldest = sorted(bodies, key=lambda body: (str(body["metadata"].get("creationTimestamp", "")), _name(body)))
    packed, fit, too_many = "", 0, len(oldest) + 1
    count = len(oldest)
    while True:
        try:
            packed, fit = pack(oldest[:count]), count
        except InvalidObject:
            too_many = count
        if too_many - fit <= 1:
            return packed or pack(()), fit
        count = (fit + too_many) // 2


def _name(body: Mapping[str, Any]) -> str:
    return str(body["metadata"]["name"])


def unpack(packed: str, count: int) -> tuple[dict[str, Any], ...]:
    """The Grants of `NodeGrantsSpec.packed`.

    Args:
        packed: what `pack` made.
        count: how many there are.

    Raises:
        InvalidObject: it is not what `pack` makes of that many, or larger than MAX_UNPACKED_BYTES.
    """
    try:
        # Of what goes in some is kept for later: it ends where the bound is, however well it is packed.
        unpacker = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_MEMORY_BYTES)
        text = unpacker.decompress(base64.b64decode(packed, validate=True), MAX_UNPACKED_BYTES)
        if not unpacker.eof:
            reason = "is cut short" if unpacker.needs_input else f"holds more than {MAX_UNPACKED_BYTES} bytes"
            raise InvalidObject(_FIELD, f"{reason}; the operator writes it again")
        found = json.loads(text)
    except (binascii.Error, lzma.LZMAError, ValueError, RecursionError) as error:
        if isinstance(error, InvalidObject):
            raise
        raise InvalidObject(_FIELD, f"cannot be unpacked ({error}); the operator writes it again") from None
    if not isinstance(found, list) or not all(_named(body) for body in found):
        raise InvalidObject(_FIELD, "is no list of Grants; the operator writes it again")
    if len(found) != count:
        raise InvalidObject(
            _FIELD, f"holds {len(found)} Grants, not the {count} of spec.count; the operator writes it again"
        )
    return tuple(found)


def _named(body: Any) -> bool:
    """Whether it has a name and a uid as the API server gives them: files are called by the one."""
    metadata = body.get("metadata") if isinstance(body, dict) else None
    name, uid = (metadata.get("name"), metadata.get("uid")) if isinstance(metadata, dict) else (None, None)
    return isinstance(name, str) and is_subdomain(name) and isinstance(uid, str)
