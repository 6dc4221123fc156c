"""Zone and Policy: what authorities and providers allow (thesis Table 8.1, Listing 11)."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Annotated, Any, Literal, get_args

from pydantic import Field
from pydantic.alias_generators import to_snake

from fractus_core.api.geometry import Altitude, AltitudeBand, Area, Reference
from fractus_core.api.methods import Method
from fractus_core.api.model import AGE, READY, Conditions, Model, ObservedGeneration, OpenModel, Resource
from fractus_core.api.names import ComponentName, Name
from fractus_core.api.rules import Broken, named_by_others, rule
from fractus_core.api.schedules import ActiveTime, Validity


class ReadyStatus(OpenModel):
    """Whether the object is usable, and why not."""

    observed_generation: ObservedGeneration = None
    conditions: Conditions = ()


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

    description: str = Field(default="", max_length=1024, description="For people.")


class Zone(Resource, plural="zones", short="zn"):
    """A named area that policies refer to."""

    COLUMNS = (("Lower", "number", ".spec.altitude.lower"), ("Upper", "number", ".spec.altitude.upper"), READY, AGE)

    kind: Literal["Zone"] = "Zone"
    spec: ZoneSpec
    status: ReadyStatus | None = None

    _selectable = named_by_others("Zone", "policies")


_NUMBER = r"^[-+]?([0-9]+[.]?[0-9]*|[.][0-9]+)$"


class NodeExpression(Model):
    """A condition on one attribute of a node."""

    key: str = Field(
        min_length=1,
        max_length=128,
        description="Attribute, dotted for nested ones: class, mtom, name, services.camera.model.",
    )
    operator: Literal["In", "NotIn", "Exists", "Gt", "Lt"] = Field(
        description="How the attribute compares with values; Gt and Lt compare numbers."
    )
    values: tuple[Annotated[str, Field(max_length=256)], ...] = Field(
        default=(), max_length=100, description="What it is compared with; left out for Exists."
    )

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
    components: tuple[ComponentName, ...] = Field(default=(), max_length=100, description="Empty: every component.")


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


def _for_other(type_: PolicyType, then: str) -> str:
    """A CEL rule that holds for all other types of policy."""
    return f"self.type == '{type_}' || ({then})"


def _only(message: str, there: Callable[[PolicySpec], bool], cel: str, *fields: str) -> Any:
    """The rule that fields which elsewhere would do nothing are given only where they do something."""

    @rule(cel, f"{message}; remove it, or correct the type")
    def only(self: PolicySpec) -> Broken:
        given = (f for f in fields if getattr(self, to_snake(f)) != PolicySpec.model_fields[to_snake(f)].default)
        return None if there(self) else next(given, None)

    return only


class PolicySpec(Validity):
    """One rule of an authority or a provider."""

    type: PolicyType = Field(
        description="Which calls are allowed (AccessControl), how fast and high to fly (LimitControl), where to fly"
        " (GeofenceControl), or what pictures may show (PrivacyControl)."
    )
    kind: Literal[AccessKind, LimitKind, GeofenceKind, "camera"] = Field(
        description="AccessControl: grant, denial. LimitControl: speed, altitude. GeofenceControl: inclusion, exclusion."
        " PrivacyControl: camera."
    )
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

    _limits_limit = _only(
        "lowerLimit and upperLimit go with type LimitControl",
        lambda spec: spec.type == "LimitControl",
        _for_other("LimitControl", "!has(self.lowerLimit) && !has(self.upperLimit)"),
        "lowerLimit",
        "upperLimit",
    )
    _datum_of_altitudes = _only(
        "altitudeReference goes with type LimitControl and kind altitude",
        lambda spec: spec.type == "LimitControl" and spec.kind == "altitude",
        "(self.type == 'LimitControl' && self.kind == 'altitude') || !has(self.altitudeReference)"
        " || self.altitudeReference == 'home'",
        "altitudeReference",
    )
    _access_to_methods = _only(
        "methods go with type AccessControl",
        lambda spec: spec.type == "AccessControl",
        _for_other("AccessControl", "!has(self.methods) || size(self.methods) == 0"),
        "methods",
    )
    _access_acts_alone = _only(
        "AccessControl takes no action: what it denies is refused",
        lambda spec: spec.type != "AccessControl",
        _for("AccessControl", "!has(self.action)"),
        "action",
    )

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
