"""The description of a node: one Drone or EdgeNode manifest, as its owner writes it in YAML."""

from __future__ import annotations

from fractus_core.api.model import InvalidObject
from fractus_core.api.nodes import Drone, EdgeNode
from fractus_core.documents import BadDocument, parse_document


class InvalidDescription(Exception):
    """The description of a node cannot be used; the message says what to fix."""


def parse_description(text: str, *kinds: type[Drone | EdgeNode]) -> Drone | EdgeNode | None:
    """The Drone or EdgeNode that a manifest describes; None when the text is empty.

    Args:
        text: YAML.
        kinds: which of them it may be.

    Raises:
        InvalidDescription: it is not one manifest of these kinds.
    """
    try:
        body, found = parse_document(text.encode(), "description")
    except BadDocument as error:
        raise InvalidDescription(f"line {error.line}: {error.problem}") from None
    if body is None:
        return None
    kind = next((kind for kind in kinds if isinstance(body, dict) and body.get("kind") == kind.KIND), None)
    if kind is None:
        raise InvalidDescription(f"must hold one manifest of kind {' or '.join(kind.KIND for kind in kinds)}")
    try:
        return kind.from_body(body)
    except InvalidObject as error:
        raise InvalidDescription(f"line {found.line(body, error.field)}: {error}") from None
