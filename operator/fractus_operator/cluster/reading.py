"""Reads objects so that one which cannot be read is known as such, and never stops the others."""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from fractus_core.api import (
    Application,
    Condition,
    DeploymentPlan,
    Drone,
    EdgeNode,
    Grant,
    InvalidObject,
    Metadata,
    Resource,
)
from fractus_core.api.plans import DeploymentPlanSpec
from pydantic import ValidationError

from fractus_operator.cluster.kinds import Body, Key

logger = logging.getLogger(__name__)

R = TypeVar("R", bound=Resource)
N = TypeVar("N", Drone, EdgeNode)
P = TypeVar("P", bound=Hashable)
T_co = TypeVar("T_co", covariant=True)

_MAX_PARTS = 10_000

SETTLED = frozenset({"Returning", "Completed", "Failed"})
"""Phases of an application whose mission is over, also while its drone comes home."""


class Copies(Protocol[T_co]):
    """The current objects of a kind by their key: what a reflector keeps."""

    def get(self, key: Key) -> T_co | None:
        """The object with this key, or None."""

    def items(self) -> Iterator[tuple[Key, T_co]]:
        """Every object with its key."""

    def values(self) -> Iterator[T_co]:
        """Every object."""

    def __len__(self) -> int:
        """How many objects there are."""


@dataclass(frozen=True)
class _Object:
    body: Body

    @property
    def metadata(self) -> Metadata:
        """Its metadata."""
        return Metadata.model_validate(self.body["metadata"])


@dataclass(frozen=True)
class Submitted(_Object):
    """An Application as it was submitted: parsed, or with the reason why it cannot be."""

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
    def completed(self) -> bool:
        """Whether its mission was completed, also while its drone comes home."""
        conditions = (self.body.get("status") or {}).get("conditions") or ()
        return any(c["type"] == "MissionComplete" and c["status"] == "True" for c in conditions)

    @property
    def settled_generation(self) -> int | None:
        """The generation whose mission is over; None while a mission goes on, or before the first."""
        status = self.body.get("status") or {}
        return int(status.get("observedGeneration") or 0) if status.get("phase") in SETTLED else None


@dataclass(frozen=True, slots=True)
class OwnedPlan:
    """A plan and the uid of the Application it is for."""

    uid: str
    spec: DeploymentPlanSpec


@dataclass(frozen=True)
class Unreadable(_Object):
    """An object that the API server took and that cannot be read."""

    problem: str

    @property
    def name(self) -> str:
        """metadata.name."""
        return str(self.body["metadata"]["name"])

    @property
    def spec(self) -> Any:
        """As the API server has it."""
        return self.body.get("spec")

    @property
    def conditions(self) -> tuple[Condition, ...]:
        """Its conditions, as far as they can be read."""
        try:
            return tuple(Condition.model_validate(c) for c in (self.body.get("status") or {}).get("conditions") or ())
        except ValidationError:
            return ()


def read(model: type[R], body: Body) -> R:
    """Parse an object.

    Raises:
        InvalidObject: it cannot be parsed, for whatever reason.
    """
    try:
        # As it is: what was decoded from JSON needs no conversion, and large parts are shared with it.
        return model.model_validate(body)
    except ValidationError as error:
        raise InvalidObject.from_pydantic(error) from None
    except Exception as error:
        raise InvalidObject("", f"the object cannot be read: {type(error).__name__}: {error}") from error


def read_submitted(body: Body) -> Submitted:
    """Parse an Application, keeping what cannot be parsed with the reason."""
    try:
        return Submitted(body, read(Application, body), None)
    except InvalidObject as error:
        return Submitted(body, None, error)


def read_plan(body: Body) -> OwnedPlan | None:
    """Parse a DeploymentPlan; None for one that cannot be read or that no Application owns."""
    plan = reader(DeploymentPlan)(body)
    owner = next((o.uid for o in plan.metadata.owner_references), None) if plan is not None else None
    return OwnedPlan(owner, plan.spec) if plan is not None and owner is not None else None


def reader(model: type[R]) -> Callable[[Body], R | None]:
    """A parser that leaves out (None) what cannot be read."""

    def parse(body: Body) -> R | None:
        try:
            return read(model, body)
        except InvalidObject as error:
            logger.warning(
                "reading: object is left out (kind=%s name=%s): %s", model.KIND, body["metadata"]["name"], error
            )
            return None

    return parse


class PartPool:
    """Equal parts of objects, kept once: the services of thousands of nodes of one model, or the areas of grants.

    Args:
        parts: How many parts are remembered to be shared.
    """

    def __init__(self, parts: int = _MAX_PARTS) -> None:
        self._known: dict[Hashable, Any] = {}
        self._parts = parts

    def sharing(self, parse: Callable[[Body], N | None]) -> Callable[[Body], N | None]:
        """A parser whose results share equal parts."""

        def shared(body: Body) -> N | None:
            node = parse(body)
            if node is None:
                return None
            spec = node.spec
            parts = {"services": self._one(spec.services), "interfaces": tuple(map(self._one, spec.interfaces))}
            parts["interfaces"] = self._one(parts["interfaces"])
            return node.model_copy(update={"spec": spec.model_copy(update=parts)})

        return shared

    def grant(self, body: Body) -> Grant | None:
        """Parse a Grant so that it shares equal areas, which have many points, with others."""
        grant = reader(Grant)(body)
        if grant is None:
            return None
        spec = grant.spec
        parts = {"operation_area": self._one(spec.operation_area), "corridor": self._one(spec.corridor)}
        return grant.model_copy(update={"spec": spec.model_copy(update=parts)})

    def _one(self, part: P) -> P:
        if len(self._known) >= self._parts:
            self._known.clear()
        found: P = self._known.setdefault(part, part)
        return found


def tolerant_reader(model: type[R]) -> Callable[[Body], R | Unreadable]:
    """A parser for objects that count also where they cannot be read."""

    def parse(body: Body) -> R | Unreadable:
        try:
            return read(model, body)
        except InvalidObject as error:
            return Unreadable(body, str(error))

    return parse
