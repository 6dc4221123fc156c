"""What every kind is made of: the strict model, object metadata, conditions, quantities."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import datetime
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from pydantic.alias_generators import to_camel
from pydantic_core import ErrorDetails

GROUP = "fractus.dev"
VERSION = "v1alpha1"
API_VERSION = f"{GROUP}/{VERSION}"

_QUANTITY = re.compile(r"^(\d+(?:\.\d+)?)(m|k|Ki|M|Mi|G|Gi|T|Ti|P|Pi)?$")
_SCALE = {
    None: 1.0, "m": 1e-3, "k": 1e3, "M": 1e6, "G": 1e9, "T": 1e12, "P": 1e15,
    "Ki": 2.0**10, "Mi": 2.0**20, "Gi": 2.0**30, "Ti": 2.0**40, "Pi": 2.0**50,
}  # fmt: skip


def quantity(text: str | float) -> float:
    """Value of a Kubernetes quantity in its base unit (cores, bytes, pieces).

    Raises:
        ValueError: the text is not a non-negative Kubernetes quantity.
    """
    match = _QUANTITY.match(str(text))
    if match is None:
        raise ValueError(f"{text!r} is not a quantity such as 250m, 1.5 or 512Mi")
    return float(match.group(1)) * _SCALE[match.group(2)]


def _checked_quantity(text: str) -> str:
    quantity(text)
    return text


Quantity = Annotated[str, Field(max_length=32, coerce_numbers_to_str=True), AfterValidator(_checked_quantity)]
"""A Kubernetes quantity, such as 250m, 1.5 or 512Mi."""


VALIDATIONS = "x-kubernetes-validations"


def _add_rules(schema: dict[str, Any], model: type[Any]) -> None:
    """Put the CEL of a model's rules (see `api.rules`) into its schema, in the order of their declaration."""
    declared = (decorator.func for decorator in model.__pydantic_decorators__.model_validators.values())
    rules = [found for check in declared if (found := getattr(check, VALIDATIONS, None)) is not None]
    if rules:
        schema[VALIDATIONS] = rules


class Model(BaseModel):
    """A frozen value of the API; camelCase outside, snake_case inside, unknown fields refused."""

    model_config = ConfigDict(
        alias_generator=to_camel,
        populate_by_name=True,
        extra="forbid",
        frozen=True,
        allow_inf_nan=False,
        json_schema_extra=_add_rules,
    )

    def to_dict(self) -> dict[str, Any]:
        """The value as Kubernetes stores it: camelCase keys, no nulls, JSON types only."""
        return self.model_dump(mode="json", by_alias=True, exclude_none=True)


class OpenModel(Model):
    """A value whose unknown fields are dropped: what others (the API server) may extend."""

    model_config = ConfigDict(extra="ignore")


class OwnerReference(OpenModel):
    """A Kubernetes owner reference."""

    api_version: str
    kind: str
    name: str
    uid: str
    controller: bool | None = None
    block_owner_deletion: bool | None = None


class Metadata(OpenModel):
    """The part of ObjectMeta that Fractus reads."""

    name: str
    namespace: str | None = None
    uid: str | None = None
    generation: int | None = None
    resource_version: str | None = None
    labels: dict[str, str] = Field(default_factory=dict)
    annotations: dict[str, str] = Field(default_factory=dict)
    finalizers: tuple[str, ...] = ()
    owner_references: tuple[OwnerReference, ...] = ()
    creation_timestamp: datetime | None = None
    deletion_timestamp: datetime | None = None


class Condition(OpenModel):
    """A Kubernetes condition: one observed fact about an object."""

    type: str = Field(description="What is observed, CamelCase.", max_length=316)
    status: Literal["True", "False", "Unknown"]
    reason: str = Field(description="CamelCase reason of the last transition, for programs.", max_length=1024)
    message: str = Field(default="", description="One sentence for people.", max_length=32768)
    last_transition_time: datetime = Field(description="When the status last changed.")
    observed_generation: int | None = Field(default=None, ge=0, description="metadata.generation this was said of.")


