"""Metrics in Prometheus' text format, and the table of metrics in docs/metrics.md."""

from __future__ import annotations

import math
import re

import pytest
from fractus_runtime.metrics import gauge, hash_number, metrics_text
from prometheus_client import Counter
from scraping import DOCS, documented, values

NON_METRIC_NAMES = {"fractus_agent", "fractus_call", "fractus_operator", "fractus_view"}
"""Names in the code that begin with fractus_ but are not metrics: loggers, a context variable and a package."""


def test_metrics_page_lists_exactly_the_metrics_of_the_code() -> None:
    folders = ("runtime", "operator", "agent", "services", "view", "management", "core")
    code = "".join(file.read_text() for folder in folders for file in (DOCS.parent / folder).rglob("*.py"))
    assert set(re.findall(r'"(fractus_[a-z_]+)"', code)) - NON_METRIC_NAMES == documented().keys()


@pytest.mark.parametrize("value", [0.0, -1.5, 1e-9, 1_780_000_000.25, math.inf, -math.inf, True])
def test_gauge_keeps_its_value(value: float) -> None:
    assert values(metrics_text([gauge("a", "A gauge.", value)]).decode()) == {("a",): value}


def test_gauge_of_an_unknown_value_is_nan() -> None:
    assert math.isnan(values(metrics_text([gauge("a", "A gauge.", math.nan)]).decode())["a",])


def test_gauge_has_one_sample_per_label_value() -> None:
    text = metrics_text([gauge("a", "A gauge.", {'a "quoted" word': 1.0, "a\nb": 2.0}, "kind")]).decode()
    assert values(text) == {("a", 'a "quoted" word'): 1.0, ("a", "a\nb"): 2.0}


def test_gauge_without_samples_keeps_its_description() -> None:
    assert metrics_text([gauge("a", "No sample yet.", {}, "kind")]) == b"# HELP a No sample yet.\n# TYPE a gauge\n"


def test_counter_has_no_series_of_creation_times() -> None:
    counter = Counter("calls_total", "Calls.", ["action"], registry=None)
    counter.labels("deny").inc()
    text = metrics_text(counter.collect()).decode()
    assert "# TYPE calls_total counter" in text
    assert values(text) == {("calls_total", "deny"): 1.0}


def test_hash_number_is_stored_exactly_in_a_metric() -> None:
    number = hash_number("fedcba9876543210" * 4)
    assert f"{int(values(metrics_text([gauge('a', 'A hash.', number)]).decode())['a',]):013x}" == "fedcba9876543"
