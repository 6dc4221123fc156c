"""Zone and Policy: what authorities and providers allow (thesis Table 8.1, Listing 11)."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Annotated, ClassVar, Literal, Self

from pydantic import ConfigDict, Field, model_validator

from fractus_core.api.geometry import AltitudeBand, Area
from fractus_core.api.methods import Method
from fractus_core.api.model import Condition, InvalidObject, Model, Name, OpenModel, Resource, rules


class ReadyStatus(OpenModel):
    """Whether the object is usable, and why not."""

    observed_generation: int | None = None
    conditions: tuple[Condition, ...] = ()


Day = Literal["Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun"]
ClockTime = Annotated[str, Field(pattern=r"^([01][0-9]|2[0-3]):[0-5][0-9]$", max_length=5)]

_DAYS: tuple[Day, ...] = ("Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun")
_DAY_S = 86_400.0
_THURSDAY = 3
"""1970-01-01 was one."""


_VALIDITY = (
    "!has(self.validFrom) || !has(self.validUntil) || self.validFrom < self.validUntil",
    "validUntil must be after validFrom",
)


class ActiveTime(Model):
    """When a zone is active; what is given must hold together. Times are UTC, as in ED-269."""

    model_config = ConfigDict(
        json_schema_extra=rules(
            ("has(self.start) == has(self.end)", "give start and end together, or neither"),
            _VALIDITY,
        )
    )

    days: tuple[Day, ...] = Field(default=(), max_length=7, description="Days of the week in UTC; empty: every day.")
    start: ClockTime | None = Field(default=None, description="HH:MM, UTC; unset: midnight.")
    end: ClockTime | None = Field(
        default=None, description="HH:MM, UTC; not later than start: on the day after. Unset: midnight."
    )
    valid_from: datetime | None = Field(default=None, description="RFC 3339; unset: always active before validUntil.")
    valid_until: datetime | None = Field(default=None, description="RFC 3339; unset: active for ever.")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if (self.start is None) != (self.end is None):
            raise InvalidObject("start", "give start and end together, or neither")
        if self.valid_from and self.valid_until and self.valid_from >= self.valid_until:
            raise InvalidObject("validUntil", "must be after validFrom")
        return self

    def active(self, time_s: float) -> bool:
        """Whether a moment, in seconds since 1970 UTC, is in this time."""
        if self.valid_from is not None and time_s < _unix(self.valid_from):
            return False
        if self.valid_until is not None and time_s >= _unix(self.valid_until):
            return False
        start, end = _clock_s(self.start or "00:00"), _clock_s(self.end or "00:00")
        length = end - start if end > start else _DAY_S + end - start
        today = time_s // _DAY_S
        # A time that began yesterday may last until today.
        for day in (today, today - 1):
            weekday = _DAYS[int(day + _THURSDAY) % 7]
            if 0 <= time_s - day * _DAY_S - start < length and (not self.days or weekday in self.days):
                return True
        return False


def active_at(schedule: Sequence[ActiveTime], time_s: float) -> bool:
    """Whether a schedule is active at a moment, in seconds since 1970 UTC; an empty one always is."""
    return not schedule or any(time.active(time_s) for time in schedule)


def _clock_s(text: str) -> float:
    hours, minutes = text.split(":")
    return int(hours) * 3600.0 + int(minutes) * 60.0


def _unix(moment: datetime) -> float:
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


class ZoneSpec(Model):
    """A named piece of air or ground."""

    area: Area
    altitude: AltitudeBand | None = Field(default=None, description="The slab of air; unset: from the ground up.")
    schedule: tuple[ActiveTime, ...] = Field(
        default=(),
        max_length=50,
        description="When the zone is active; empty: always. Outside it, it is as if not there.",
    )
    description: str = Field(default="", max_length=1024)


_READY = ("Ready", "string", ".status.conditions[?(@.type=='Ready')].status")
_AGE = ("Age", "date", ".metadata.creationTimestamp")


class Zone(Resource):
    """A named area that policies refer to."""

    KIND: ClassVar[str] = "Zone"
    PLURAL: ClassVar[str] = "zones"
    SHORT: ClassVar[str] = "zn"
    COLUMNS = (("Lower", "number", ".spec.altitude.lower"), ("Upper", "number", ".spec.altitude.upper"), _READY, _AGE)

    kind: Literal["Zone"] = "Zone"
    spec: ZoneSpec
    status: ReadyStatus | None = None


class NodeExpression(Model):
    """A condition on one attribute of a node."""

    model_config = ConfigDict(
        json_schema_extra=rules(
            (
                "self.operator == 'Exists' ? !has(self.values) || size(self.values) == 0 :"
                " has(self.values) && size(self.values) > 0",
                "values must be given for In, NotIn, Gt and Lt, and left out for Exists",
            ),
            (
                "!(self.operator in ['Gt', 'Lt']) || !has(self.values) || size(self.values) == 1",
                "Gt and Lt take exactly one value",
            ),
            (
                "!(self.operator in ['Gt', 'Lt']) || !has(self.values) ||"
                " self.values.all(v, v.matches('^[-+]?([0-9]+[.]?[0-9]*|[.][0-9]+)$'))",
                "Gt and Lt compare numbers",
            ),
        )
    )

    key: str = Field(
        min_length=1,
        max_length=128,
        description="Attribute, dotted for nested ones: class, mtom, name, services.camera.model.",
    )
    operator: Literal["In", "NotIn", "Exists", "Gt", "Lt"]
    values: tuple[Annotated[str, Field(max_length=256)], ...] = Field(default=(), max_length=100)

    @model_validator(mode="after")
    def _values_fit(self) -> Self:
        if (self.operator == "Exists") == bool(self.values):
            raise InvalidObject("values", "must be given for In, NotIn, Gt and Lt, and left out for Exists")
        if self.operator in {"Gt", "Lt"}:
            if len(self.values) != 1:
                raise InvalidObject("values", f"{self.operator} takes exactly one value")
            try:
                float(self.values[0])
            except ValueError:
                raise InvalidObject("values[0]", f"{self.operator} compares numbers, not {self.values[0]!r}") from None
        return self


class ApplicationSelector(Model):
    """Which applications and components."""

    namespaces: tuple[Name, ...] = Field(default=(), max_length=100, description="Empty: every namespace.")
    names: tuple[Name, ...] = Field(default=(), max_length=100, description="Empty: every application.")
    components: tuple[str, ...] = Field(default=(), max_length=100, description="Empty: every component.")


class PolicySelector(Model):
    """Where and for whom a policy holds; every part that is given must match."""

    zones: tuple[Name, ...] = Field(default=(), max_length=1000, description="Zones; empty: everywhere.")
    nodes: tuple[NodeExpression, ...] = Field(
        default=(), max_length=32, description="All must match; empty: every node."
    )
    applications: ApplicationSelector | None = Field(default=None, description="Unset: every application.")


class PolicySpec(Model):
    """One rule of an authority or a provider."""

    model_config = ConfigDict(
        json_schema_extra=rules(
            (
                "self.type != 'AccessControl' || (self.kind in ['grant', 'denial'] && has(self.methods) && size(self.methods) > 0)",
                "AccessControl takes kind grant or denial, and methods",
            ),
            (
                "self.type != 'LimitControl' || (self.kind in ['speed', 'altitude'] && (has(self.upperLimit) || has(self.lowerLimit)))",
                "LimitControl takes kind speed or altitude, and upperLimit or lowerLimit",
            ),
            (
                "self.type != 'LimitControl' || !has(self.action) || self.action in ['enforce', 'refuse']",
                "LimitControl takes action enforce or refuse",
            ),
            (
                "!has(self.upperLimit) || !has(self.lowerLimit) || self.lowerLimit <= self.upperLimit",
                "lowerLimit must not be above upperLimit",
            ),
            (
                "self.type != 'GeofenceControl' || (self.kind in ['inclusion', 'exclusion'] && has(self.selector)"
                " && has(self.selector.zones) && size(self.selector.zones) > 0)",
                "GeofenceControl takes kind inclusion or exclusion, and selector.zones",
            ),
            (
                "self.type != 'GeofenceControl' || !has(self.action) ||"
                " self.action in ['ignore', 'adjust', 'hover', 'land', 'returnToLaunch', 'revoke']",
                "GeofenceControl takes action ignore, adjust, hover, land, returnToLaunch or revoke",
            ),
            (
                "self.type != 'PrivacyControl' || (self.kind == 'camera' && has(self.action) && self.action in"
                " ['refuse', 'black', 'blurAverage', 'blurMedian', 'blurFaces', 'removeBackground'])",
                "PrivacyControl takes kind camera, and action refuse, black, blurAverage, blurMedian, blurFaces or removeBackground",
            ),
            (
                "!(has(self.faces) || has(self.fallback)) || (self.type == 'PrivacyControl' && has(self.action)"
                " && self.action == 'blurFaces')",
                "faces and fallback go with PrivacyControl and action blurFaces",
            ),
            _VALIDITY,
        )
    )

    type: Literal["AccessControl", "LimitControl", "GeofenceControl", "PrivacyControl"]
    kind: Literal["grant", "denial", "speed", "altitude", "inclusion", "exclusion", "camera"]
    methods: tuple[Method, ...] = Field(default=(), max_length=64, description="For AccessControl: the methods meant.")
    lower_limit: float | None = Field(
        default=None,
        ge=-1000,
        le=20000,
        description="For LimitControl: m/s, or metres in the datum of altitudeReference.",
    )
    upper_limit: float | None = Field(
        default=None,
        ge=-1000,
        le=20000,
        description="For LimitControl: m/s, or metres in the datum of altitudeReference.",
    )
    altitude_reference: Literal["home", "amsl", "terrain"] = Field(
        default="home", description="For LimitControl altitude: what the limits are measured from."
    )
    action: (
        Literal[
            "enforce", "refuse", "ignore", "adjust", "hover", "land", "returnToLaunch", "revoke",
            "black", "blurAverage", "blurMedian", "blurFaces", "removeBackground",
        ]
        | None
    ) = Field(
        default=None,
        description="What happens on a violation; unset: enforce for limits, ignore (the request is discarded) for geofences.",
    )  # fmt: skip
    faces: Literal["pixelate", "gaussian"] | None = Field(
        default=None, description="For blurFaces: how faces are hidden; unset: pixelate."
    )
    fallback: Literal["blurAverage", "black", "refuse"] | None = Field(
        default=None,
        description="For blurFaces: what is done where faces would be too small or too far to be found reliably;"
        " unset: blurAverage, of the whole picture.",
    )
    selector: PolicySelector = Field(default_factory=PolicySelector)
    valid_from: datetime | None = Field(default=None, description="RFC 3339; unset: always valid before validUntil.")
    valid_until: datetime | None = Field(default=None, description="RFC 3339; unset: valid for ever.")
    priority: int = Field(default=0, ge=-1000, le=1000, description="Decides between equally restrictive policies.")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        _KIND_CHECKS[self.type](self)
        for name, value in (("faces", self.faces), ("fallback", self.fallback)):
            if value is not None and self.action != "blurFaces":
                raise InvalidObject(name, "goes with PrivacyControl and action blurFaces; leave it out here")
        if self.valid_from and self.valid_until and self.valid_from >= self.valid_until:
            raise InvalidObject("validUntil", "must be after validFrom")
        return self


def _check_access(spec: PolicySpec) -> None:
    if spec.kind not in {"grant", "denial"}:
        raise InvalidObject("kind", "AccessControl takes grant or denial")
    if not spec.methods:
        raise InvalidObject("methods", "AccessControl needs at least one method")


def _check_limit(spec: PolicySpec) -> None:
    if spec.kind not in {"speed", "altitude"}:
        raise InvalidObject("kind", "LimitControl takes speed or altitude")
    if spec.lower_limit is None and spec.upper_limit is None:
        raise InvalidObject("upperLimit", "LimitControl needs upperLimit or lowerLimit")
    if spec.lower_limit is not None and spec.upper_limit is not None and spec.lower_limit > spec.upper_limit:
        raise InvalidObject("lowerLimit", "must not be above upperLimit")
    if spec.action not in {None, "enforce", "refuse"}:
        raise InvalidObject("action", "LimitControl takes enforce or refuse")


def _check_geofence(spec: PolicySpec) -> None:
    if spec.kind not in {"inclusion", "exclusion"}:
        raise InvalidObject("kind", "GeofenceControl takes inclusion or exclusion")
    if not spec.selector.zones:
        raise InvalidObject("selector.zones", "GeofenceControl needs at least one zone")
    if spec.action not in {None, "ignore", "adjust", "hover", "land", "returnToLaunch", "revoke"}:
        raise InvalidObject("action", "GeofenceControl takes ignore, adjust, hover, land, returnToLaunch or revoke")


def _check_privacy(spec: PolicySpec) -> None:
    if spec.kind != "camera":
        raise InvalidObject("kind", "PrivacyControl takes camera")
    if spec.action not in {"refuse", "black", "blurAverage", "blurMedian", "blurFaces", "removeBackground"}:
        raise InvalidObject(
            "action",
            "PrivacyControl needs an image filter (black, blurAverage, blurMedian, blurFaces, removeBackground), or refuse",
        )


_KIND_CHECKS = {
    "AccessControl": _check_access,
    "LimitControl": _check_limit,
    "GeofenceControl": _check_geofence,
    "PrivacyControl": _check_privacy,
}


class Policy(Resource):
    """A rule of an authority or a provider."""

    KIND: ClassVar[str] = "Policy"
    PLURAL: ClassVar[str] = "policies"
    SHORT: ClassVar[str] = "pol"
    COLUMNS = (
        ("Type", "string", ".spec.type"),
        ("Kind", "string", ".spec.kind"),
        ("Action", "string", ".spec.action"),
        ("Zones", "string", ".spec.selector.zones"),
        _READY,
        _AGE,
    )

    kind: Literal["Policy"] = "Policy"
    spec: PolicySpec
    status: ReadyStatus | None = None
