"""What traces cost where no one wants them, and that nothing about them keeps a call from being served."""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator

import fractus.tracing
import grpc
import pytest
from collector import Collector, collecting
from fractus_runtime import span_export, spans, tracing
from fractus_runtime.span_export import MAX_CALLS_PER_S, MAX_PARENTS, MAX_PARTS, ExportingTracer
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
def tracer(collector: Collector) -> Iterator[ExportingTracer]:
    logger = logging.getLogger("opentelemetry")
    before = logger.propagate, logger.handlers
    made = tracing.tracer("mobility", "drone-1", os.environ)
    assert isinstance(made, ExportingTracer)
    yield made
    made.close()
    logger.propagate, logger.handlers = before


@pytest.mark.parametrize("named", [tracing.collector, fractus.tracing.collector])
@pytest.mark.parametrize(
    ("environment", "found"),
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
def test_the_standard_variables_turn_traces_on(
    named: Callable[[dict[str, str]], str], environment: dict[str, str], found: str
) -> None:
    assert named(environment) == found


SERVICE = "from fractus_runtime import tracing; assert tracing.tracer('mobility', 'n', os.environ) is None"
SDK = "import fractus; from fractus.tracing import traced; channel = object(); assert traced(channel) is channel"


def ran(program: str, **environment: str) -> str:
    """What a program says to stderr; it must end well."""
    env = {name: value for name, value in os.environ.items() if not name.startswith("OTEL_")} | environment
    argv = [sys.executable, "-c", f"import os, sys; {program}"]
    return subprocess.run(argv, env=env, capture_output=True, text=True, check=True, timeout=120).stderr


@pytest.mark.parametrize("program", [SERVICE, SDK], ids=["service", "sdk"])
@pytest.mark.parametrize(
    "off", [{}, {"OTEL_EXPORTER_OTLP_ENDPOINT": "http://127.0.0.1:1", "OTEL_SDK_DISABLED": "true"}]
)
def test_without_a_collector_nothing_is_imported(program: str, off: dict[str, str]) -> None:
    said = ran(f"{program}; print(*sys.modules, file=sys.stderr)", **off)
    assert "tracing" in said
    assert not [name for name in said.split() if name.startswith(("opentelemetry", "fractus_runtime.span_export"))]


@pytest.mark.parametrize("program", [SERVICE, SDK], ids=["service", "sdk"])
@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ("sys.modules['opentelemetry'] = None", "add the extra `tracing` (missing=opentelemetry)"),
        ("os.environ['OTEL_EXPORTER_OTLP_PROTOCOL'] = 'http/protobuf'", "name the collector's port for grpc"),
        ("os.environ['OTEL_EXPORTER_OTLP_TIMEOUT'] = 'soon'", "check the OTEL_ variables (error=could not convert"),
    ],
    ids=["absent", "protocol", "timeout"],
)
def test_what_keeps_traces_off_is_said_and_harms_nothing(program: str, wrong: str, says: str) -> None:
    said = ran(f"{wrong}; {program}", OTEL_EXPORTER_OTLP_ENDPOINT="http://127.0.0.1:1")
    assert "tracing: off" in said
    assert says in said


def test_outside_of_a_traced_call_nothing_happens() -> None:
    with spans.call().child("part") as part:
        part.note("name", "value")
        part.verdict("deny", "Code", ("policy",))
    assert part is spans.call()


async def test_what_is_done_for_a_call_is_its_part_in_its_tasks_too(
    tracer: ExportingTracer, collector: Collector
) -> None:
    async def later() -> None:
        with spans.call().child("part") as part:
            part.verdict("deny", "", ())

    with tracer.serve(METHOD, ()):
        await asyncio.create_task(later())
        with pytest.raises(OSError, match="lat"), spans.call().child("failed"):
            raise OSError("lat 50.1")
    with spans.call().child("nothing"):
        pass
    with pytest.raises(asyncio.CancelledError), tracer.serve(METHOD, ()):
        raise asyncio.CancelledError
    told = collector.wait(lambda spans: spans if len(spans) == 4 else [])
    part, failed, whole, cancelled = told
    assert [one.name for one in told] == ["part", "failed", METHOD, METHOD]
    assert {part.span.parent_span_id, failed.span.parent_span_id} == {whole.span.span_id}
    assert part.told == {"fractus.verdict.action": "deny"}
    assert failed.told == {"error.type": "OSError"}, "the text of an error may tell a position"
    assert (whole.told["rpc.grpc.status_code"], cancelled.told["rpc.grpc.status_code"]) == (0, 1)


