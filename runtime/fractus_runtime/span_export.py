"""Spans as OpenTelemetry makes and exports them: bounded in number, never waited for, and no reason for a call to fail."""

from __future__ import annotations

import asyncio
import logging
import re
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import TracebackType

from opentelemetry import trace
from opentelemetry.context import Context
from opentelemetry.exporter.otlp.proto.grpc.trace_exporter import OTLPSpanExporter
from opentelemetry.sdk.resources import Resource
from opentelemetry.sdk.trace import SpanLimits, TracerProvider
from opentelemetry.sdk.trace.export import BatchSpanProcessor
from opentelemetry.trace import SpanContext, SpanKind, StatusCode, TraceFlags

from fractus_runtime.spans import STATUS, Attribute, Serving, Span

log = logging.getLogger(__name__)

MAX_CALLS_PER_S = 100
"""Calls that are traced in a second, refused ones included: a flood of them must not cost more by being traced."""
MAX_PARTS = 64
"""Parts of a call that have a span: a stream is judged again and again for as long as it lives."""
MAX_PARENTS = 4096
"""Spans of callers that are remembered, so that none is the parent of two calls."""
MAX_LENGTH = 512
"""Characters of an attribute."""
SAY_AGAIN_S = 60.0
"""Between two lines of the log about what OpenTelemetry says."""
CLOSE_TIMEOUT_S = 1.0
"""How long the end of the program waits for the export of what is left."""

_FAULTS = frozenset({2, 4, 12, 13, 14, 15})
"""Status codes of gRPC that are a fault of who serves; the other ones are answers."""
_CANCELLED, _UNKNOWN = 1, 2
_TRACEPARENT = re.compile(r"00-([0-9a-f]{32})-([0-9a-f]{16})-([0-9a-f]{2})")


class ExportingTracer:
    """See `spans.Tracer`; the standard variables of OpenTelemetry say where to, and which traces.

    Args:
        service: its name, unless the environment tells another.
        node: that it runs on.
        environment: of the process.

    Raises:
        ValueError: a variable is none that OpenTelemetry, or this exporter, takes.
    """

    def __init__(self, service: str, node: str, environment: Mapping[str, str]) -> None:
        protocol = environment.get("OTEL_EXPORTER_OTLP_TRACES_PROTOCOL") or environment.get(
            "OTEL_EXPORTER_OTLP_PROTOCOL"
        )
        if protocol not in {None, "", "grpc"}:
            raise ValueError(f"OTEL_EXPORTER_OTLP_PROTOCOL is {protocol}: name the collector's port for grpc")
        told = {"fractus.node": node, "service.name": f"fractus-{service}"}
        if environment.get("OTEL_SERVICE_NAME") or "service.name=" in environment.get("OTEL_RESOURCE_ATTRIBUTES", ""):
            del told["service.name"]  # ours would override it
        logger = logging.getLogger("opentelemetry")
        logger.propagate, logger.handlers = False, [_Rarely()]
        provider = TracerProvider(
            resource=Resource.create(told),
            shutdown_on_exit=False,
            span_limits=SpanLimits(max_span_attribute_length=MAX_LENGTH, max_span_attributes=32),
        )
        provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter()))
        self._tracer = provider.get_tracer("fractus")
        self.close = closer(provider.shutdown)
        self._parents: OrderedDict[tuple[int, int], None] = OrderedDict()
        self._second, self._calls = 0, 0

    def serve(self, method: str, headers: Iterable[tuple[str, str | bytes]]) -> Serving:
        """See `spans.Tracer`."""
        second = int(time.monotonic())
        self._calls = self._calls + 1 if second == self._second else 1
        self._second = second
        if self._calls > MAX_CALLS_PER_S:
            return Serving(Span())
        try:
            return Serving(self._begin(method, headers))
        except Exception as error:  # a flight goes on, whatever is wrong in what traces it
            log.warning("tracing: a call is not traced (error=%s)", type(error).__name__)
            return Serving(Span())

    def _begin(self, method: str, headers: Iterable[tuple[str, str | bytes]]) -> Span:
        service, _, name = method.partition("/")
        parent, context = self._parent(headers), Context()
        if parent is not None:
            context = trace.set_span_in_context(trace.NonRecordingSpan(parent), context)
        span = self._tracer.start_span(
            method,
            context,
            SpanKind.SERVER,
            {"rpc.system": "grpc", "rpc.service": service, "rpc.method": name},
        )
        return _Served(span, self._tracer) if span.is_recording() else Span()

    def _parent(self, headers: Iterable[tuple[str, str | bytes]]) -> SpanContext | None:
        """The caller's span; None unless it is told once, well-formed and for the first time. The rest of what it tells is not read."""
        told = [value for name, value in headers if name == "traceparent"]
        found = _TRACEPARENT.fullmatch(told[0]) if len(told) == 1 and isinstance(told[0], str) else None
        if found is None:
            return None
        number, span, flags = (int(part, 16) for part in found.groups())
        parent = SpanContext(number, span, is_remote=True, trace_flags=TraceFlags(flags & TraceFlags.SAMPLED))
        if not parent.is_valid or (number, span) in self._parents:
            return None
        self._parents[number, span] = None
        if len(self._parents) > MAX_PARENTS:
            self._parents.popitem(last=False)
        return parent


