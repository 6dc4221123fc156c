"""What Prometheus reads is what was meant: by the parser of its own library."""

from __future__ import annotations

import math
import re

import pytest
from exposed import DOCS, documented, values
from fractus_runtime.figures import Counter, Figure, Histogram, gauge, text_of
from prometheus_client.parser import text_string_to_metric_families

OTHER_NAMES = {"fractus_agent", "fractus_call", "fractus_operator"}
"""Of loggers and of a context's variable."""


def test_the_page_has_every_metric_that_the_code_names_and_no_other() -> None:
    rooms = ("observe", "operator", "agent", "services", "view", "kube", "storage", "core")
    code = "".join(file.read_text() for room in rooms for file in (DOCS.parent / room).rglob("*.py"))
    assert set(re.findall(r'"(fractus_[a-z_]+)"', code)) - OTHER_NAMES == documented().keys()


@pytest.mark.parametrize("value", [0.0, -1.5, 1e-9, 1e300, 1_780_000_000.25, math.inf, -math.inf, True])
def test_numbers_are_read_as_they_are(value: float) -> None:
    assert values(text_of([gauge("a", "A figure.", value)]).decode()) == {("a",): value}


def test_what_is_unknown_is_no_number() -> None:
    assert math.isnan(values(text_of([gauge("a", "A figure.", math.nan)]).decode())["a",])


@pytest.mark.parametrize("said", ['a "quoted" word', "a\\nb", "a\nb", "\\", '{a="b"}', "Flüge"])
def test_what_labels_and_descriptions_say_is_read_as_it_is(said: str) -> None:
    (family,) = text_string_to_metric_families(text_of([gauge("a", f"Of {said}", {said: 1.0}, "of")]).decode())
    assert family.documentation == f"Of {said}"
    assert [sample.labels for sample in family.samples] == [{"of": said}]


def test_a_counter_counts_by_its_labels() -> None:
    counter = Counter("calls_total", "Calls.", "action", "code")
    for labels in (("allow", "A"), ("deny", "B"), ("deny", "B")):
        counter.count(*labels)
    told = text_of([counter.figure()]).decode()
    assert "# TYPE calls_total counter" in told
    assert values(told) == {("calls_total", "allow", "A"): 1.0, ("calls_total", "deny", "B"): 2.0}
    assert counter.counted("deny", "B") == 2.0
    assert counter.counted("deny", "A") == 0.0


def test_a_histogram_counts_what_is_not_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    histogram = Histogram("step_seconds", "Steps.", "kind", (0.5, 2.0))
    clock = iter((0.0, 0.5, 0.0, 1.0, 0.0, 9.0))
    monkeypatch.setattr("time.perf_counter", lambda: next(clock))
    for _ in range(2):
        with histogram.timed("a"):
            pass
    with pytest.raises(KeyError), histogram.timed("a"):
        raise KeyError
    assert values(text_of([histogram.figure()]).decode()) == {
        ("step_seconds_bucket", "a", "0.5"): 1.0,
        ("step_seconds_bucket", "a", "2.0"): 2.0,
        ("step_seconds_bucket", "a", "+Inf"): 3.0,
        ("step_seconds_count", "a"): 3.0,
        ("step_seconds_sum", "a"): 10.5,
    }


def test_a_figure_without_values_is_told_of() -> None:
    assert text_of([Figure("a", "None yet.", "gauge", [])]) == b"# HELP a None yet.\n# TYPE a gauge\n"
