"""OpenTelemetry collector for tests, over gRPC."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import grpc
from fractus_cluster.ports import free_port
from opentelemetry.proto.collector.trace.v1 import trace_service_pb2, trace_service_pb2_grpc
from opentelemetry.proto.trace.v1.trace_pb2 import Span

NO_PARENT = b""


@dataclass(frozen=True)
class Seen:
    """An exported span."""

    service: str
    node: str
    span: Any

    @property
    def name(self) -> str:
        return str(self.span.name)

    @property
    def told(self) -> dict[str, Any]:
        """Attributes of the span."""
        return {one.key: value_of(one.value) for one in self.span.attributes}


def value_of(value: Any) -> Any:
    kind = value.WhichOneof("value")
    if kind == "array_value":
        return [value_of(one) for one in value.array_value.values]
    return getattr(value, kind)


@dataclass
class Collector(trace_service_pb2_grpc.TraceServiceServicer):
    """Stores received spans."""

    address: str = field(default_factory=lambda: f"127.0.0.1:{free_port()}")
    spans: list[Seen] = field(default_factory=list)
    arrived: threading.Condition = field(default_factory=threading.Condition)

    @property
    def environment(self) -> dict[str, str]:
        """Environment of a program that exports its spans to this collector without delay."""
        return {"OTEL_EXPORTER_OTLP_ENDPOINT": f"http://{self.address}", "OTEL_BSP_SCHEDULE_DELAY": "50"}

    def Export(self, request: Any, context: Any) -> Any:  # noqa: N802
        del context
        with self.arrived:
            for one in request.resource_spans:
                told = {attribute.key: value_of(attribute.value) for attribute in one.resource.attributes}
                for scope in one.scope_spans:
                    self.spans += [Seen(told["service.name"], told.get("fractus.node", ""), s) for s in scope.spans]
            self.arrived.notify_all()
        return trace_service_pb2.ExportTraceServiceResponse()

    def wait(self, condition: Callable[[list[Seen]], Any], timeout_s: float = 60.0) -> Any:
        """Wait until a function of the spans returns a true value, and return that value."""
        deadline = time.monotonic() + timeout_s
        with self.arrived:
            while not (found := condition(self.spans)):
                left_s = deadline - time.monotonic()
                assert left_s > 0, sorted({f"{one.service}: {one.name}" for one in self.spans})
                self.arrived.wait(left_s)
            return found

    def one(self, name: str, kind: int = Span.SPAN_KIND_SERVER, **told: Any) -> Seen:
        """Wait for a span with this name, kind and attributes, and return the first. `a__b` stands for the attribute a.b."""
        wanted = {key.replace("__", "."): value for key, value in told.items()}

        def matching(spans: list[Seen]) -> list[Seen]:
            return [
                s for s in spans if s.name == name and s.span.kind == kind and wanted.items() <= _flat(s.told).items()
            ]

        return matching(self.wait(lambda spans: matching(spans) and spans))[0]


def _flat(told: dict[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in told.items()}


@contextmanager
def collecting() -> Iterator[Collector]:
    """Run a collector."""
    collector = Collector()
    server = grpc.server(ThreadPoolExecutor(2))
    trace_service_pb2_grpc.add_TraceServiceServicer_to_server(collector, server)
    server.add_insecure_port(collector.address)
    server.start()
    try:
        yield collector
    finally:
        server.stop(None).wait(10)
