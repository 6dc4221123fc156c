"""Tracing of calls: set-up of the export, content of spans, and calls that continue if tracing fails."""

from __future__ import annotations

import asyncio
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator

import fractus.tracing
import grpc
import pytest
from collector import Collector, collecting
from fractus_runtime import tracing
from opentelemetry import trace
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter

METHOD = "fractus.v1.MobilityService/Goto"
PARENT = "00-4bf92f3577b34da6a3ce929d0e0e4736-{:016x}-01"


@pytest.fixture
def collector(monkeypatch: pytest.MonkeyPatch) -> Iterator[Collector]:
    with collecting() as collector:
        for name, value in collector.environment.items():
            monkeypatch.setenv(name, value)
        yield collector


@pytest.fixture
def close(collector: Collector, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], None]]:
    """Export the spans of the test to the collector.

    The fixture returns a function that exports the remaining spans.
    """
    monkeypatch.setattr(tracing, "_tracer", trace.NoOpTracer())
    close = tracing.configure("mobility", "drone-1", os.environ)
    yield close
    close()


@pytest.mark.parametrize("named", [tracing.collector, fractus.tracing.collector])
@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({}, ""),
        ({"OTEL_SERVICE_NAME": "s", "OTEL_TRACES_SAMPLER": "always_on"}, ""),
        ({"OTEL_EXPORTER_OTLP_ENDPOINT": "http://a:1"}, "http://a:1"),
        (
            {"OTEL_EXPORTER_OTLP_ENDPOINT": "http://a:1", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT": "http://b:1"},
            "http://b:1",
        ),
        ({"OTEL_EXPORTER_OTLP_ENDPOINT": "http://a:1", "OTEL_SDK_DISABLED": " True "}, ""),
        ({"OTEL_EXPORTER_OTLP_ENDPOINT": "http://a:1", "OTEL_SDK_DISABLED": "false"}, "http://a:1"),
        ({"OTEL_EXPORTER_OTLP_ENDPOINT": "http://a:1", "OTEL_TRACES_EXPORTER": "none"}, ""),
        ({"OTEL_EXPORTER_OTLP_ENDPOINT": "http://a:1", "OTEL_TRACES_EXPORTER": "otlp"}, "http://a:1"),
    ],
)
def test_collector_is_read_from_the_standard_variables(
    named: Callable[[dict[str, str]], str], environment: dict[str, str], expected: str
) -> None:
    assert named(environment) == expected


SERVICE = "from fractus_runtime import tracing; tracing.configure('mobility', 'n', os.environ)()"
SDK = "import fractus, grpc; from fractus.tracing import traced; traced(grpc.aio.insecure_channel('127.0.0.1:1'))"


def run_program(program: str, **environment: str) -> str:
    """Run a program that must succeed, and return its stderr."""
    env = {name: value for name, value in os.environ.items() if not name.startswith("OTEL_")} | environment
    argv = [sys.executable, "-c", f"import os, sys; {program}"]
    return subprocess.run(argv, env=env, capture_output=True, text=True, check=True, timeout=120).stderr


@pytest.mark.parametrize("program", [SERVICE, SDK], ids=["service", "sdk"])
@pytest.mark.parametrize(
    "off", [{}, {"OTEL_EXPORTER_OTLP_ENDPOINT": "http://127.0.0.1:1", "OTEL_SDK_DISABLED": "true"}]
)
def test_opentelemetry_sdk_is_not_imported_without_a_collector(program: str, off: dict[str, str]) -> None:
    modules = run_program(f"{program}; print(*sys.modules, file=sys.stderr)", **off)
    assert "opentelemetry.trace" in modules
    assert not [name for name in modules.split() if name.startswith(("opentelemetry.sdk", "opentelemetry.exporter"))]


@pytest.mark.parametrize("program", [SERVICE, SDK], ids=["service", "sdk"])
@pytest.mark.parametrize(
    ("statement", "message"),
    [
        ("sys.modules['opentelemetry.sdk'] = None", "install the extra `tracing` (missing=opentelemetry.sdk"),
        ("os.environ['OTEL_EXPORTER_OTLP_PROTOCOL'] = 'http/protobuf'", "use grpc and the collector's port for it"),
        ("os.environ['OTEL_EXPORTER_OTLP_TIMEOUT'] = 'soon'", "check the OTEL_ variables (error=could not convert"),
    ],
    ids=["not installed", "protocol", "timeout"],
)
def test_failure_to_set_up_tracing_is_logged_and_not_raised(program: str, statement: str, message: str) -> None:
    output = run_program(f"{statement}; {program}", OTEL_EXPORTER_OTLP_ENDPOINT="http://127.0.0.1:1")
    assert "tracing: off" in output
    assert message in output


