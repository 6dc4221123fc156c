"""Base types of every kind: strict models, object metadata, conditions, quantities, timestamps."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterable, Sequence
from datetime import datetime
from typing import Annotated, Any, ClassVar, Literal, Self, get_args

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, WithJsonSchema
from pydantic.alias_generators import to_camel
from pydantic_core import ErrorDetails

from fractus_core.api.formats import FORMATS
from fractus_core.api.names import DNS_SUBDOMAIN, SHAPES, LabelKey, LabelValue, Name

GROUP = "fractus.dev"
VERSION = "v1alpha1"
API_VERSION = f"{GROUP}/{VERSION}"

_QUANTITY = r"^([0-9]+([.][0-9]+)?)(m|k|Ki|M|Mi|G|Gi|T|Ti|P|Pi)?$"
_SCALE = {
    None: 1.0, "m": 1e-3, "k": 1e3, "M": 1e6, "G": 1e9, "T": 1e12, "P": 1e15,
    "Ki": 2.0**10, "Mi": 2.0**20, "Gi": 2.0**30, "Ti": 2.0**40, "Pi": 2.0**50,
}  # fmt: skip


def quantity(text: str | float) -> float:
    """Convert a Kubernetes quantity to its base unit (cores, bytes or items).

    Raises:
        ValueError: `text` is not a non-negative Kubernetes quantity.
    """
    match = re.fullmatch(_QUANTITY, str(text))
    if match is None:
        raise ValueError(f"{text!r} is not a quantity such as 250m, 1.5 or 512Mi")
    return float(match.group(1)) * _SCALE[match.group(3)]


def _checked_quantity(value: object) -> str:
    text = str(value) if type(value) is int else value
    if not isinstance(text, str) or len(text) > _QUANTITY_LENGTH or re.fullmatch(_QUANTITY, text) is None:
        raise ValueError(f"{value!r:.40} is not a quantity such as 250m, '1.5' or 512Mi")
    return text


_QUANTITY_LENGTH = 32
Quantity = Annotated[
    str,
    BeforeValidator(_checked_quantity),
    WithJsonSchema(
        {
            "anyOf": [{"type": "integer"}, {"type": "string"}],
            "minimum": 0,  # of whole numbers, to which the pattern does not apply
            "pattern": _QUANTITY,
            "maxLength": _QUANTITY_LENGTH,
        }
    ),
]
"""A Kubernetes quantity such as 250m, 1.5 or 512Mi. Whole numbers may be written without quotes."""

_TIMESTAMP = (
    r"^(19[7-9]|2[0-9][0-9])[0-9]-[0-9]{2}-[0-9]{2}T([01][0-9]|2[0-3]):[0-5][0-9]:[0-5][0-9]([.][0-9]{1,9})?"
    r"(Z|[-+]([01][0-9]|2[0-3]):[0-5][0-9])$"
)


def _checked_timestamp(value: object) -> object:
    if isinstance(value, datetime):
        return value
    try:
        return datetime.fromisoformat(value if isinstance(value, str) and re.fullmatch(_TIMESTAMP, value) else "")
    except ValueError:
        raise ValueError(f"must be a time with its zone, such as 2026-06-01T12:00:00Z, not {value!r:.40}") from None


Timestamp = Annotated[
    datetime, Field(json_schema_extra={"pattern": _TIMESTAMP, "maxLength": 35}), BeforeValidator(_checked_timestamp)
]
"""An RFC 3339 timestamp with a time zone."""


VALIDATIONS = "x-kubernetes-validations"

MAX_OBJECT_BYTES = 3 * 2**19
"""Maximum size of an object as JSON: the default request limit of etcd."""


def _add_rules(schema: dict[str, Any], model: type[Any]) -> None:
    """Add the CEL rules of a model (see `api.rules`) to its schema, in the order of their declaration."""
    declared = (decorator.func for decorator in model.__pydantic_decorators__.model_validators.values())
    rules = [rule for check in declared if (rule := getattr(check, VALIDATIONS, None)) is not None]
    if rules:
        schema[VALIDATIONS] = rules


def keyed(*keys: str) -> dict[str, Any]:
    """Return the schema keywords of a list whose entries must differ in the given keys."""
    return {"x-kubernetes-list-type": "map", "x-kubernetes-list-map-keys": list(keys)}


class Model(BaseModel):
    """A frozen value of the API: camelCase in JSON, snake_case in Python, unknown fields rejected."""

    model_config = ConfigDict(
        alias_generator=to_camel,
        populate_by_name=True,
        extra="forbid",
        frozen=True,
        allow_inf_nan=False,
        json_schema_extra=_add_rules,
    )

    def to_dict(self) -> dict[str, Any]:
        """Return the value as Kubernetes stores it: camelCase keys, no nulls, JSON types only."""
        return self.model_dump(mode="json", by_alias=True, exclude_none=True)


class OpenModel(Model):
    """A value whose unknown fields are ignored, because another writer (such as the API server) may extend it."""

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
    """The fields of ObjectMeta that Fractus reads."""

    name: Annotated[str, Field(max_length=253, pattern=DNS_SUBDOMAIN)]
    namespace: Name | None = None
    uid: str | None = None
    generation: int | None = None
    resource_version: str | None = None
    labels: dict[LabelKey, LabelValue] = Field(default_factory=dict)
    annotations: dict[LabelKey, str] = Field(default_factory=dict)
    finalizers: tuple[str, ...] = ()
    owner_references: tuple[OwnerReference, ...] = ()
    creation_timestamp: datetime | None = None
    deletion_timestamp: datetime | None = None


class Condition(OpenModel):
    """A Kubernetes condition: one observed fact about an object."""

    type: str = Field(description="CamelCase type of the condition.", max_length=316)
    status: Literal["True", "False", "Unknown"] = Field(
        description="True, False, or Unknown if the state cannot be determined."
    )
    reason: str = Field(description="Machine-readable CamelCase reason for the last transition.", max_length=1024)
    message: str = Field(default="", description="Human-readable details.", max_length=32768)
    last_transition_time: datetime = Field(description="Time of the last change of status.")
    observed_generation: int | None = Field(
        default=None, ge=0, description="metadata.generation that the condition describes."
    )


def timestamp(time: datetime) -> str:
    """Return a UTC time as Kubernetes writes it, without fractions of a second."""
    return time.strftime("%Y-%m-%dT%H:%M:%SZ")


ObservedGeneration = Annotated[int | None, Field(description="metadata.generation that the status describes.")]
Conditions = Annotated[tuple[Condition, ...], Field(description="Current state of the object, by condition type.")]

Column = tuple[str, str, str]
"""A printer column: title, type, JSONPath."""

READY: Column = ("Ready", "string", ".status.conditions[?(@.type=='Ready')].status")
AGE: Column = ("Age", "date", ".metadata.creationTimestamp")


class Resource(Model):
    """An object of a Fractus kind."""

    KIND: ClassVar[str]
    PLURAL: ClassVar[str]
    SHORT: ClassVar[str]
    NAMESPACED: ClassVar[bool]
    SELECTABLE: ClassVar[Sequence[str]]
    """JSONPaths of the fields that watches may select on."""
    WRITTEN_BY_OPERATOR: ClassVar[bool]
    """True if only the operator writes objects of the kind.

    The operator builds these objects from validated objects, so the CRD has no CEL rules.
    """
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
        cls.KIND = cls.__name__
        cls.PLURAL = plural
        cls.SHORT = short
        cls.NAMESPACED = namespaced
        cls.SELECTABLE = selectable
        cls.WRITTEN_BY_OPERATOR = written_by_operator

    @classmethod
    def from_body(cls, body: Any) -> Self:
        """Parse an object from the API server or a manifest.

        Raises:
            InvalidObject: The object is invalid. The message is one sentence with the field and the remedy.
        """
        try:
            # Validate as JSON in strict mode, because the API server does not convert strings to numbers either.
            text = json.dumps(_plain(body), separators=(",", ":"))
            parsed = cls.model_validate_json(text, strict=True)
            whole = json.dumps(_plain(body, nulls=True), separators=(",", ":"))
            if whole != text:
                _refuse_unknown(cls, whole)
        except ValidationError as error:
            raise InvalidObject.from_pydantic(error, cls) from None
        if len(text) > MAX_OBJECT_BYTES and not cls.WRITTEN_BY_OPERATOR:
            raise InvalidObject(
                "", f"has {len(text)} bytes as JSON, more than the {MAX_OBJECT_BYTES} that etcd keeps; split it"
            )
        return parsed

    @property
    def name(self) -> str:
        """metadata.name."""
        return self.metadata.name


_WHOLE = 2**63
_LARGEST = 10**300


def _plain(value: Any, *, nulls: bool = False) -> Any:
    """Copy mappings and sequences of any type (such as kopf's views) into dicts and lists.

    Normalise values as the API server does: drop null fields unless `nulls` is set, convert whole floats such as 2.0 to
    integers, and convert integers that do not fit into 64 bits to floats.
    """
    if hasattr(value, "items"):
        return {k: _plain(v, nulls=nulls) for k, v in value.items() if nulls or v is not None}
    if isinstance(value, (list, tuple)):
        return [_plain(v, nulls=nulls) for v in value]
    if type(value) is int and abs(value) >= _WHOLE:
        return float(max(-_LARGEST, min(value, _LARGEST)))
    return int(value) if type(value) is float and abs(value) < _WHOLE and value.is_integer() else value


def _refuse_unknown(model: type[Resource], text: str) -> None:
    """Reject unknown fields whose value is null. The first validation ran without null fields."""
    try:
        model.model_validate_json(text, strict=True)
    except ValidationError as error:
        for finding in error.errors(include_url=False):
            if finding["type"] == "extra_forbidden":
                raise InvalidObject(_path(finding).lstrip("."), _unknown_field(finding, model)) from None


def _path(finding: ErrorDetails) -> str:
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in finding["loc"])


class InvalidObject(ValueError):
    """An object violates the rules of its kind. The message names the field and the remedy."""

    def __init__(self, field: str, problem: str) -> None:
        self.field = field
        self.problem = problem
        super().__init__(f"{field}: {problem}" if field else problem)

    @classmethod
    def from_pydantic(cls, error: ValidationError, model: type[BaseModel] | None = None) -> InvalidObject:
        """Convert the first pydantic error to a field path and a sentence.

        Args:
            error: The error.
            model: The parsed model. With it, the sentence about an unknown field suggests a similar name.
        """
        findings = error.errors(include_url=False)
        finding = _misspelt(findings) or findings[0]
        path = _path(finding)
        if finding["type"] == "extra_forbidden":
            return cls(path.lstrip("."), _unknown_field(finding, model))
        context = finding.get("ctx", {}).get("error")
        if isinstance(context, InvalidObject):
            inner = context.field
            joint = "" if not inner or inner.startswith("[") or not path else "."
            return cls((path + joint + inner).lstrip("."), context.problem)
        problem = str(context) if context is not None else _problem(finding)
        value = finding.get("input")
        if context is None and isinstance(value, (str, int, float, bool)):
            text = repr(value)
            problem += f", not {text if len(text) <= 80 else text[:77] + '...'}"
        if context is None:
            problem += _hint(finding)
        return cls(path.lstrip("."), problem[:1].lower() + problem[1:])


_SENTENCES = {
    "tuple_type": "must be a list",
    "list_type": "must be a list",
    "model_type": "must be an object with named fields",
    "model_attributes_type": "must be an object with named fields",
    "dict_type": "must be an object with named fields",
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "finite_number": "must be a finite number",
    "bool_type": "must be true or false",
    "string_type": "must be a string; put it in quotes",
    "missing": "is missing; specify it",
}
"""Messages for pydantic errors, by error type. The messages of pydantic use Python terms that users do not know."""


def _problem(finding: ErrorDetails) -> str:
    kind = str(finding["type"])
    limits = finding.get("ctx", {})
    if kind == "string_pattern_mismatch":
        pattern = limits["pattern"]
        return f"must be {SHAPES.get(pattern) or FORMATS.get(pattern) or 'of the form ' + pattern}"
    if kind in {"too_long", "too_short"} and limits.get("field_type") == "Tuple":
        bound = f"most {limits['max_length']}" if kind == "too_long" else f"least {limits['min_length']}"
        return f"must have at {bound} entries, not {limits['actual_length']}"
    return _SENTENCES.get(kind) or finding["msg"].replace("Input should", "must").replace("String should", "must")


def _misspelt(findings: Sequence[ErrorDetails]) -> ErrorDetails | None:
    """Return an unknown field that is probably the misspelt form of a missing field, if the first problem is that field."""
    first = findings[0]
    if first["type"] != "missing":
        return None
    for finding in findings:
        beside = finding["type"] == "extra_forbidden" and finding["loc"][:-1] == first["loc"][:-1]
        if beside and _similar(str(finding["loc"][-1]), [str(first["loc"][-1])]):
            return finding
    return None


def _unknown_field(finding: ErrorDetails, model: type[BaseModel] | None) -> str:
    name = str(finding["loc"][-1])
    if name.isdigit():
        return "there is no such field; write decimals with a point, or remove the number"
    similar = _similar(name, _field_names(model, finding["loc"][:-1]) if model is not None else ())
    return f"there is no such field; {f'did you mean {similar}?' if similar else 'remove it, or correct its name'}"


def _field_names(model: type[BaseModel], place: Sequence[int | str]) -> list[str]:
    """Return the names of the fields at a place of a model."""
    models = {model}
    for part in place:
        if isinstance(part, str):
            models = {inner for each in models for inner in _models_in(_fields(each).get(part))}
    return [name for each in models for name in _fields(each)]


def _fields(model: type[BaseModel]) -> dict[str, Any]:
    """Return the types of a model's fields by their names in manifests."""
    return {field.alias or name: field.annotation for name, field in model.model_fields.items()}


def _models_in(annotation: Any) -> set[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return {annotation}
    return {model for argument in get_args(annotation) for model in _models_in(argument)}


def _similar(word: str, names: Iterable[str], cutoff: float = 0.7) -> str | None:
    by_lower_case = {name.lower(): name for name in names}
    found = difflib.get_close_matches(word.lower(), by_lower_case, n=1, cutoff=cutoff)
    return by_lower_case[found[0]] if found else None


def _hint(finding: ErrorDetails) -> str:
    """Return the hint at the end of an error message: how to write the value that the user probably meant."""
    kind = finding["type"]
    value = finding.get("input")
    if not isinstance(value, str):
        return "; begin each entry with a hyphen" if kind in {"tuple_type", "list_type"} else ""
    if kind in {"tuple_type", "list_type"}:
        return f"; write [{value:.40}]"
    if kind in {"float_type", "int_type"}:
        return "; remove the quotes" if re.fullmatch(r"-?[0-9.]+", value) else "; write only the number"
    if kind == "literal_error":
        similar = _similar(value, re.findall(r"'([^']*)'", finding["ctx"]["expected"]), cutoff=0.6)
        return f"; did you mean {similar}?" if similar else ""
    return ""