class _Recorded(Span):
    """A span that is exported when it ends."""

    __slots__ = ("_span",)

    def __init__(self, span: trace.Span) -> None:
        self._span = span

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            # Its text may tell positions.
            self._span.set_attribute("error.type", kind.__name__)
            if kind is not asyncio.CancelledError:
                self._span.set_status(StatusCode.ERROR)
        self._span.end()

    def note(self, name: str, value: Attribute) -> None:
        self._span.set_attribute(name, value)

    def verdict(self, action: str, code: str, policies: Sequence[str]) -> None:
        self._span.set_attribute("fractus.verdict.action", action)
        if code:
            self._span.set_attribute("fractus.verdict.code", code)
        if policies:
            self._span.set_attribute("fractus.verdict.policies", tuple(policies))


class _Served(_Recorded):
    """The span of a call that is served.

    Args:
        span: as OpenTelemetry has it.
        tracer: makes those of its parts.
    """

    __slots__ = ("_context", "_left", "_status", "_tracer")

    def __init__(self, span: trace.Span, tracer: trace.Tracer) -> None:
        super().__init__(span)
        self._tracer = tracer
        self._context = trace.set_span_in_context(span, Context())
        self._left = MAX_PARTS
        self._status = 0

    def child(self, name: str) -> Span:
        self._left -= 1
        if self._left < 0:
            return Span()
        try:
            return _Recorded(self._tracer.start_span(name, self._context))
        except Exception as error:
            log.warning("tracing: a part of a call is not traced (error=%s)", type(error).__name__)
            return Span()

    def note(self, name: str, value: Attribute) -> None:
        if name == STATUS and isinstance(value, int):
            self._status = value
        super().note(name, value)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None and not self._status:
            self._status = _CANCELLED if kind is asyncio.CancelledError else _UNKNOWN
        self._span.set_attribute(STATUS, self._status)
        if self._status in _FAULTS:
            self._span.set_status(StatusCode.ERROR)
        if self._left < 0:
            self._span.set_attribute("fractus.parts_left_out", -self._left)
        self._span.end()


class _Rarely(logging.Handler):
    """Writes what OpenTelemetry says to our log, a line a minute: a collector may be out of reach for long."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._next_s = 0.0

    def emit(self, record: logging.LogRecord) -> None:
        if time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + SAY_AGAIN_S
            log.warning("tracing: %s", record.getMessage())


def closer(shutdown: Callable[[], None]) -> Callable[[], None]:
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