def test_a_flood_of_calls_is_not_traced(
    tracer: ExportingTracer, collector: Collector, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time, "monotonic", lambda: 1000.5)
    for _ in range(MAX_CALLS_PER_S + 50):
        with tracer.serve(METHOD, ()):
            pass
    monkeypatch.undo()
    with tracer.serve("last/Call", ()):
        pass
    collector.wait(lambda spans: any(one.name == "last/Call" for one in spans))
    assert len(collector.spans) == MAX_CALLS_PER_S + 1


def test_a_call_of_many_parts_tells_how_many_are_left_out(tracer: ExportingTracer, collector: Collector) -> None:
    with tracer.serve(METHOD, ()):
        for _ in range(MAX_PARTS + 7):
            with spans.call().child("part"):
                pass
    whole = collector.one(METHOD)
    assert whole.told["fractus.parts_left_out"] == 7
    assert len(collector.spans) == MAX_PARTS + 1


def test_callers_take_bounded_memory(tracer: ExportingTracer) -> None:
    for number in range(1, MAX_PARENTS + 100):
        assert tracer._parent([("traceparent", PARENT.format(number))]) is not None
    assert len(tracer._parents) == MAX_PARENTS
    assert tracer._parent([("traceparent", PARENT.format(MAX_PARENTS))]) is None


def test_what_is_too_long_is_cut(tracer: ExportingTracer, collector: Collector) -> None:
    with tracer.serve(METHOD, ()):
        spans.call().note("fractus.caller", "x" * 10_000)
    assert len(collector.one(METHOD).told["fractus.caller"]) == span_export.MAX_LENGTH


def test_a_sampler_may_leave_calls_out(collector: Collector, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OTEL_TRACES_SAMPLER", "parentbased_always_off")
    tracer = ExportingTracer("camera", "n", os.environ)
    for headers in ((), (("traceparent", PARENT.format(5)),)):
        with tracer.serve(METHOD, headers), spans.call().child("part"):
            pass
    tracer.close()
    assert [one.name for one in collector.spans] == ["part", METHOD], "its caller's trace goes on"


def test_a_failure_of_tracing_is_none_of_the_call(
    tracer: ExportingTracer, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fails(*_args: object, **_more: object) -> None:
        raise RuntimeError("a sampler that someone wrote")

    begun = tracer.serve(METHOD, ())
    monkeypatch.setattr(type(tracer._tracer), "start_span", fails)
    with begun, spans.call().child("part"):
        assert "a part of a call is not traced (error=RuntimeError)" in caplog.text
    with tracer.serve(METHOD, ()), spans.call().child("part"):
        assert "tracing: a call is not traced (error=RuntimeError)" in caplog.text


@pytest.mark.parametrize("closer", [span_export.closer, fractus.tracing._closer])
def test_a_collector_that_never_answers_holds_up_no_end(
    closer: Callable[[Callable[[], object]], Callable[[], None]],
) -> None:
    close = closer(threading.Event().wait)
    close()


def test_a_component_ends_while_its_collector_is_silent() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        ran(
            "from fractus import tracing; t = tracing._tracer(); t.start_span('one').end(); import threading;"
            " assert any(one.name == 'fractus-tracing' for one in threading.enumerate())",
            OTEL_EXPORTER_OTLP_ENDPOINT=f"http://127.0.0.1:{silent.getsockname()[1]}",
            OTEL_EXPORTER_OTLP_TIMEOUT="3600",
        )


async def test_a_program_that_has_set_up_opentelemetry_has_its_calls_in_its_own_traces(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    exporter = InMemorySpanExporter()
    provider = TracerProvider()
    provider.add_span_processor(SimpleSpanProcessor(exporter))
    monkeypatch.setattr(trace, "get_tracer_provider", lambda: provider)
    headers: list[dict[str, str]] = []

    async def answer(request: bytes, context: grpc.aio.ServicerContext) -> bytes:
        headers.append(dict(context.invocation_metadata()))
        return request

    server = grpc.aio.server()
    handler = grpc.unary_unary_rpc_method_handler(answer)
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler("a.B", {"C": handler}),))
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    async with grpc.aio.insecure_channel(f"127.0.0.1:{port}") as channel:
        ask = fractus.tracing.traced(channel).unary_unary("/a.B/C")
        with provider.get_tracer("mine").start_as_current_span("mission") as mission:
            assert await ask(b"x", timeout=60) == b"x"
    await server.stop(None)
    call, _ = exporter.get_finished_spans()
    assert (call.name, call.attributes["rpc.grpc.status_code"]) == ("a.B/C", 0)
    assert call.parent.span_id == mission.get_span_context().span_id
    assert headers[0]["traceparent"].startswith(f"00-{call.context.trace_id:032x}-{call.context.span_id:016x}-")
