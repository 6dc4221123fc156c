"""Condition Ready of ApplicationTemplates."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any, cast

import pytest
from fractus_operator.cache import ClusterCache
from fractus_operator.kinds import Body, Kind
from fractus_operator.store import Store
from fractus_operator.template_controller import TemplateController
from test_ordered_applications import template

KEY = ("", "survey")


class Api:
    """Fake API server that stores statuses and the reasons of Events."""

    def __init__(self) -> None:
        self.written: list[Body] = []
        self.events: list[tuple[str, bool]] = []

    async def apply(self, _kind: Kind, body: Body, *, subresource: str) -> Body:
        assert subresource == "status"
        self.written.append(body["status"])
        return body

    async def create_event(self, _regarding: Body, *, reason: str, warning: bool, **_: Any) -> None:
        self.events.append((reason, warning))


def controller(approved: int | None, **spec: Any) -> tuple[Api, ClusterCache, TemplateController]:
    api = Api()
    cache = ClusterCache(cast(Store, None))
    cache.templates.record_write(KEY, template(approved=approved, **spec).to_dict())
    return api, cache, TemplateController(cast(Any, api), cache, lambda: datetime(2026, 6, 1, tzinfo=UTC))


@pytest.mark.parametrize(
    ("approved", "expected", "message"),
    [
        (3, ("True", "Approved"), "ann has approved generation 3"),
        (2, ("False", "NotApproved"), "of the change since generation 2"),
        (None, ("False", "NotApproved"), "ask the authority for an approval"),
    ],
)
async def test_template_is_ready_while_its_generation_is_approved(
    approved: int | None, expected: tuple[str, str], message: str
) -> None:
    api, _, templates = controller(approved)
    await templates.reconcile(KEY)
    ((condition,),) = [status["conditions"] for status in api.written]
    assert (condition["status"], condition["reason"]) == expected
    assert condition["message"].endswith(message)
    assert "approval" not in api.written[0], "only the authority writes the approval"
    assert api.events == [(expected[1], False)]


async def test_unchanged_template_is_not_written_again() -> None:
    api, cache, templates = controller(3)
    await templates.reconcile(KEY)
    body = template().to_dict()
    body["status"] |= api.written[0]
    cache.templates.record_write(KEY, body)
    await templates.reconcile(KEY)
    assert len(api.written) == 1


async def test_template_with_invalid_schema_of_parameters_is_not_ready() -> None:
    api, _, templates = controller(3, parameters={"properties": {"speed": {"type": "float"}}})
    await templates.reconcile(KEY)
    ((condition,),) = [status["conditions"] for status in api.written]
    assert (condition["status"], condition["reason"]) == ("False", "InvalidSchema")
    assert condition["message"].startswith("spec.parameters.properties.speed.type: 'float' is not valid")
    assert api.events == [("InvalidSchema", True)]
