"""Zone and Policy: the rules of authorities and providers (thesis Table 8.1, Listing 11)."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Annotated, Any, Literal, get_args

from pydantic import Field
from pydantic.alias_generators import to_snake

from fractus_core.api.geometry import Altitude, AltitudeBand, Area, Point, Reference
from fractus_core.api.methods import CAMERA_METHODS, Method
from fractus_core.api.model import AGE, READY, Conditions, Model, ObservedGeneration, OpenModel, Resource
from fractus_core.api.names import ComponentName, Name
from fractus_core.api.rules import Violation, referenced_by, rule
from fractus_core.api.schedules import ActiveTime, Validity


class ReadyStatus(OpenModel):
    """Readiness of the object."""

    observed_generation: ObservedGeneration = None
    conditions: Conditions = ()


class ZoneShape(Model):
    """Area, altitude band and schedule of a zone."""

    area: Area
    altitude: AltitudeBand | None = Field(
        default=None, description="Altitude band; unset: from the ground without an upper bound."
    )
    schedule: tuple[ActiveTime, ...] = Field(
        default=(),
        max_length=50,
        description="Times at which the zone is active; empty: always. At other times the zone has no effect.",
    )


class ZoneSpec(ZoneShape):
    """Specification of a zone."""

    description: str = Field(default="", max_length=1024, description="Human-readable description.")


class Zone(Resource, plural="zones", short="zn"):
    """A named area that policies refer to."""

    COLUMNS = (("Lower", "number", ".spec.altitude.lower"), ("Upper", "number", ".spec.altitude.upper"), READY, AGE)

    kind: Literal["Zone"] = "Zone"
    spec: ZoneSpec
    status: ReadyStatus | None = None

    _selectable = referenced_by("Zone", "policies")


_NUMBER = r"^[-+]?([0-9]+[.]?[0-9]*|[.][0-9]+)$"


class NodeExpression(Model):
    """A condition on one attribute of a node."""

    key: str = Field(
        min_length=1,
        max_length=128,
        description="Attribute of the node, dotted for nested fields: class, mtom, name, services.camera.model.",
    )
    operator: Literal["In", "NotIn", "Exists", "Gt", "Lt"] = Field(
        description="Comparison of the attribute with values; Gt and Lt require a number."
    )
    values: tuple[Annotated[str, Field(max_length=256)], ...] = Field(
        default=(), max_length=100, description="Values to compare with; must be empty for Exists."
    )

    @rule(
        "self.operator == 'Exists' ? !has(self.values) || size(self.values) == 0 :"
        " has(self.values) && size(self.values) > 0",
        "values are required for In, NotIn, Gt and Lt, and not allowed for Exists",
    )
    def _values_fit(self) -> Violation:
        return "values" if (self.operator == "Exists") == bool(self.values) else None

    @rule(
        "!(self.operator in ['Gt', 'Lt']) || !has(self.values) || size(self.values) == 1",
        "Gt and Lt require exactly one value",
    )
    def _one_bound(self) -> Violation:
        return "values" if self.operator in {"Gt", "Lt"} and len(self.values) != 1 else None

    @rule(
        f"!(self.operator in ['Gt', 'Lt']) || !has(self.values) || self.values.all(v, v.matches('{_NUMBER}'))",
        "Gt and Lt require a number",
    )
    def _numeric_bound(self) -> Violation:
        compared = self.values if self.operator in {"Gt", "Lt"} else ()
        return next(
            ((f"values[{i}]", f"not {v!r}") for i, v in enumerate(compared) if not re.fullmatch(_NUMBER, v)), None
        )


class ApplicationSelector(Model):
    """Selects applications and their components."""

    namespaces: tuple[Name, ...] = Field(
        default=(), max_length=100, description="Namespaces of applications; empty: all."
    )
    names: tuple[Name, ...] = Field(default=(), max_length=100, description="Names of applications; empty: all.")
    components: tuple[ComponentName, ...] = Field(
        default=(), max_length=100, description="Names of components; empty: all."
    )


class PolicySelector(Model):
    """Selects the places, nodes and applications that a policy applies to. All specified fields must match."""

    zones: tuple[Name, ...] = Field(default=(), max_length=1000, description="Names of Zones; empty: everywhere.")
    nodes: tuple[NodeExpression, ...] = Field(
        default=(), max_length=32, description="Conditions on the node, all of which must match; empty: every node."
    )
    applications: ApplicationSelector | None = Field(
        default=None, description="Applications that the policy applies to; unset: all."
    )


Limit = Annotated[
    Altitude | None,
    Field(description="For LimitControl: speed in m/s, or altitude in metres above altitudeReference."),
]
PolicyType = Literal["AccessControl", "LimitControl", "GeofenceControl", "PrivacyControl"]
AccessKind = Literal["grant", "denial"]
LimitKind = Literal["speed", "altitude"]
GeofenceKind = Literal["inclusion", "exclusion"]
LimitAction = Literal["enforce", "refuse"]
GeofenceAction = Literal["ignore", "adjust", "hover", "land", "returnToLaunch", "abort", "revoke"]
FilterAction = Literal["black", "blurAverage", "blurMedian", "blurFaces", "removeBackground"]
PrivacyAction = Literal["refuse", FilterAction]
FaceMethod = Literal["pixelate", "gaussian"]
Fallback = Literal["blurAverage", "black", "refuse"]

ZoneUse = Literal[
    "exclusion", "noPictures", "inclusion", "denial", "pictureFilter", "altitudeLimit", "speedLimit", "grant"
]
"""Effect of a policy on its zones, from the most to the least restrictive."""

_LIMIT_ACTIONS: dict[str | None, LimitAction] = {action: action for action in get_args(LimitAction)}
_GEOFENCE_ACTIONS: dict[str | None, GeofenceAction] = {action: action for action in get_args(GeofenceAction)}
_FILTER_ACTIONS: dict[str | None, FilterAction] = {action: action for action in get_args(FilterAction)}


def _for(type_: PolicyType, then: str) -> str:
    """Return a CEL rule that applies to one type of policy."""
    return f"self.type != '{type_}' || {then}"


def _among(field: str, choices: object) -> str:
    """Return a CEL expression that is true if a field has one of the values of a closed set."""
    return f"self.{field} in {list(get_args(choices))}"


def _listed(choices: object) -> str:
    *most, last = get_args(choices)
    return f"{', '.join(most)} or {last}"


def _for_other(type_: PolicyType, then: str) -> str:
    """Return a CEL rule that applies to all types of policy except one."""
    return f"self.type == '{type_}' || ({then})"


def _only(message: str, applies: Callable[[PolicySpec], bool], cel: str, *fields: str) -> Any:
    """Return the rule that fields are set only for policies on which they have an effect."""

    @rule(cel, f"{message}; remove it, or correct the type")
    def only(self: PolicySpec) -> Violation:
        changed = (f for f in fields if getattr(self, to_snake(f)) != PolicySpec.model_fields[to_snake(f)].default)
        return None if applies(self) else next(changed, None)

    return only


class PolicySpec(Validity):
    """A rule of an authority or a provider."""

    type: PolicyType = Field(
        description="AccessControl: allowed calls. LimitControl: speed and altitude. GeofenceControl: flight areas."
        " PrivacyControl: images."
    )
    kind: Literal[AccessKind, LimitKind, GeofenceKind, "camera"] = Field(
        description="AccessControl: grant or denial. LimitControl: speed or altitude. GeofenceControl: inclusion or"
        " exclusion. PrivacyControl: camera."
    )
    methods: tuple[Method, ...] = Field(
        default=(), max_length=64, description="For AccessControl: methods that are granted or denied."
    )
    lower_limit: Limit = None
    upper_limit: Limit = None
    altitude_reference: Reference = Field(
        default="home", description="For LimitControl of kind altitude: datum of the limits (home, amsl or terrain)."
    )
    action: Literal[LimitAction, GeofenceAction, FilterAction] | None = Field(
        default=None,
        description="Repair action on a violation. Default: enforce for limits, ignore (discard the request) for geofences.",
    )
    choices: tuple[Literal[LimitAction, GeofenceAction, FilterAction], ...] = Field(
        default=(),
        max_length=16,
        description="Actions that an Application may select instead of action (spec.policyActions); empty: no choice.",
    )
    land_at: Point | None = Field(
        default=None,
        description="For abort: place on the ground at which the system lands the drone; unset, or if it cannot be reached"
        " legally: home.",
    )
    faces: FaceMethod | None = Field(
        default=None, description="For blurFaces: anonymisation method; default: pixelate."
    )
    fallback: Fallback | None = Field(
        default=None,
        description="For blurFaces: filter for images in which faces are too small or too far away to be detected reliably;"
        " default: blurAverage of the whole image.",
    )
    selector: PolicySelector = Field(default_factory=PolicySelector)
    priority: int = Field(
        default=0, ge=-1000, le=1000, description="Precedence among equally restrictive policies; the highest wins."
    )

    @property
    def limit_action(self) -> LimitAction:
        """Action for values beyond the limit."""
        return _LIMIT_ACTIONS.get(self.action, "enforce")

    @property
    def geofence_action(self) -> GeofenceAction:
        """Action on a breach of the geofence."""
        return _GEOFENCE_ACTIONS.get(self.action, "ignore")

    @property
    def filter_action(self) -> FilterAction | None:
        """Filter for images, or None if the policy refuses them."""
        return _FILTER_ACTIONS.get(self.action)

    @property
    def zone_uses(self) -> frozenset[ZoneUse]:
        """Effects of the policy on its zones. A denial of `CaptureImage` means that no pictures are taken."""
        match self.type:
            case "GeofenceControl":
                return frozenset({"inclusion" if self.kind == "inclusion" else "exclusion"})
            case "LimitControl":
                return frozenset({"speedLimit" if self.kind == "speed" else "altitudeLimit"})
            case "PrivacyControl":
                return frozenset({"noPictures" if self.filter_action is None else "pictureFilter"})
        if self.kind == "grant":
            return frozenset({"grant"})
        uses: set[ZoneUse] = set()
        if "CaptureImage" in self.methods:
            uses.add("noPictures")
        if not uses or set(self.methods) - set(CAMERA_METHODS):
            uses.add("denial")
        return frozenset(uses)

    @rule(
        _for("AccessControl", f"({_among('kind', AccessKind)} && has(self.methods) && size(self.methods) > 0)"),
        "AccessControl requires kind grant or denial, and methods",
    )
    def _access(self) -> Violation:
        if self.type != "AccessControl":
            return None
        if self.kind not in get_args(AccessKind):
            return "kind"
        return "methods" if not self.methods else None

    @rule(
        _for("LimitControl", f"({_among('kind', LimitKind)} && (has(self.upperLimit) || has(self.lowerLimit)))"),
        "LimitControl requires kind speed or altitude, and upperLimit or lowerLimit",
    )
    def _limit(self) -> Violation:
        if self.type != "LimitControl":
            return None
        if self.kind not in get_args(LimitKind):
            return "kind"
        return "upperLimit" if self.lower_limit is None and self.upper_limit is None else None

    @rule(
        # Speed: an upper limit of 0 m/s would stop the drone, and a negative limit would fly it backwards. A lower
        # limit of 0 is allowed and has no effect. Altitude: no drone flies below terrain, so an upper limit above
        # terrain must be greater than 0. Limits above home or mean sea level may be negative, because drones may fly
        # below both.
        _for(
            "LimitControl",
            "(!has(self.upperLimit) || self.upperLimit > 0.0 || (self.kind != 'speed'"
            " && !(has(self.altitudeReference) && self.altitudeReference == 'terrain')))"
            " && (self.kind != 'speed' || !has(self.lowerLimit) || self.lowerLimit >= 0.0)",
        ),
        "speed limits require an upperLimit above 0 and a lowerLimit of at least 0 m/s;"
        " limits above terrain require an upperLimit above 0 m",
    )
    def _limits_keepable(self) -> Violation:
        speed = self.kind == "speed"
        lower = self.lower_limit
        upper = self.upper_limit
        if self.type != "LimitControl":
            return None
        if upper is not None and upper <= 0 and (speed or self.altitude_reference == "terrain"):
            return "upperLimit"
        return "lowerLimit" if speed and lower is not None and lower < 0 else None

    @rule(
        _for("LimitControl", f"!has(self.action) || {_among('action', LimitAction)}"),
        f"LimitControl requires action {_listed(LimitAction)}",
    )
    def _limit_action(self) -> Violation:
        return "action" if self.type == "LimitControl" and not self._acts(LimitAction) else None

    _limits_limit = _only(
        "lowerLimit and upperLimit are only allowed for type LimitControl",
        lambda spec: spec.type == "LimitControl",
        _for_other("LimitControl", "!has(self.lowerLimit) && !has(self.upperLimit)"),
        "lowerLimit",
        "upperLimit",
    )
    _datum_of_altitudes = _only(
        "altitudeReference is only allowed for type LimitControl with kind altitude",
        lambda spec: spec.type == "LimitControl" and spec.kind == "altitude",
        "(self.type == 'LimitControl' && self.kind == 'altitude') || !has(self.altitudeReference)"
        " || self.altitudeReference == 'home'",
        "altitudeReference",
    )
    _access_to_methods = _only(
        "methods are only allowed for type AccessControl",
        lambda spec: spec.type == "AccessControl",
        _for_other("AccessControl", "!has(self.methods) || size(self.methods) == 0"),
        "methods",
    )
    _access_acts_alone = _only(
        "AccessControl has no action, because denied calls are always refused",
        lambda spec: spec.type != "AccessControl",
        _for("AccessControl", "!has(self.action)"),
        "action",
    )

    @rule(
        "!has(self.upperLimit) || !has(self.lowerLimit) || self.lowerLimit <= self.upperLimit",
        "lowerLimit must not be above upperLimit",
    )
    def _limits_ordered(self) -> Violation:
        lower = self.lower_limit
        upper = self.upper_limit
        return "lowerLimit" if lower is not None and upper is not None and lower > upper else None

    @rule(
        _for(
            "GeofenceControl",
            f"({_among('kind', GeofenceKind)} && has(self.selector)"
            " && has(self.selector.zones) && size(self.selector.zones) > 0)",
        ),
        "GeofenceControl requires kind inclusion or exclusion, and selector.zones",
    )
    def _geofence(self) -> Violation:
        if self.type != "GeofenceControl":
            return None
        if self.kind not in get_args(GeofenceKind):
            return "kind"
        return "selector.zones" if not self.selector.zones else None

    @rule(
        _for("GeofenceControl", f"!has(self.action) || {_among('action', GeofenceAction)}"),
        f"GeofenceControl requires action {_listed(GeofenceAction)}",
    )
    def _geofence_action(self) -> Violation:
        return "action" if self.type == "GeofenceControl" and not self._acts(GeofenceAction) else None

    @rule(
        "!has(self.choices) || size(self.choices) == 0"
        f" || (self.type == 'GeofenceControl' && self.choices.all(c, c in {list(get_args(GeofenceAction))}))"
        f" || (self.type == 'LimitControl' && self.choices.all(c, c in {list(get_args(LimitAction))}))"
        f" || (self.type == 'PrivacyControl' && self.choices.all(c, c in {list(get_args(PrivacyAction))}))",
        "choices must be actions of the type of the policy",
    )
    def _choices_fit(self) -> Violation:
        actions = {
            "GeofenceControl": get_args(GeofenceAction),
            "LimitControl": get_args(LimitAction),
            "PrivacyControl": get_args(PrivacyAction),
        }
        allowed = actions.get(self.type, ())
        return next(((f"choices[{i}]", choice) for i, choice in enumerate(self.choices) if choice not in allowed), None)

    @rule(
        "!has(self.landAt) || (self.type == 'GeofenceControl' && ((has(self.action) && self.action == 'abort')"
        " || (has(self.choices) && self.choices.exists(c, c == 'abort'))))",
        "landAt is only allowed for GeofenceControl with action abort, or with the choice abort",
    )
    def _landing(self) -> Violation:
        aborts = self.type == "GeofenceControl" and "abort" in {self.action, *self.choices}
        return "landAt" if self.land_at is not None and not aborts else None

    @rule(
        _for("PrivacyControl", f"(self.kind == 'camera' && has(self.action) && {_among('action', PrivacyAction)})"),
        f"PrivacyControl requires kind camera, and action {_listed(PrivacyAction)}",
    )
    def _privacy(self) -> Violation:
        if self.type != "PrivacyControl":
            return None
        if self.kind != "camera":
            return "kind"
        return "action" if self.action not in get_args(PrivacyAction) else None

    @rule(
        "!(has(self.faces) || has(self.fallback)) || (self.type == 'PrivacyControl' && has(self.action)"
        " && self.action == 'blurFaces')",
        "faces and fallback are only allowed for PrivacyControl with action blurFaces",
    )
    def _faces(self) -> Violation:
        if self.type == "PrivacyControl" and self.action == "blurFaces":
            return None
        if self.faces is not None:
            return "faces"
        return "fallback" if self.fallback is not None else None

    def _acts(self, actions: object) -> bool:
        return self.action is None or self.action in get_args(actions)


class PolicyAction(Model):
    """Repair action that an application selects among the choices of a policy."""

    policy: Name = Field(description="Name of the Policy.")
    action: Literal[LimitAction, GeofenceAction, FilterAction] = Field(
        description="Selected action: one of spec.choices of the Policy, or its spec.action."
    )
    land_at: Point | None = Field(
        default=None,
        description="For abort: place on the ground at which the system lands the drone, if spec.choices of the Policy"
        " contains abort; unset: landAt of the Policy, else home.",
    )

    @rule("!has(self.landAt) || self.action == 'abort'", "landAt is only allowed with action abort")
    def _landing(self) -> Violation:
        return "landAt" if self.land_at is not None and self.action != "abort" else None


def one_action_for_each_policy() -> Any:
    """Return the rule that `policyActions` selects at most one action for each policy."""

    @rule(
        "!has(self.policyActions) || self.policyActions.all(a, self.policyActions.exists_one(b, b.policy == a.policy))",
        "policyActions has at most one entry for each policy",
    )
    def distinct_policies(self: Any) -> Violation:
        names = [each.policy for each in self.policy_actions]
        return next(((f"policyActions[{i}].policy", name) for i, name in enumerate(names) if name in names[:i]), None)

    return distinct_policies


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
