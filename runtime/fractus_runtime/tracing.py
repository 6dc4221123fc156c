"""Traces of calls, where the environment names a collector of them; elsewhere nothing is done, and nothing imported for it."""

from __future__ import annotations

import logging
from collections.abc import Mapping

from fractus_runtime.spans import Tracer

log = logging.getLogger(__name__)


def collector(environment: Mapping[str, str]) -> str:
    """Address of the collector that OpenTelemetry's standard variables name; empty when nothing is to be traced."""
    off = environment.get("OTEL_SDK_DISABLED", "").strip().lower() == "true"
    if off or environment.get("OTEL_TRACES_EXPORTER", "").strip().lower() == "none":
        return ""
    return environment.get("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT") or environment.get("OTEL_EXPORTER_OTLP_ENDPOINT") or ""


def tracer(service: str, node: str, environment: Mapping[str, str]) -> Tracer | None:
    """What traces the calls of a service; None, which the log explains, when that cannot be, or is not wanted.

    Args:
        service: its name, unless OTEL_SERVICE_NAME tells another.
        node: that it runs on.
        environment: of the process.
    """
    if not collector(environment):
        return None
    try:
        from fractus_runtime.span_export import ExportingTracer  # noqa: PLC0415 - megabytes that few need
    except ImportError as error:
        log.warning(
            "tracing: off, a collector is named and OpenTelemetry is not installed; add the extra `tracing` (missing=%s)",
            error.name,
        )
        return None
    try:
        made = ExportingTracer(service, node, environment)
    except Exception as error:  # whatever is wrong with a variable must not keep a drone from flying
        log.warning("tracing: off, OpenTelemetry cannot be set up; check the OTEL_ variables (error=%s)", error)
        return None
    log.info("tracing: on (collector=%s)", collector(environment))
    return made