Column = tuple[str, str, str]
"""A printer column: title, type, JSONPath."""

READY: Column = ("Ready", "string", ".status.conditions[?(@.type=='Ready')].status")
AGE: Column = ("Age", "date", ".metadata.creationTimestamp")


class Resource(OpenModel):
    """An object of one of Fractus' kinds."""

    KIND: ClassVar[str]
    PLURAL: ClassVar[str]
    SHORT: ClassVar[str]
    NAMESPACED: ClassVar[bool]
    SELECTABLE: ClassVar[Sequence[str]]
    """JSONPaths that watches may select on."""
    WRITTEN_BY_OPERATOR: ClassVar[bool]
    """The operator alone writes it, of parts that were checked where they came in: its schema needs no rules."""
    COLUMNS: ClassVar[Sequence[Column]] = ()

    api_version: Literal["fractus.dev/v1alpha1"] = "fractus.dev/v1alpha1"
    kind: str
    metadata: Metadata

    def __init_subclass__(
        cls,
        *,
        plural: str,
        short: str,
        namespaced: bool = False,
        selectable: Sequence[str] = (),
        written_by_operator: bool = False,
    ) -> None:
        super().__init_subclass__()
        cls.KIND, cls.PLURAL, cls.SHORT, cls.NAMESPACED = cls.__name__, plural, short, namespaced
        cls.SELECTABLE, cls.WRITTEN_BY_OPERATOR = selectable, written_by_operator

    @classmethod
    def from_body(cls, body: Any) -> Self:
        """Parse an object as the API server or a manifest gives it.

        Raises:
            InvalidObject: with one sentence that names the field and the remedy.
        """
        try:
            return cls.model_validate(_plain(body))
        except ValidationError as error:
            raise InvalidObject.from_pydantic(error) from None

    @property
    def name(self) -> str:
        """metadata.name."""
        return self.metadata.name


def _plain(value: Any) -> Any:
    """Copy mappings and sequences of any type (kopf's views, say) into dicts and lists."""
    if hasattr(value, "items"):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    return value


class InvalidObject(ValueError):
    """An object breaks the rules of its kind; the message names the field and the remedy."""

    def __init__(self, field: str, problem: str) -> None:
        self.field = field
        self.problem = problem
        super().__init__(f"{field}: {problem}" if field else problem)

    @classmethod
    def from_pydantic(cls, error: ValidationError) -> InvalidObject:
        """Translate the first finding of pydantic into field path and sentence."""
        finding = error.errors(include_url=False)[0]
        path = ""
        for part in finding["loc"]:
            path += f"[{part}]" if isinstance(part, int) else f".{part}"
        context = finding.get("ctx", {}).get("error")
        if isinstance(context, InvalidObject):
            inner = context.field
            joint = "" if not inner or inner.startswith("[") or not path else "."
            return cls((path + joint + inner).lstrip("."), context.problem)
        problem = str(context) if context is not None else _problem(finding)
        shown = finding.get("input")
        if context is None and isinstance(shown, (str, int, float, bool)):
            text = repr(shown)
            problem += f", not {text if len(text) <= 80 else text[:77] + '...'}"
        return cls(path.lstrip("."), problem[:1].lower() + problem[1:])


def _problem(finding: ErrorDetails) -> str:
    """What is wrong, in words of manifests where pydantic uses those of Python."""
    limits = finding.get("ctx", {})
    match finding["type"]:
        case "tuple_type" | "list_type":
            return "must be a list"
        case "model_type" | "model_attributes_type" | "dict_type":
            return "must be an object with named fields"
        case "too_long" if limits.get("field_type") == "Tuple":
            return f"must have at most {limits['max_length']} entries, not {limits['actual_length']}"
        case "too_short" if limits.get("field_type") == "Tuple":
            return f"must have at least {limits['min_length']} entries, not {limits['actual_length']}"
    return finding["msg"]
