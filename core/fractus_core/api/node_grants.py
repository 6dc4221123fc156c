"""NodeGrants: all Grants of one node in one object. The agent of a node can read only its own NodeGrants object."""

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
"""Namespace of the NodeGrants objects. Each node has a service account that may read only its own."""

MAX_UNPACKED_BYTES = 64 * 2**20
"""Maximum size of the Grants of a node as JSON. Compression reduces it to about 1 %, because Grants share zones."""
MAX_PACKED_BYTES = 2**20
"""Maximum length of the packed text. The rest of the etcd object limit is left for the status."""
MAX_MESSAGE = 1024
PACKED_METADATA = ("name", "uid", "generation", "labels", "annotations")
"""Metadata fields of a Grant that are packed. Changes of other fields do not change the packed text."""

_FIELD = "spec.packed"
_MEMORY_BYTES = 128 * 2**20
_LEVEL = 1
"""Compression level of xz. Higher levels take several times as long and save a few per cent."""


class NodeGrantsSpec(OpenModel):
    """All Grants of the node."""

    # Unknown fields are ignored, because an older agent reads objects of a newer operator.
    count: int = Field(ge=0, description="Number of Grants.")
    packed: str = Field(
        description="The Grants without their status: a JSON list sorted by name, xz-compressed, base64-encoded."
    )


class ReportedGrant(OpenModel):
    """State of one Grant on the node, as in the status of the Grant."""

    uid: str = Field(max_length=128, description="metadata.uid of the Grant.")
    name: str = Field(max_length=253, description="Name of the Grant.")
    phase: GrantPhase = Field(description="Pending until the node has stored the Grant; then the state of its mission.")
    message: str = Field(default="", max_length=MAX_MESSAGE, description="Human-readable explanation.")
    observed_generation: Annotated[int, Field(ge=0, description="metadata.generation of the Grant that is described.")]


class NodeGrantsStatus(OpenModel):
    """State of the Grants as reported by the agent. The operator copies it to the Grants."""

    observed_generation: ObservedGeneration = None
    grants: Annotated[tuple[ReportedGrant, ...], Field(json_schema_extra=keyed("uid"))] = Field(
        default=(), description="State of each Grant that the agent knows."
    )


class NodeGrants(Resource, plural="nodegrants", short="fng", namespaced=True, written_by_operator=True):
    """The Grants of one node. The object is named after the node, and its agent can read no other."""

    COLUMNS = (("Grants", "integer", ".spec.count"), AGE)

    kind: Literal["NodeGrants"] = "NodeGrants"
    spec: NodeGrantsSpec
    status: NodeGrantsStatus | None = None


def pack(bodies: Iterable[Mapping[str, Any]]) -> str:
    """Pack Grants for `NodeGrantsSpec.packed`. The result does not depend on their order.

    Packing takes about 2 ms per Grant of 31 kB, so pack many Grants in a thread.

    Args:
        bodies: Grants as returned by the API server.

    Raises:
        InvalidObject: The Grants exceed MAX_UNPACKED_BYTES, or MAX_PACKED_BYTES when packed.
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
    """Pack the Grants of a node. If they are too many, pack the oldest ones that fit.

    Keeping the oldest Grants means that revoked Grants always leave the node and that new Grants have to wait.

    Returns:
        The packed text and the number of packed Grants.
    """
    oldest = sorted(bodies, key=lambda body: (str(body["metadata"].get("creationTimestamp", "")), _name(body)))
    packed = ""
    fit = 0
    count = len(oldest)
    too_many = count + 1
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
    """Unpack the Grants of `NodeGrantsSpec.packed`.

    Args:
        packed: Text made by `pack`.
        count: Expected number of Grants.

    Raises:
        InvalidObject: The text is damaged, exceeds MAX_UNPACKED_BYTES, or holds another number of Grants.
    """
    try:
        # The output limit bounds the memory, regardless of the compression ratio.
        unpacker = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_MEMORY_BYTES)
        text = unpacker.decompress(base64.b64decode(packed, validate=True), MAX_UNPACKED_BYTES)
        if not unpacker.eof:
            reason = "is cut short" if unpacker.needs_input else f"holds more than {MAX_UNPACKED_BYTES} bytes"
            raise InvalidObject(_FIELD, f"{reason}; the operator writes it again")
        grants = json.loads(text)
    except (binascii.Error, lzma.LZMAError, ValueError, RecursionError) as error:
        if isinstance(error, InvalidObject):
            raise
        raise InvalidObject(_FIELD, f"cannot be unpacked ({error}); the operator writes it again") from None
    if not isinstance(grants, list) or not all(_has_identity(body) for body in grants):
        raise InvalidObject(_FIELD, "is not a list of Grants; the operator writes it again")
    if len(grants) != count:
        raise InvalidObject(
            _FIELD, f"holds {len(grants)} Grants, not the {count} of spec.count; the operator writes it again"
        )
    return tuple(grants)


def _has_identity(body: Any) -> bool:
    """Return True if a body has a uid, and a name that is safe as a file name."""
    metadata = body.get("metadata") if isinstance(body, dict) else None
    if not isinstance(metadata, dict):
        return False
    name = metadata.get("name")
    return isinstance(name, str) and is_subdomain(name) and isinstance(metadata.get("uid"), str)
