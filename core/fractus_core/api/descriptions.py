"""Node descriptions: one Drone or EdgeNode manifest that the owner of a node writes in YAML."""

from __future__ import annotations

from fractus_core.api.model import InvalidObject
from fractus_core.api.nodes import Drone, EdgeNode
from fractus_core.documents import BadDocument, parse_document


class InvalidDescription(Exception):
    """A node description is invalid. The message states the line, the field and the remedy."""


def parse_description(text: str, *kinds: type[Drone | EdgeNode]) -> Drone | EdgeNode | None:
    """Parse a node description.

    Args:
        text: YAML with one manifest.
        kinds: Accepted kinds.

    Returns:
        The Drone or EdgeNode, or None if the text is empty.

    Raises:
        InvalidDescription: The text is not one valid manifest of an accepted kind.
    """
    try:
        body, document = parse_document(text.encode(), "description")
    except BadDocument as error:
        raise InvalidDescription(f"line {error.line}: {error.problem}") from None
    if body is None:
        return None
    kind = next((kind for kind in kinds if isinstance(body, dict) and body.get("kind") == kind.KIND), None)
    if kind is None:
        raise InvalidDescription(f"must contain one manifest of kind {' or '.join(kind.KIND for kind in kinds)}")
    try:
        return kind.from_body(body)
    except InvalidObject as error:
        raise InvalidDescription(f"line {document.line(body, error.field)}: {error}") from None
