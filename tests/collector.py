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
class ReceivedSpan:
    """An exported span, with attributes of its process."""

    service: str
    node: str
    span: Any

    @property
    def name(self) -> str:
        return str(self.span.name)

    @property
    def attributes(self) -> dict[str, Any]:
        return {attribute.key: value_of(attribute.value) for attribute in self.span.attributes}


def value_of(value: Any) -> Any:
    kind = value.WhichOneof("value")
    if kind == "array_value":
        return [value_of(item) for item in value.array_value.values]
    return getattr(value, kind)


@dataclass
class Collector(trace_service_pb2_grpc.TraceServiceServicer):
    """Stores received spans."""

    address: str = field(default_factory=lambda: f"127.0.0.1:{free_port()}")
    spans: list[ReceivedSpan] = field(default_factory=list)
    arrived: threading.Condition = field(default_factory=threading.Condition)

    @property
    def environment(self) -> dict[str, str]:
        """Environment of a program that exports its spans to this collector without delay."""
        return {"OTEL_EXPORTER_OTLP_ENDPOINT": f"http://{self.address}", "OTEL_BSP_SCHEDULE_DELAY": "50"}

    def Export(self, request: Any, context: Any) -> Any:  # noqa: N802
        del context
        with self.arrived:
            for group in request.resource_spans:
                process = {attribute.key: value_of(attribute.value) for attribute in group.resource.attributes}
                service = process["service.name"]
                node = process.get("fractus.node", "")
                for scope in group.scope_spans:
                    self.spans += [ReceivedSpan(service, node, span) for span in scope.spans]
            self.arrived.notify_all()
        return trace_service_pb2.ExportTraceServiceResponse()

    def wait(self, condition: Callable[[list[ReceivedSpan]], Any], timeout_s: float = 60.0) -> Any:
        """Wait until a function of the spans returns a true value, and return that value."""
        deadline = time.monotonic() + timeout_s
        with self.arrived:
            while not (result := condition(self.spans)):
                remaining_s = deadline - time.monotonic()
                assert remaining_s > 0, sorted({f"{span.service}: {span.name}" for span in self.spans})
                self.arrived.wait(remaining_s)
            return result

    def find(self, name: str, kind: int = Span.SPAN_KIND_SERVER, **attributes: Any) -> ReceivedSpan:
        """Wait for a span with this name, kind and attributes, and return the first one. Write the attribute a.b as `a__b`."""
        expected = {key.replace("__", "."): value for key, value in attributes.items()}

        def matches(span: ReceivedSpan) -> bool:
            return (
                span.name == name and span.span.kind == kind and expected.items() <= _hashable(span.attributes).items()
            )

        def matching(spans: list[ReceivedSpan]) -> list[ReceivedSpan]:
            return [span for span in spans if matches(span)]

        spans: list[ReceivedSpan] = self.wait(matching)
        return spans[0]


def _hashable(attributes: dict[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in attributes.items()}


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
