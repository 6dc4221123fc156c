"""Rules across fields, each stated once: in CEL for the API server, and as a check of the model for everyone else.

The API server evaluates CEL at `kubectl apply`. The models are also read where no API server is: by `fractus plan`, by
agents from disk, in tests. One decorator declares both forms side by side, with the one sentence that both give:

    class Area(Model):
        @rule("has(self.polygon) != has(self.circle)", "give either polygon or circle, and only one of them")
        def _one_shape(self) -> Broken:
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

Broken = str | tuple[str, str] | None
"""The field that breaks a rule ("" for the object as a whole), or that and what is wrong with it; None: the rule holds."""


def rule(cel: str, message: str) -> Callable[[Callable[[M], Broken]], Any]:
    """Declare a rule of a model by its CEL expression, its sentence, and a method that finds the field that breaks it.

    Args:
        cel: true for an object that keeps the rule; `self` is the object as manifests spell it, without defaults.
        message: what is asked for, and the remedy.
    """

    def declare(broken: Callable[[M], Broken]) -> Any:
        @functools.wraps(broken)
        def check(model: M) -> M:
            found = broken(model)
            if found is not None:
                field, detail = found if isinstance(found, tuple) else (found, "")
                raise InvalidObject(field, f"{message} ({detail})" if detail else message)
            return model

        check.__dict__[VALIDATIONS] = {"rule": cel, "message": message}
        return model_validator(mode="after")(check)

    return declare


def named_by_others(kind: str, others: str) -> Any:
    """The rule of a kind whose objects are named in fields of others: its names fit there."""

    @rule(
        f"self.metadata.name.size() <= 63 && self.metadata.name.matches('{DNS_LABEL}')",
        f"the name of a {kind} has at most 63 small letters, digits and hyphens, for {others} name it",
    )
    def nameable(self: Any) -> Broken:
        name = self.metadata.name
        return None if len(name) <= 63 and re.fullmatch(DNS_LABEL, name) else "metadata.name"

    return nameable


def one_of(first: str, second: str) -> Any:
    """The rule that of two optional fields one is given, and not both."""

    @rule(f"has(self.{first}) != has(self.{second})", f"give either {first} or {second}, and only one of them")
    def given(self: Any) -> Broken:
        return "" if (getattr(self, first) is None) == (getattr(self, second) is None) else None

    return given