def test_spans_are_no_ops_without_a_collector() -> None:
    with (
        tracing.server_span(METHOD, (("traceparent", PARENT.format(5)),), grpc.aio.AbortError),
        tracing.child_span("part") as part,
    ):
        tracing.set_verdict(part, "deny", "Code", ("policy",))
        assert not part.is_recording()
        assert not trace.get_current_span().is_recording()


async def test_child_spans_in_tasks_of_a_call_belong_to_the_call(
    close: Callable[[], None], collector: Collector
) -> None:
    async def judge() -> None:
        with tracing.child_span("part") as part:
            tracing.set_verdict(part, "deny", "", ())

    with tracing.server_span(METHOD, (), grpc.aio.AbortError):
        await asyncio.create_task(judge())
        with pytest.raises(OSError, match="lat"), tracing.child_span("failed"):
            raise OSError("lat 50.1")
    close()
    part, failed, call = collector.spans
    assert [span.name for span in collector.spans] == ["part", "failed", METHOD]
    assert {part.span.parent_span_id, failed.span.parent_span_id} == {call.span.span_id}
    assert part.attributes == {"fractus.verdict.action": "deny"}
    assert failed.attributes == {"error.type": "OSError"}, "the text of an error may contain a position"
    assert not failed.span.events
    assert not failed.span.status.message
    assert call.attributes["rpc.grpc.status_code"] == 0


@pytest.mark.parametrize(
    ("error", "status"), [(asyncio.CancelledError(), 1), (ValueError("lat 50.1"), 2), (grpc.aio.AbortError(), 7)]
)
def test_call_span_has_the_status_of_a_failed_call(
    error: BaseException, status: int, close: Callable[[], None], collector: Collector
) -> None:
    with pytest.raises(type(error)), tracing.server_span(METHOD, (), grpc.aio.AbortError):
        tracing.set_status(trace.get_current_span(), 7)
        raise error
    close()
    (call,) = collector.spans
    assert call.attributes["rpc.grpc.status_code"] == status
    assert "50.1" not in str(call.span)


def test_sampler_of_the_environment_selects_traces(collector: Collector, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OTEL_TRACES_SAMPLER", "parentbased_always_off")
    monkeypatch.setattr(tracing, "_tracer", trace.NoOpTracer())
    close = tracing.configure("camera", "n", os.environ)
    for headers in ((), (("traceparent", PARENT.format(5)),)):
        with tracing.server_span(METHOD, headers, grpc.aio.AbortError), tracing.child_span("part"):
            pass
    close()
    assert [span.name for span in collector.spans] == ["part", METHOD], "a sampled trace of the caller continues"


def test_call_continues_if_a_span_cannot_be_started(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    class FailingTracer(trace.NoOpTracer):
        def start_span(self, *_args: object, **_options: object) -> trace.Span:
            raise RuntimeError("custom sampler")

    monkeypatch.setattr(tracing, "_tracer", FailingTracer())
    with tracing.server_span(METHOD, (), grpc.aio.AbortError), tracing.child_span("part"):
        pass
    assert caplog.text.count("tracing: span not started (error=RuntimeError)") == 1


def test_closing_does_not_wait_for_a_blocked_export() -> None:
    close = fractus.tracing._closer(threading.Event().wait)
    close()


def test_component_ends_while_its_collector_does_not_respond() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        run_program(
            "from fractus import tracing; t = tracing._tracer(); t.start_span('one').end(); import threading;"
            " assert any(one.name == 'fractus-tracing' for one in threading.enumerate())",
            OTEL_EXPORTER_OTLP_ENDPOINT=f"http://127.0.0.1:{silent.getsockname()[1]}",
            OTEL_EXPORTER_OTLP_TIMEOUT="3600",
        )


async def test_calls_are_exported_by_the_provider_of_the_program(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    exporter = InMemorySpanExporter()
    provider = TracerProvider()
    provider.add_span_processor(SimpleSpanProcessor(exporter))
    monkeypatch.setattr(trace, "get_tracer_provider", lambda: provider)
    headers: list[dict[str, str]] = []

    async def respond(request: bytes, context: grpc.aio.ServicerContext) -> bytes:
        headers.append(dict(context.invocation_metadata()))
        return request

    server = grpc.aio.server()
    handler = grpc.unary_unary_rpc_method_handler(respond)
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler("a.B", {"C": handler}),))
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    async with grpc.aio.insecure_channel(f"127.0.0.1:{port}") as channel:
        echo = fractus.tracing.traced(channel).unary_unary("/a.B/C")
        with provider.get_tracer("mine").start_as_current_span("mission") as mission:
            assert await echo(b"x", timeout=60) == b"x"
    await server.stop(None)
    call, _ = exporter.get_finished_spans()
    assert (call.name, call.attributes["rpc.grpc.status_code"]) == ("a.B/C", 0)
    assert call.parent.span_id == mission.get_span_context().span_id
    assert headers[0]["traceparent"].startswith(f"00-{call.context.trace_id:032x}-{call.context.span_id:016x}-")
