"""OpenTelemetry spans of this component's calls.

A program that has set up OpenTelemetry itself exports the spans. Otherwise the spans are exported if OpenTelemetry's standard
variables name a collector, and are no-ops if they do not.
"""

from __future__ import annotations

import atexit
import functools
import logging
import os
import threading
from collections.abc import Callable, Mapping
from typing import Any

import grpc
from opentelemetry import trace
from opentelemetry.trace import SpanKind, StatusCode
from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

log = logging.getLogger("fractus")

CLOSE_TIMEOUT_S = 1.0
"""Maximum time for the export of the last spans when the program ends, in seconds."""


UNTRACED = "/ConfirmAlive"
"""Method without spans: the answer to a liveness request, once per second."""


def collector(environment: Mapping[str, str]) -> str:
    """Return the collector's address from OpenTelemetry's standard variables, or an empty string if tracing is off."""
    disabled = environment.get("OTEL_SDK_DISABLED", "").strip().lower() == "true"
    if disabled or environment.get("OTEL_TRACES_EXPORTER", "").strip().lower() == "none":
        return ""
    return environment.get("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT") or environment.get("OTEL_EXPORTER_OTLP_ENDPOINT") or ""


def traced(channel: Any) -> Any:
    """Return a channel for stubs whose calls have spans."""
    return _TracedChannel(channel, _tracer())


def _tracer() -> trace.Tracer:
    try:
        provider = trace.get_tracer_provider()
        if isinstance(provider, trace.ProxyTracerProvider) and collector(os.environ):
            provider = _exporting()
        return provider.get_tracer("fractus")
    except ImportError as error:
        log.warning(
            "tracing: off, a collector is configured but OpenTelemetry is not installed; install the extra `tracing` (missing=%s)",
            error.name,
        )
    except Exception as error:  # An invalid variable must not prevent a flight.
        log.warning("tracing: off, cannot set up OpenTelemetry; check the OTEL_ variables (error=%s)", error)
    return trace.NoOpTracer()


@functools.cache
def _exporting() -> trace.TracerProvider:
    """Return the process's provider that exports spans to the collector of the environment."""
    # The extra `tracing` is optional, and importing it takes seconds on a small computer.
    from opentelemetry.sdk.resources import Resource  # noqa: PLC0415, I001
    from opentelemetry.sdk.trace import TracerProvider  # noqa: PLC0415
    from opentelemetry.sdk.trace.export import BatchSpanProcessor  # noqa: PLC0415
    from opentelemetry.exporter.otlp.proto.grpc.trace_exporter import OTLPSpanExporter  # noqa: PLC0415

    protocol = os.environ.get("OTEL_EXPORTER_OTLP_TRACES_PROTOCOL") or os.environ.get("OTEL_EXPORTER_OTLP_PROTOCOL")
    if protocol not in {None, "", "grpc"}:
        raise ValueError(f"OTEL_EXPORTER_OTLP_PROTOCOL is {protocol}; use grpc and the collector's port for it")
    attributes = {"fractus.node": os.environ.get("FRACTUS_NODE", "")}
    # An attribute from code would override the name in the environment.
    if not os.environ.get("OTEL_SERVICE_NAME") and "service.name=" not in os.environ.get(
        "OTEL_RESOURCE_ATTRIBUTES", ""
    ):
        attributes["service.name"] = os.environ.get("FRACTUS_COMPONENT", "")
    resource = Resource.create({name: value for name, value in attributes.items() if value})
    provider = TracerProvider(resource=resource, shutdown_on_exit=False)
    provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter()))
    atexit.register(_closer(provider.shutdown))
    return provider


class _TracedChannel:
    """Channel for stubs, with a client span per call.

    gRPC's client interceptors are not used, because an intercepted stream is another type of call with another behaviour when
    it is cancelled.
    """

    def __init__(self, channel: Any, tracer: trace.Tracer) -> None:
        self._channel = channel
        self._tracer = tracer

    def unary_unary(self, method: str, *args: Any, **options: Any) -> Callable[..., Any]:
        """Return a callable for a method with one response."""
        if method.endswith(UNTRACED):
            return self._channel.unary_unary(method, *args, **options)  # type: ignore[no-any-return]  # grpc has no types
        return self._traced(method, self._channel.unary_unary(method, *args, **options))

    def unary_stream(self, method: str, *args: Any, **options: Any) -> Callable[..., Any]:
        """Return a callable for a method with a stream of responses."""
        return self._traced(method, self._channel.unary_stream(method, *args, **options))

    def _traced(self, method: str, start_call: Callable[..., Any]) -> Callable[..., Any]:
        name = method.removeprefix("/")
        service, _, short = name.partition("/")
        attributes = {"rpc.system": "grpc", "rpc.service": service, "rpc.method": short}

        def call(request: Any, **options: Any) -> Any:
            span = self._tracer.start_span(name, kind=SpanKind.CLIENT, attributes=attributes)
            headers: dict[str, str] = {}
            TraceContextTextMapPropagator().inject(headers, trace.set_span_in_context(span))

            def end_span(ended: Any) -> None:
                status = _status(ended)
                span.set_attribute("rpc.grpc.status_code", status.value[0])
                # The SDK cancels the stream of a completed motion.
                if status not in {grpc.StatusCode.OK, grpc.StatusCode.CANCELLED}:
                    span.set_status(StatusCode.ERROR)
                span.end()

            started = start_call(request, metadata=tuple(headers.items()), **options)
            if span.is_recording():
                started.add_done_callback(end_span)
            return started

        return call


def _status(call: Any) -> grpc.StatusCode:
    """Return the status of a call that has ended. The coroutine of its method `code` then returns without waiting."""
    code = call.code()
    try:
        code.send(None)
    except StopIteration as result:
        return grpc.StatusCode(result.value)
    code.close()
    return grpc.StatusCode.UNKNOWN


def _closer(shutdown: Callable[[], None]) -> Callable[[], None]:
    """Return a function that calls `shutdown` in a thread and waits at most `CLOSE_TIMEOUT_S` for its end.

    The thread is started now, because an interpreter that is shutting down cannot start threads.
    """
    closing = threading.Event()
    closed = threading.Event()

    def wait() -> None:
        closing.wait()
        shutdown()
        closed.set()

    threading.Thread(target=wait, name="fractus-tracing", daemon=True).start()

    def close() -> None:
        closing.set()
        closed.wait(CLOSE_TIMEOUT_S)

    return close
