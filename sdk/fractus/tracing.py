"""Spans of this component's calls, where the environment names a collector of them; elsewhere nothing is imported for it.

A program that has set up OpenTelemetry itself has them exported as it says; for others the standard variables say where to.
"""

from __future__ import annotations

import atexit
import functools
import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import grpc

log = logging.getLogger("fractus")

SAY_AGAIN_S = 60.0
"""Between two lines of the log about what OpenTelemetry says."""
CLOSE_TIMEOUT_S = 1.0
"""How long the end of the program waits for the export of what is left."""


def collector(environment: Mapping[str, str]) -> str:
    """Address of the collector that OpenTelemetry's standard variables name; empty when nothing is to be traced."""
    off = environment.get("OTEL_SDK_DISABLED", "").strip().lower() == "true"
    if off or environment.get("OTEL_TRACES_EXPORTER", "").strip().lower() == "none":
        return ""
    return environment.get("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT") or environment.get("OTEL_EXPORTER_OTLP_ENDPOINT") or ""


def traced(channel: Any) -> Any:
    """A channel whose calls have spans, for a stub to be made on; the channel itself where nothing is traced."""
    if not collector(os.environ) and "opentelemetry.sdk.trace" not in sys.modules:
        return channel
    tracer = _tracer()
    return channel if tracer is None else _TracedChannel(channel, tracer)


def _tracer() -> Any:
    """What makes spans; None where that cannot be, or is not wanted."""
    try:
        from opentelemetry import trace  # noqa: PLC0415 - megabytes that few need
        from opentelemetry.sdk.trace import TracerProvider  # noqa: PLC0415

        provider: Any = trace.get_tracer_provider()
        if not isinstance(provider, TracerProvider):
            provider = _exporting() if collector(os.environ) else None
    except ImportError as error:
        log.warning(
            "tracing: off, a collector is named and OpenTelemetry is not installed; add the extra `tracing` (missing=%s)",
            error.name,
        )
    except Exception as error:  # whatever is wrong with a variable must not keep a component from flying
        log.warning("tracing: off, OpenTelemetry cannot be set up; check the OTEL_ variables (error=%s)", error)
    else:
        return None if provider is None else provider.get_tracer("fractus")
    return None


@functools.cache
def _exporting() -> Any:
    """A provider that exports as the environment says: one for the process, which has a thread for it."""
    from opentelemetry.exporter.otlp.proto.grpc.trace_exporter import OTLPSpanExporter  # noqa: PLC0415
    from opentelemetry.sdk.resources import Resource  # noqa: PLC0415
    from opentelemetry.sdk.trace import TracerProvider  # noqa: PLC0415
    from opentelemetry.sdk.trace.export import BatchSpanProcessor  # noqa: PLC0415

    protocol = os.environ.get("OTEL_EXPORTER_OTLP_TRACES_PROTOCOL") or os.environ.get("OTEL_EXPORTER_OTLP_PROTOCOL")
    if protocol not in {None, "", "grpc"}:
        raise ValueError(f"OTEL_EXPORTER_OTLP_PROTOCOL is {protocol}: name the collector's port for grpc")
    logger = logging.getLogger("opentelemetry")
    logger.propagate, logger.handlers = False, [_Rarely()]
    names = {
        "service.name": os.environ.get("FRACTUS_COMPONENT", ""),
        "fractus.node": os.environ.get("FRACTUS_NODE", ""),
    }
    if os.environ.get("OTEL_SERVICE_NAME") or "service.name=" in os.environ.get("OTEL_RESOURCE_ATTRIBUTES", ""):
        del names["service.name"]  # ours would override it
    told = {name: value for name, value in names.items() if value}
    provider = TracerProvider(resource=Resource.create(told), shutdown_on_exit=False)
    provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter()))
    atexit.register(_closer(provider.shutdown))
    return provider


class _TracedChannel:
    """What a stub needs of a channel.

    gRPC's interceptors are no way to do this: with one, a stream is another kind of call, which is cancelled otherwise.
    """

    def __init__(self, channel: Any, tracer: Any) -> None:
        self._channel, self._tracer = channel, tracer

    def unary_unary(self, method: str, *args: Any, **more: Any) -> Callable[..., Any]:
        """A method with one reply."""
        return self._traced(method, self._channel.unary_unary(method, *args, **more))

    def unary_stream(self, method: str, *args: Any, **more: Any) -> Callable[..., Any]:
        """A method with many."""
        return self._traced(method, self._channel.unary_stream(method, *args, **more))

    def _traced(self, method: str, begin: Callable[..., Any]) -> Callable[..., Any]:
        from opentelemetry.trace import SpanKind, StatusCode, set_span_in_context  # noqa: PLC0415
        from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator  # noqa: PLC0415

        name = method.removeprefix("/")
        service, _, short = name.partition("/")
        told = {"rpc.system": "grpc", "rpc.service": service, "rpc.method": short}

        def call(request: Any, **options: Any) -> Any:
            span = self._tracer.start_span(name, kind=SpanKind.CLIENT, attributes=told)
            headers: dict[str, str] = {}
            TraceContextTextMapPropagator().inject(headers, set_span_in_context(span))

            def over(ended: Any) -> None:
                status = _status(ended)
                span.set_attribute("rpc.grpc.status_code", status.value[0])
                # A stream is cancelled by this SDK, as that of a motion which is complete.
                if status not in {grpc.StatusCode.OK, grpc.StatusCode.CANCELLED}:
                    span.set_status(StatusCode.ERROR)
                span.end()

            begun = begin(request, metadata=tuple(headers.items()), **options)
            begun.add_done_callback(over)
            return begun

        return call


def _status(call: Any) -> grpc.StatusCode:
    """The status of a call that is over: it can only be awaited, but there is nothing left to wait for."""
    asking = call.code()
    try:
        asking.send(None)
    except StopIteration as told:
        return grpc.StatusCode(told.value)
    asking.close()
    return grpc.StatusCode.UNKNOWN


class _Rarely(logging.Handler):
    """Writes what OpenTelemetry says to our log, a line a minute: a collector may be out of reach for long."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._next_s = 0.0

    def emit(self, record: logging.LogRecord) -> None:
        """See `logging.Handler`."""
        if time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + SAY_AGAIN_S
            log.warning("tracing: %s", record.getMessage())


def _closer(shutdown: Callable[[], None]) -> Callable[[], None]:
    """What calls a function that may take long, and waits for `CLOSE_TIMEOUT_S` at most.

    An interpreter that ends starts no thread any more, so the thread for it is there from the beginning.
    """
    closing, closed = threading.Event(), threading.Event()

    def wait() -> None:
        closing.wait()
        shutdown()
        closed.set()

    threading.Thread(target=wait, name="fractus-tracing", daemon=True).start()

    def close() -> None:
        closing.set()
        closed.wait(CLOSE_TIMEOUT_S)

    return close
