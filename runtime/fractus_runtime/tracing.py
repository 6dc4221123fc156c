"""OpenTelemetry spans of the calls of a service. Spans are no-ops unless the environment names a collector.

The span of a call is the current span of its asyncio context, which tasks inherit. Spans must not contain positions, images,
keys or the text of reasons and errors, because a collector may belong to another party (docs/tracing.md).
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager

from opentelemetry import trace
from opentelemetry.context import Context
from opentelemetry.trace import Span, SpanKind, StatusCode
from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

log = logging.getLogger(__name__)

STATUS = "rpc.grpc.status_code"
CLOSE_TIMEOUT_S = 1.0
"""Maximum time for the export of the last spans when the process ends, in seconds."""

_OK = 0
_CANCELLED = 1
_UNKNOWN = 2
_SERVER_FAULTS = frozenset({2, 4, 12, 13, 14, 15})
"""gRPC status codes that are errors of a server. All other codes are results for the caller."""

_tracer: trace.Tracer = trace.NoOpTracer()


def collector(environment: Mapping[str, str]) -> str:
    """Return the collector's address from OpenTelemetry's standard variables, or an empty string if tracing is off."""
    disabled = environment.get("OTEL_SDK_DISABLED", "").strip().lower() == "true"
    if disabled or environment.get("OTEL_TRACES_EXPORTER", "").strip().lower() == "none":
        return ""
    return environment.get("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT") or environment.get("OTEL_EXPORTER_OTLP_ENDPOINT") or ""


def configure(service: str, node: str, environment: Mapping[str, str]) -> Callable[[], None]:
    """Export spans of this process if the environment names a collector. A failure is logged and does not raise.

    Args:
        service: Name of the service, unless OTEL_SERVICE_NAME sets another one.
        node: Name of the node.
        environment: Environment of the process.

    Returns:
        Function that exports the last spans. It returns after `CLOSE_TIMEOUT_S` at the latest.
    """
    global _tracer  # noqa: PLW0603 - one tracer per process
    if not collector(environment):
        return lambda: None
    try:
        provider, shutdown = _provider(service, node, environment)
    except ImportError as error:
        log.warning(
            "tracing: off, a collector is configured but OpenTelemetry is not installed; install the extra `tracing` (missing=%s)",
            error.name,
        )
        return lambda: None
    except Exception as error:  # a wrong variable must not keep a drone from flying
        log.warning("tracing: off, cannot set up OpenTelemetry; check the OTEL_ variables (error=%s)", error)
        return lambda: None
    _tracer = provider.get_tracer("fractus")
    log.info("tracing: on (collector=%s)", collector(environment))

    def close() -> None:
        thread = threading.Thread(target=shutdown, name="fractus-tracing", daemon=True)
        thread.start()
        thread.join(CLOSE_TIMEOUT_S)

    return close


def _provider(
    service: str, node: str, environment: Mapping[str, str]
) -> tuple[trace.TracerProvider, Callable[[], None]]:
    """Return a provider that exports spans, and its shutdown function."""
    # The extra `tracing` is optional, and importing it takes seconds on a small computer.
    from opentelemetry.sdk.resources import Resource  # noqa: PLC0415, I001
    from opentelemetry.sdk.trace import TracerProvider  # noqa: PLC0415
    from opentelemetry.sdk.trace.export import BatchSpanProcessor  # noqa: PLC0415
    from opentelemetry.exporter.otlp.proto.grpc.trace_exporter import OTLPSpanExporter  # noqa: PLC0415

    protocol = environment.get("OTEL_EXPORTER_OTLP_TRACES_PROTOCOL") or environment.get("OTEL_EXPORTER_OTLP_PROTOCOL")
    if protocol not in {None, "", "grpc"}:
        raise ValueError(f"OTEL_EXPORTER_OTLP_PROTOCOL is {protocol}; use grpc and the collector's port for it")
    attributes = {"fractus.node": node}
    # An attribute from code would override the name in the environment.
    if not environment.get("OTEL_SERVICE_NAME") and "service.name=" not in environment.get(
        "OTEL_RESOURCE_ATTRIBUTES", ""
    ):
        attributes["service.name"] = f"fractus-{service}"
    provider = TracerProvider(resource=Resource.create(attributes), shutdown_on_exit=False)
    provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter()))
    return provider, provider.shutdown


@contextmanager
def server_span(
    method: str, metadata: Iterable[tuple[str, str | bytes]], abort_error: type[BaseException]
) -> Iterator[None]:
    """Open the span of a call and make it the current span.

    Args:
        method: `package.Service/Method`.
        metadata: Request metadata. Only `traceparent` is read, which continues the trace of the caller.
        abort_error: Exception of gRPC for an aborted call, whose status has been set with `set_status`.
    """
    service, _, name = method.partition("/")
    attributes: dict[str, str | int] = {
        "rpc.system": "grpc",
        "rpc.service": service,
        "rpc.method": name,
        STATUS: _OK,
    }
    # The caller's span is the parent if there is exactly one `traceparent`. A malformed value is ignored.
    parents = [value for key, value in metadata if key == "traceparent"]
    parent = Context()
    if len(parents) == 1 and isinstance(parents[0], str):
        parent = TraceContextTextMapPropagator().extract({"traceparent": parents[0]}, parent)
    span = _start_span(method, parent, SpanKind.SERVER, attributes)
    with trace.use_span(span, end_on_exit=True, record_exception=False, set_status_on_exception=False):
        try:
            yield
        except asyncio.CancelledError:
            set_status(span, _CANCELLED)
            raise
        except abort_error:
            raise
        except BaseException:
            set_status(span, _UNKNOWN)
            raise


@contextmanager
def child_span(name: str) -> Iterator[Span]:
    """Open a span below the span of the call. Without a call, for example in the motion monitor, nothing is traced."""
    if not trace.get_current_span().get_span_context().is_valid:
        yield trace.INVALID_SPAN
        return
    span = _start_span(name, None, SpanKind.INTERNAL, {})
    try:
        yield span
    except BaseException as error:
        # The text of an error may contain positions.
        span.set_attribute("error.type", type(error).__name__)
        if not isinstance(error, asyncio.CancelledError):
            span.set_status(StatusCode.ERROR)
        raise
    finally:
        span.end()


def set_verdict(span: Span, action: str, code: str, policies: Sequence[str]) -> None:
    """Add a verdict to a span. Omit the reason of the verdict, because it may contain positions."""
    span.set_attribute("fractus.verdict.action", action)
    if code:
        span.set_attribute("fractus.verdict.code", code)
    if policies:
        span.set_attribute("fractus.verdict.policies", tuple(policies))


def set_status(span: Span, code: int) -> None:
    """Set the gRPC status code of a call. A fault of the server marks the span as an error."""
    span.set_attribute(STATUS, code)
    if code in _SERVER_FAULTS:
        span.set_status(StatusCode.ERROR)


def _start_span(name: str, parent: Context | None, kind: SpanKind, attributes: Mapping[str, str | int]) -> Span:
    """Start a span. A failing sampler or span processor must not make the call fail."""
    try:
        return _tracer.start_span(name, parent, kind, attributes)
    except Exception as error:
        log.warning("tracing: span not started (error=%s)", type(error).__name__)
        return trace.INVALID_SPAN
