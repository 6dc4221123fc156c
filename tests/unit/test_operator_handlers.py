"""kopf handlers: teardown of an Application, and progress stored in annotations."""

from __future__ import annotations

import json
import ssl
from types import SimpleNamespace
from typing import Any

import kopf
import pytest
from fractus_operator.handlers import InMemoryProgress, KopfConnection, operator
from kopf._core.actions.execution import Outcome
from kopf._core.actions.progression import State
from kopf._core.engines.activities import run_activity
from kopf._core.intents.causes import Activity

TEARDOWN = kopf.HandlerId("teardown")
NOTE = "kopf.fractus.dev/teardown"


def body(uid: str = "1", **annotations: str) -> kopf.Body:
    return kopf.Body({"metadata": {"name": "patrol", "uid": uid, "annotations": annotations}})


@pytest.mark.parametrize(
    "noted", ['{"success":true}', '{"delayed":"9999-12-31T00:00:00+00:00"}', "5", "no JSON", "[]", ""]
)
def test_annotations_neither_skip_nor_delay_teardown(noted: str) -> None:
    """Users with edit permission for an Application can write any annotation.

    Such annotations must not prevent the teardown that ends the flight of the Application.
    """
    assert InMemoryProgress("kopf.fractus.dev").fetch(key=TEARDOWN, body=body(**{NOTE: noted})) is None


def test_failed_teardown_is_retried() -> None:
    progress = InMemoryProgress("kopf.fractus.dev")
    patch = kopf.Patch()
    record: Any = {"started": "2026-01-01T00:00:00+00:00", "delayed": "2026-01-01T00:00:05+00:00", "retries": 1}
    progress.store(key=TEARDOWN, record=record, body=body(), patch=patch)
    assert json.loads(patch["metadata"]["annotations"][NOTE]) == record, "the change of the annotation wakes kopf"
    assert progress.fetch(key=TEARDOWN, body=body()) == record
    assert progress.fetch(key=TEARDOWN, body=body(uid="2")) is None, (
        "the progress does not apply to another object with the same name"
    )
    patch = kopf.Patch()
    progress.purge(key=TEARDOWN, body=body(**{NOTE: json.dumps(record)}), patch=patch)
    assert patch["metadata"]["annotations"] == {NOTE: None}
    assert progress.fetch(key=TEARDOWN, body=body()) is None


async def test_unchanged_progress_is_not_stored_again() -> None:
    """After a patch, kopf waits for an event. A patch without changes would never cause this event."""
    progress = InMemoryProgress("kopf.fractus.dev")
    patch = kopf.Patch()
    handler: Any = SimpleNamespace(id=TEARDOWN)
    failed = Outcome(final=False, delay=5.0, exception=kopf.TemporaryError("later"))
    state = State.from_scratch().with_purpose("delete").with_handlers([handler]).with_outcomes({TEARDOWN: failed})
    state.store(body=body(), patch=patch, storage=progress)
    assert patch
    second_patch = kopf.Patch()
    State.from_storage(body=body(), storage=progress, handlers=[handler]).store(
        body=body(), patch=second_patch, storage=progress
    )
    assert not second_patch


def test_kopf_accepts_api_servers_without_authority_key_identifier(monkeypatch: pytest.MonkeyPatch) -> None:
    default_context = ssl.create_default_context

    def strict_context(*args: Any, **kwargs: Any) -> ssl.SSLContext:
        """Create a context with the defaults of Python 3.13."""
        context = default_context(*args, **kwargs)
        context.verify_flags |= ssl.VERIFY_X509_STRICT
        return context

    monkeypatch.setattr(ssl, "create_default_context", strict_context)
    context = KopfConnection(server="https://127.0.0.1:6443").as_ssl_context()
    assert not context.verify_flags & ssl.VERIFY_X509_STRICT
    assert context.verify_mode is ssl.CERT_REQUIRED


async def test_other_tasks_end_after_last_handler_of_kopf(monkeypatch: pytest.MonkeyPatch) -> None:
    """kopf waits five seconds for tasks that it did not start. Meanwhile no operator handles Applications."""
    ended: list[str] = []

    async def end_background() -> None:
        ended.append("background")

    async def stop_kopf(*, registry: kopf.OperatorRegistry, settings: kopf.OperatorSettings, **_: object) -> None:
        """End kopf: its last action before it waits for other tasks is the cleanup."""
        await run_activity(
            lifecycle=kopf.lifecycles.all_at_once,
            registry=registry,
            settings=settings,
            activity=Activity.CLEANUP,
            indices={},  # type: ignore[arg-type]
            memo=None,
        )

    monkeypatch.setattr(kopf, "operator", stop_kopf)
    controller: Any = SimpleNamespace()
    await operator(controller, lambda: 0.0, "", None, end_background)
    assert ended == ["background"]
