"""Parsers of custom resources. An object that cannot be parsed does not affect other objects."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from fractus_core.api import Application, Condition, DeploymentPlan, InvalidObject, Metadata, Resource
from fractus_core.api.flight_plans import application_name
from fractus_core.api.plans import DeploymentPlanSpec
from pydantic import ValidationError

from fractus_operator.kinds import Body, Key

log = logging.getLogger(__name__)

R = TypeVar("R", bound=Resource)
T_co = TypeVar("T_co", covariant=True)

SETTLED = frozenset({"Returning", "Completed", "Failed"})
"""Phases of an Application whose mission is over. In phase Returning, its drone is still in the air."""


class CachedObjects(Protocol[T_co]):
    """The current objects of a kind by key, as an informer caches them."""

    def get(self, key: Key) -> T_co | None:
        """Return the object with this key, or None."""

    def items(self) -> Iterator[tuple[Key, T_co]]:
        """Iterate over all objects with their keys."""

    def values(self) -> Iterator[T_co]:
        """Iterate over all objects."""

    def __len__(self) -> int:
        """Return the number of objects."""


@dataclass(frozen=True)
class _Object:
    body: Body

    @property
    def metadata(self) -> Metadata:
        """The parsed metadata."""
        return Metadata.model_validate(self.body["metadata"])


@dataclass(frozen=True)
class Submitted(_Object):
    """An Application as submitted.

    Attributes:
        application: The parsed Application, or None if it is invalid.
        error: Reason why it is invalid.
    """

    application: Application | None
    error: InvalidObject | None

    @property
    def uid(self) -> str:
        """metadata.uid."""
        return str(self.body["metadata"].get("uid", ""))

    @property
    def key(self) -> Key:
        """(namespace, name)."""
        return self.body["metadata"].get("namespace", ""), self.body["metadata"]["name"]

    @property
    def flight_plan_uid(self) -> str:
        """Uid of the FlightPlan whose flight the Application is; empty for other Applications.

        The name must match as well, because every user may name a plan as the owner of an Application.
        """
        owners = self.metadata.owner_references
        uid = owners[0].uid if owners else ""
        return uid if uid and self.key[1] == application_name(uid) else ""


@dataclass(frozen=True, slots=True)
class OwnedPlan:
    """A plan and the uid of its Application."""

    uid: str
    spec: DeploymentPlanSpec


@dataclass(frozen=True)
class Unreadable(_Object):
    """An object that the API server accepted but that cannot be parsed."""

    problem: str

    @property
    def name(self) -> str:
        """metadata.name."""
        return str(self.body["metadata"]["name"])

    @property
    def spec(self) -> Any:
        """The unparsed spec."""
        return self.body.get("spec")

    @property
    def conditions(self) -> tuple[Condition, ...]:
        """The conditions, or an empty tuple if they cannot be parsed."""
        try:
            return tuple(Condition.model_validate(c) for c in (self.body.get("status") or {}).get("conditions") or ())
        except ValidationError:
            return ()


def parse_object(model: type[R], body: Body) -> R:
    """Parse an object.

    Raises:
        InvalidObject: The object cannot be parsed, for any reason.
    """
    try:
        return model.model_validate(body)
    except ValidationError as error:
        raise InvalidObject.from_pydantic(error) from None
    except Exception as error:
        raise InvalidObject("", f"the object cannot be parsed: {type(error).__name__}: {error}") from error


def parse_application(body: Body) -> Submitted:
    """Parse an Application. If the Application is invalid, the result contains the reason."""
    try:
        return Submitted(body, parse_object(Application, body), None)
    except InvalidObject as error:
        return Submitted(body, None, error)


def parse_plan(body: Body) -> OwnedPlan | None:
    """Parse a DeploymentPlan. Return None if it is invalid or has no owner."""
    plan = optional_parser(DeploymentPlan)(body)
    if plan is None or not plan.metadata.owner_references:
        return None
    return OwnedPlan(plan.metadata.owner_references[0].uid, plan.spec)


def optional_parser(model: type[R]) -> Callable[[Body], R | None]:
    """Return a parser that logs an invalid object and returns None for it."""

    def parse(body: Body) -> R | None:
        try:
            return parse_object(model, body)
        except InvalidObject as error:
            log.warning(
                "parsing: invalid object ignored (kind=%s name=%s error=%s)",
                model.KIND,
                body["metadata"]["name"],
                error,
            )
            return None

    return parse


def tolerant_parser(model: type[R]) -> Callable[[Body], R | Unreadable]:
    """Return a parser that returns `Unreadable` for an invalid object, for kinds whose invalid objects must not be ignored."""

    def parse(body: Body) -> R | Unreadable:
        try:
            return parse_object(model, body)
        except InvalidObject as error:
            return Unreadable(body, str(error))

    return parse
