"""Zone and Policy: what authorities and providers allow (thesis Table 8.1, Listing 11)."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Annotated, Literal, get_args

from pydantic import Field

from fractus_core.api.geometry import Altitude, AltitudeBand, Area, Reference
from fractus_core.api.methods import Method
from fractus_core.api.model import AGE, READY, Condition, Model, OpenModel, Resource
from fractus_core.api.names import Name
from fractus_core.api.rules import Broken, rule


class ReadyStatus(OpenModel):
    """Whether the object is usable, and why not."""

    observed_generation: int | None = None
    conditions: tuple[Condition, ...] = ()


Day = Literal["Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun"]
ClockTime = Annotated[str, Field(pattern=r"^([01][0-9]|2[0-3]):[0-5][0-9]$", max_length=5)]

_DAYS: tuple[Day, ...] = get_args(Day)
_DAY_S = 86_400.0
_THURSDAY = 3
"""1970-01-01 was one."""


class Validity(Model):
    """A window of time, open at the end that is not given."""

    valid_from: datetime | None = Field(default=None, description="RFC 3339; unset: always valid before validUntil.")
    valid_until: datetime | None = Field(default=None, description="RFC 3339; unset: valid indefinitely.")

    @rule(
        "!has(self.validFrom) || !has(self.validUntil) || self.validFrom < self.validUntil",
        "validUntil must be after validFrom",
    )
    def _ordered(self) -> Broken:
        return "validUntil" if self.window_s[0] >= self.window_s[1] else None

    @property
    def window_s(self) -> tuple[float, float]:
        """Begin and end in seconds since 1970 UTC, infinite where they are not given; the end is not part of it."""
        begin = -math.inf if self.valid_from is None else _unix(self.valid_from)
        return begin, math.inf if self.valid_until is None else _unix(self.valid_until)


class ActiveTime(Validity):
    """When a zone is active; what is given must hold together. Times are UTC, as in ED-269."""

    days: tuple[Day, ...] = Field(default=(), max_length=7, description="Days of the week in UTC; empty: every day.")
    start: ClockTime | None = Field(default=None, description="HH:MM, UTC; unset: midnight.")
    end: ClockTime | None = Field(
        default=None, description="HH:MM, UTC; not later than start: on the day after. Unset: midnight."
    )

    @rule("has(self.start) == has(self.end)", "give start and end together, or neither")
    def _start_and_end(self) -> Broken:
        return "start" if (self.start is None) != (self.end is None) else None

    def active(self, time_s: float) -> bool:
        """Whether a moment, in seconds since 1970 UTC, is in this time."""
        begin_s, end_s = self.window_s
        if not begin_s <= time_s < end_s:
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


class ZoneShape(Model):
    """A piece of air, and when it counts."""

    area: Area
    altitude: AltitudeBand | None = Field(default=None, description="The slab of air; unset: from the ground up.")
    schedule: tuple[ActiveTime, ...] = Field(
        default=(),
        max_length=50,
        description="When the zone is active; empty: always. Outside it, it is as if not there.",
    )


class ZoneSpec(ZoneShape):
    """A named piece of air or ground."""

    description: str = Field(default="", max_length=1024)


class Zone(Resource, plural="zones", short="zn"):
    """A named area that policies refer to."""

    COLUMNS = (("Lower", "number", ".spec.altitude.lower"), ("Upper", "number", ".spec.altitude.upper"), READY, AGE)

    kind: Literal["Zone"] = "Zone"
    spec: ZoneSpec
    status: ReadyStatus | None = None


_NUMBER = r"^[-+]?([0-9]+[.]?[0-9]*|[.][0-9]+)$"


class NodeExpression(Model):
    """A condition on one attribute of a node."""

    key: str = Field(
        min_length=1,
        max_length=128,
        description="Attribute, dotted for nested ones: class, mtom, name, services.camera.model.",
    )
    operator: Literal["In", "NotIn", "Exists", "Gt", "Lt"]
    values: tuple[Annotated[str, Field(max_length=256)], ...] = Field(default=(), max_length=100)

    @rule(
        "self.operator == 'Exists' ? !has(self.values) || size(self.values) == 0 :"
        " has(self.values) && size(self.values) > 0",
        "values must be given for In, NotIn, Gt and Lt, and left out for Exists",
    )
    def _values_fit(self) -> Broken:
        return "values" if (self.operator == "Exists") == bool(self.values) else None

    @rule(
        "!(self.operator in ['Gt', 'Lt']) || !has(self.values) || size(self.values) == 1",
        "Gt and Lt take exactly one value",
    )
    def _one_bound(self) -> Broken:
        return "values" if self.operator in {"Gt", "Lt"} and len(self.values) != 1 else None

    @rule(
        f"!(self.operator in ['Gt', 'Lt']) || !has(self.values) || self.values.all(v, v.matches('{_NUMBER}'))",
        "Gt and Lt compare numbers",
    )
    def _numeric_bound(self) -> Broken:
        compared = self.values if self.operator in {"Gt", "Lt"} else ()
        return next(
            ((f"values[{i}]", f"not {v!r}") for i, v in enumerate(compared) if not re.fullmatch(_NUMBER, v)), None
        )


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


Limit = Annotated[
    Altitude | None, Field(description="For LimitControl: m/s, or metres in the datum of altitudeReference.")
]
PolicyType = Literal["AccessControl", "LimitControl", "GeofenceControl", "PrivacyControl"]
AccessKind = Literal["grant", "denial"]
LimitKind = Literal["speed", "altitude"]
GeofenceKind = Literal["inclusion", "exclusion"]
LimitAction = Literal["enforce", "refuse"]
GeofenceAction = Literal["ignore", "adjust", "hover", "land", "returnToLaunch", "revoke"]
FilterAction = Literal["black", "blurAverage", "blurMedian", "blurFaces", "removeBackground"]
PrivacyAction = Literal["refuse", FilterAction]
FaceMethod = Literal["pixelate", "gaussian"]
Fallback = Literal["blurAverage", "black", "refuse"]

_LIMIT_ACTIONS: dict[str | None, LimitAction] = {action: action for action in get_args(LimitAction)}
_GEOFENCE_ACTIONS: dict[str | None, GeofenceAction] = {action: action for action in get_args(GeofenceAction)}
_FILTER_ACTIONS: dict[str | None, FilterAction] = {action: action for action in get_args(FilterAction)}


def _for(type_: PolicyType, then: str) -> str:
    """A CEL rule that holds for one type of policy."""
    return f"self.type != '{type_}' || {then}"


def _among(field: str, choices: object) -> str:
    """CEL: whether a field has one of the values of a closed set."""
    return f"self.{field} in {list(get_args(choices))}"


def _listed(choices: object) -> str:
    *most, last = get_args(choices)
    return f"{', '.join(most)} or {last}"


class PolicySpec(Validity):
    """One rule of an authority or a provider."""

    type: PolicyType
    kind: Literal[AccessKind, LimitKind, GeofenceKind, "camera"]
    methods: tuple[Method, ...] = Field(default=(), max_length=64, description="For AccessControl: the methods meant.")
    lower_limit: Limit = None
    upper_limit: Limit = None
    altitude_reference: Reference = Field(
        default="home", description="For LimitControl altitude: what the limits are measured from."
    )
    action: Literal[LimitAction, GeofenceAction, FilterAction] | None = Field(
        default=None,
        description="What happens on a violation; unset: enforce for limits, ignore (the request is discarded) for geofences.",
    )
    faces: FaceMethod | None = Field(default=None, description="For blurFaces: how faces are hidden; unset: pixelate.")
    fallback: Fallback | None = Field(
        default=None,
        description="For blurFaces: what is done where faces would be too small or too far to be found reliably;"
        " unset: blurAverage, of the whole picture.",
    )
    selector: PolicySelector = Field(default_factory=PolicySelector)
    priority: int = Field(default=0, ge=-1000, le=1000, description="Decides between equally restrictive policies.")

    @property
    def limit_action(self) -> LimitAction:
        """What a limit does with a value beyond it."""
        return _LIMIT_ACTIONS.get(self.action, "enforce")

    @property
    def geofence_action(self) -> GeofenceAction:
        """What a geofence does on a breach."""
        return _GEOFENCE_ACTIONS.get(self.action, "ignore")

    @property
    def filter_action(self) -> FilterAction | None:
        """What a privacy policy has done to pictures; None where it refuses them."""
        return _FILTER_ACTIONS.get(self.action)

    @rule(
        _for("AccessControl", f"({_among('kind', AccessKind)} && has(self.methods) && size(self.methods) > 0)"),
        "AccessControl takes kind grant or denial, and methods",
    )
    def _access(self) -> Broken:
        if self.type != "AccessControl":
            return None
        return "kind" if self.kind not in get_args(AccessKind) else "methods" if not self.methods else None

    @rule(
        _for("LimitControl", f"({_among('kind', LimitKind)} && (has(self.upperLimit) || has(self.lowerLimit)))"),
        "LimitControl takes kind speed or altitude, and upperLimit or lowerLimit",
    )
    def _limit(self) -> Broken:
        if self.type != "LimitControl":
            return None
        unlimited = self.lower_limit is None and self.upper_limit is None
        return "kind" if self.kind not in get_args(LimitKind) else "upperLimit" if unlimited else None

    @rule(
        # An upper limit of 0 m/s would hold a drone where it is, and one below 0 flies it backwards; lower ones may be 0,
        # which limits nothing. Below terrain no drone flies; below home and mean sea level it may, down to what
        # `Altitude` bounds.
        _for(
            "LimitControl",
            "(!has(self.upperLimit) || self.upperLimit > 0.0 || (self.kind != 'speed'"
            " && !(has(self.altitudeReference) && self.altitudeReference == 'terrain')))"
            " && (self.kind != 'speed' || !has(self.lowerLimit) || self.lowerLimit >= 0.0)",
        ),
        "a speed has an upperLimit above 0 and a lowerLimit of at least 0 m/s,"
        " an altitude above terrain an upperLimit above 0 m",
    )
    def _limits_keepable(self) -> Broken:
        speed, lower, upper = self.kind == "speed", self.lower_limit, self.upper_limit
        if self.type != "LimitControl":
            return None
        if upper is not None and upper <= 0 and (speed or self.altitude_reference == "terrain"):
            return "upperLimit"
        return "lowerLimit" if speed and lower is not None and lower < 0 else None

    @rule(
        _for("LimitControl", f"!has(self.action) || {_among('action', LimitAction)}"),
        f"LimitControl takes action {_listed(LimitAction)}",
    )
    def _limit_action(self) -> Broken:
        return "action" if self.type == "LimitControl" and not self._acts(LimitAction) else None

    @rule(
        "!has(self.upperLimit) || !has(self.lowerLimit) || self.lowerLimit <= self.upperLimit",
        "lowerLimit must not be above upperLimit",
    )
    def _limits_ordered(self) -> Broken:
        lower, upper = self.lower_limit, self.upper_limit
        return "lowerLimit" if lower is not None and upper is not None and lower > upper else None

    @rule(
        _for(
            "GeofenceControl",
            f"({_among('kind', GeofenceKind)} && has(self.selector)"
            " && has(self.selector.zones) && size(self.selector.zones) > 0)",
        ),
        "GeofenceControl takes kind inclusion or exclusion, and selector.zones",
    )
    def _geofence(self) -> Broken:
        if self.type != "GeofenceControl":
            return None
        return (
            "kind" if self.kind not in get_args(GeofenceKind) else "selector.zones" if not self.selector.zones else None
        )

    @rule(
        _for("GeofenceControl", f"!has(self.action) || {_among('action', GeofenceAction)}"),
        f"GeofenceControl takes action {_listed(GeofenceAction)}",
    )
    def _geofence_action(self) -> Broken:
        return "action" if self.type == "GeofenceControl" and not self._acts(GeofenceAction) else None

    @rule(
        _for("PrivacyControl", f"(self.kind == 'camera' && has(self.action) && {_among('action', PrivacyAction)})"),
        f"PrivacyControl takes kind camera, and action {_listed(PrivacyAction)}",
    )
    def _privacy(self) -> Broken:
        if self.type != "PrivacyControl":
            return None
        return "kind" if self.kind != "camera" else "action" if self.action not in get_args(PrivacyAction) else None

    @rule(
        "!(has(self.faces) || has(self.fallback)) || (self.type == 'PrivacyControl' && has(self.action)"
        " && self.action == 'blurFaces')",
        "faces and fallback go with PrivacyControl and action blurFaces",
    )
    def _faces(self) -> Broken:
        if self.type == "PrivacyControl" and self.action == "blurFaces":
            return None
        return "faces" if self.faces is not None else "fallback" if self.fallback is not None else None

    def _acts(self, actions: object) -> bool:
        return self.action is None or self.action in get_args(actions)


class Policy(Resource, plural="policies", short="pol"):
    """A rule of an authority or a provider."""

    COLUMNS = (
        ("Type", "string", ".spec.type"),
        ("Kind", "string", ".spec.kind"),
        ("Action", "string", ".spec.action"),
        ("Zones", "string", ".spec.selector.zones"),
        READY,
        AGE,
    )

    kind: Literal["Policy"] = "Policy"
    spec: PolicySpec
    status: ReadyStatus | None = None
