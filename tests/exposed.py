"""Asks for metrics as Prometheus does, and reads what docs/metrics.md says of them."""

from __future__ import annotations

import asyncio
import re
import urllib.request
from pathlib import Path

from prometheus_client import Metric
from prometheus_client.parser import text_string_to_metric_families

DOCS = Path(__file__).parents[1] / "docs"


async def get(port: int, path: str = "/metrics") -> tuple[str, str]:
    """The first line and the body of an answer."""
    async with asyncio.timeout(60.0):
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(f"GET {path} HTTP/1.1\r\nHost: x\r\n\r\n".encode())
        head, _, body = (await reader.read()).decode().partition("\r\n\r\n")
    writer.close()
    return head.splitlines()[0], body


def scraped(port: int) -> dict[tuple[str, ...], float]:
    """Every sample that a workload tells now, see `values`; none while it does not answer."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=20) as answer:
            return values(answer.read().decode())
    except OSError:
        return {}


def values(text: str) -> dict[tuple[str, ...], float]:
    """Every sample by its name and its labels' values, in the order of the labels' names."""
    families = text_string_to_metric_families(text)
    return {(s.name, *(v for _, v in sorted(s.labels.items()))): s.value for f in families for s in f.samples}


def documented(*sections: str) -> dict[str, tuple[str, set[str], str]]:
    """Type, labels and what it tells by name, of the metrics in some sections of the page; of all when none is named."""
    parts = (DOCS / "metrics.md").read_text().split("\n## ")[1:]
    chosen = [part for part in parts if not sections or part.splitlines()[0] in sections]
    assert len(chosen) == len(sections or parts)
    return {
        name: (kind, set(re.findall(r"`(\w+)`", labels)), tells.replace("`", ""))
        for part in chosen
        for name, kind, labels, tells in re.findall(r"^\| `(\w+)` \| (\w+) \| (.*?) ?\| (.*) \|$", part, re.MULTILINE)
    }


def assert_documented(text: str, *sections: str) -> None:
    """Metrics are those of the sections, with types, labels and help; a counter that never counted may miss its labels."""
    told = {name(f): f for f in text_string_to_metric_families(text)}
    rows = documented(*sections)
    assert {key: family.type for key, family in told.items()} == {key: kind for key, (kind, _, _) in rows.items()}
    for key, family in told.items():
        assert family.documentation == f"{rows[key][2][0].upper()}{rows[key][2][1:]}.", key
        for sample in family.samples:
            assert sample.labels.keys() - {"le"} == rows[key][1], key


def name(family: Metric) -> str:
    """The name of a metric as Prometheus stores it."""
    return str(family.name) + ("_total" if family.type == "counter" else "")
