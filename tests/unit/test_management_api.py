"""Parts of the management API without an API server: errors, limits, description."""

from __future__ import annotations

import asyncio
import json
import logging
from pathlib import Path
from typing import Any, get_args

import pytest
from fastapi import FastAPI
from fractus_management.api_server import CallerOf
from fractus_management.app import create_app
from fractus_management.command import token_risks
from fractus_management.openapi import text
from fractus_management.problem_details import Refused, from_kubernetes
from fractus_management.request_bodies import merged
from fractus_management.request_limits import RequestLimits
from fractus_management.settings import Settings
from fractus_runtime.kubernetes.errors import from_status, unreachable

DOCUMENT = Path(__file__).parents[2] / "management" / "openapi.json"


def test_checked_in_description_is_that_of_the_routes() -> None:
    assert DOCUMENT.read_text() == text(create_app(Settings())), "run `make generate`"


@pytest.mark.parametrize("status", [400, 403, 404, 409, 410, 422, 429])
def test_refusal_of_api_server_keeps_status_and_message(status: int) -> None:
    refusal = from_kubernetes(from_status(status, {"message": "no", "reason": "Because"}))
    assert refusal.problem.to_dict() == {
        "type": "about:blank", "title": refusal.problem.title, "status": status, "detail": "no",
        "reasons": [{"reason": "Because", "message": "no"}],
    }  # fmt: skip


def test_causes_of_api_server_become_reasons_with_fields() -> None:
    causes = [{"reason": "FieldValueInvalid", "message": "too long", "field": "spec.stay"}, {"field": "spec"}]
    refusal = from_kubernetes(from_status(422, {"message": "no", "reason": "Invalid", "details": {"causes": causes}}))
    assert [reason.to_dict() for reason in refusal.reasons] == [causes[0]]


def test_rejected_token_gets_a_challenge() -> None:
    assert from_kubernetes(from_status(401, {"message": "Unauthorized"})).headers == {"WWW-Authenticate": "Bearer"}


@pytest.mark.parametrize("error", [unreachable("no route"), from_status(500, {}), from_status(504, "proxy")])
def test_failure_of_api_server_is_unavailable_and_may_be_retried(error: Exception) -> None:
    refusal = from_kubernetes(error)
    assert refusal.status == 503
    assert refusal.headers["Retry-After"] == "1"


@pytest.mark.parametrize(
    ("target", "patch", "result"),
    [
        ({"a": 1, "b": 2}, {"a": None}, {"b": 2}),
        ({"a": {"b": 1, "c": 2}}, {"a": {"b": 3}}, {"a": {"b": 3, "c": 2}}),
        ({"a": [1, 2]}, {"a": [3]}, {"a": [3]}),
        ({"a": 1}, {"a": {"b": None}}, {"a": {}}),
        ({}, {"a": {"b": {"c": None, "d": 1}}}, {"a": {"b": {"d": 1}}}),
    ],
)
def test_merge_patch_follows_its_standard(target: object, patch: object, result: object) -> None:
    assert merged(target, patch) == result


@pytest.mark.parametrize("opening", ['{"a":', "["])
@pytest.mark.parametrize("depth", [101, 500, 900])
async def test_deeply_nested_body_is_refused(opening: str, depth: int) -> None:
    closing = "}" if opening.startswith("{") else "]"
    nested = f"{opening * depth}1{closing * depth}"
    spec = f'{{"parameters": {{"a": {nested}}}}}'
    requests = [
        ("POST", "/v1/plans", spec),
        ("PATCH", "/v1/plans/x", spec),
        ("POST", "/v1/apps", f'{{"name": "x", "spec": {spec}}}'),
    ]
    for method, path, body in requests:
        status, _, content = await answer(authenticated(), method, path, body)
        assert status == 422, (method, path)
        assert "nested more than 100 levels deep" in json.loads(content)["detail"]


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-1e400"])
@pytest.mark.parametrize("method", ["POST", "PATCH"])
async def test_number_that_is_not_finite_is_refused_with_its_field(method: str, number: str) -> None:
    path = "/v1/plans" if method == "POST" else "/v1/plans/x"
    body = f'{{"parameters": {{"a": [1, {number}]}}}}'
    status, _, content = await answer(authenticated(), method, path, body)
    (reason,) = json.loads(content)["reasons"]
    assert (status, reason["field"]) == (422, "parameters.a[1]")
    assert "must be a finite number" in reason["message"]


@pytest.fixture
def clock() -> list[float]:
    return [1000.0]


@pytest.fixture
def limits(clock: list[float]) -> RequestLimits:
    settings = Settings(requests_per_s=2, max_streams=3, max_streams_of_token=2)
    return RequestLimits(settings, lambda: clock[0])


def admitted(limits: RequestLimits, token: bytes) -> int:
    """Return how many requests are admitted at once."""
    count = 0
    while count < 100:
        try:
            limits.admit(token)
        except Refused as refusal:
            assert refusal.status == 429
            assert refusal.headers["Retry-After"] == "1"
            break
        count += 1
    return count


