"""Validation rules across fields, each declared once: as CEL for the API server and as a check of the pydantic model.

The API server evaluates CEL at `kubectl apply`. The models are also used without an API server: by `fractus plan`, by
agents that read files, and in tests. One decorator declares both forms with one error message:

    class Area(Model):
        @rule("has(self.polygon) != has(self.circle)", "give either polygon or circle, and only one of them")
        def _one_shape(self) -> Violation:
            return "" if (self.polygon is None) == (self.circle is None) else None
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from typing import Any, TypeVar

from pydantic import model_validator

from fractus_core.api.model import VALIDATIONS, InvalidObject
from fractus_core.api.names import DNS_LABEL

M = TypeVar("M")

Violation = str | tuple[str, str] | None
"""The field that violates a rule ("" for the whole object), optionally with details. None if the rule is satisfied."""


def rule(cel: str, message: str) -> Callable[[Callable[[M], Violation]], Any]:
    """Declare a validation rule of a model. The decorated method returns the field that violates the rule.

    Args:
        cel: CEL expression that is true for a valid object. `self` is the object as in the manifest, without defaults.
        message: Error message with the requirement and the remedy.
    """

    def declare(find_violation: Callable[[M], Violation]) -> Any:
        @functools.wraps(find_violation)
        def check(model: M) -> M:
            violation = find_violation(model)
            if violation is not None:
                field, detail = violation if isinstance(violation, tuple) else (violation, "")
                raise InvalidObject(field, f"{message} ({detail})" if detail else message)
            return model

        check.__dict__[VALIDATIONS] = {"rule": cel, "message": message}
        return model_validator(mode="after")(check)

    return declare


def referenced_by(kind: str, referrers: str) -> Any:
    """Return the rule that an object has a name that other kinds can refer to: a DNS label of at most 63 characters.

    Args:
        kind: Kind of the object.
        referrers: Kinds that refer to the object, as a part of the error message.
    """
    article = "an" if kind[0] in "AEIOU" else "a"

    @rule(
        f"self.metadata.name.size() <= 63 && self.metadata.name.matches('{DNS_LABEL}')",
        f"the name of {article} {kind} must have at most 63 lowercase letters, digits and hyphens, because {referrers} refer to it",
    )
    def has_label_name(self: Any) -> Violation:
        name = self.metadata.name
        return None if len(name) <= 63 and re.fullmatch(DNS_LABEL, name) else "metadata.name"

    return has_label_name


def one_of(first: str, second: str) -> Any:
    """Return the rule that exactly one of two optional fields is set."""

    @rule(f"has(self.{first}) != has(self.{second})", f"give either {first} or {second}, and only one of them")
    def exactly_one(self: Any) -> Violation:
        return "" if (getattr(self, first) is None) == (getattr(self, second) is None) else None

    return exactly_one