def test_token_may_send_a_burst_and_then_its_rate(limits: RequestLimits, clock: list[float]) -> None:
    assert admitted(limits, b"a") == 10
    clock[0] += 1
    assert admitted(limits, b"a") == 2
    assert admitted(limits, b"b") == 10
    clock[0] += 1000
    assert admitted(limits, b"a") == 10


def test_streams_are_limited_for_each_token_and_in_total(limits: RequestLimits) -> None:
    with limits.stream(b"a"), limits.stream(b"a"):
        with pytest.raises(Refused, match="of this token") as refusal, limits.stream(b"a"):
            pass
        assert refusal.value.status == 429
        with limits.stream(b"b"):
            with pytest.raises(Refused, match="the limit") as refusal, limits.stream(b"c"):
                pass
            assert refusal.value.status == 503
    assert limits.streams == 0


def test_pages_of_records_are_limited_for_each_drone() -> None:
    limits = RequestLimits(Settings(max_pages_of_drone=1))
    with limits.page_of_drone("drone-1"), limits.page_of_drone("drone-2"):
        with pytest.raises(Refused, match="drone-1 is reading records") as refusal, limits.page_of_drone("drone-1"):
            pass
        assert (refusal.value.status, refusal.value.reasons[0].reason) == (503, "NodeBusy")
    with limits.page_of_drone("drone-1"):
        pass


@pytest.fixture
def app() -> FastAPI:
    app = create_app(Settings(max_body_bytes=100))

    @app.get("/fails")
    async def fails() -> None:
        raise RuntimeError

    return app


def authenticated() -> FastAPI:
    """Return the API for requests that are refused before they reach the API server."""
    app = create_app(Settings())
    app.dependency_overrides[get_args(CallerOf)[1].dependency] = lambda: None
    return app


async def answer(app: FastAPI, method: str, path: str, body: str | None = "") -> tuple[int, dict[str, str], bytes]:
    """Return status, headers and body of the response to a request. A body that is None never arrives."""
    sent: list[Any] = []

    async def receive() -> dict[str, Any]:
        if body is None:
            await asyncio.Event().wait()
        return {"type": "http.request", "body": (body or "").encode()}

    async def send(message: Any) -> None:
        sent.append(message)

    scope = {
        "type": "http", "method": method, "path": path, "query_string": b"", "http_version": "1.1", "scheme": "http",
        "headers": [(b"content-type", b"application/json"), (b"host", b"test")], "server": ("test", 80),
    }  # fmt: skip
    try:
        await app(scope, receive, send)
    except RuntimeError:
        assert path == "/fails"
    headers = {name.decode(): value.decode() for name, value in sent[0]["headers"]}
    return sent[0]["status"], headers, b"".join(message["body"] for message in sent[1:])


@pytest.mark.parametrize(
    ("method", "path", "body", "status"),
    [
        ("GET", "/v1/nothing", "", 404),
        ("PUT", "/v1/plans", "", 405),
        ("POST", "/v1/plans", "{", 400),
        ("POST", "/v1/plans", " " * 101, 413),
        ("POST", "/v1/plans", "{}", 401),
        ("GET", "/fails", "", 500),
    ],
)
async def test_every_error_is_a_problem(app: FastAPI, method: str, path: str, body: str, status: int) -> None:
    actual, headers, content = await answer(app, method, path, body)
    assert actual == status
    assert headers["content-type"] == "application/problem+json"
    problem = json.loads(content)
    assert problem["status"] == status
    assert problem["reasons"][0]["message"]


async def test_wrong_method_lists_the_right_ones(app: FastAPI) -> None:
    assert (await answer(app, "PUT", "/v1/plans"))[1]["allow"] == "GET, POST"
    assert (await answer(app, "PUT", "/healthz"))[1]["allow"] == "GET"
    status, headers, _ = await answer(app, "PUT", "/v1/plans/morning:end")
    assert (status, headers["allow"]) == (405, "POST")


async def test_slow_body_is_refused() -> None:
    app = create_app(Settings(body_timeout_s=0.05))
    status, headers, _ = await answer(app, "POST", "/v1/plans", None)
    assert (status, headers["content-type"]) == (408, "application/problem+json")


async def test_path_in_the_log_contains_no_line_break(app: FastAPI, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    await answer(app, "GET", "/v1/x\nmanagement: response sent")
    (line,) = [each for each in caplog.messages if "response sent (" in each]
    assert "path=/v1/x%0Amanagement%3A%20response%20sent" in line


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.0.2.1", "example.com"])
def test_listening_on_the_network_without_tls_is_reported(host: str) -> None:
    (warning,) = token_risks(host, "https://192.0.2.2", verified=True)
    assert "put a TLS proxy in front" in warning


@pytest.mark.parametrize("server", ["https://192.0.2.2", "http://127.0.0.1:8001"])
@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "localhost"])
def test_local_connections_without_tls_are_not_reported(host: str, server: str) -> None:
    assert list(token_risks(host, server, verified=True)) == []


@pytest.mark.parametrize(("server", "verified"), [("http://192.0.2.2", True), ("https://192.0.2.2", False)])
def test_sending_tokens_to_an_unverified_api_server_is_reported(server: str, verified: bool) -> None:
    (warning,) = token_risks("127.0.0.1", server, verified=verified)
    assert "API server" in warning
