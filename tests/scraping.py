"""Scrapes metrics like Prometheus, and compares them with the tables of docs/metrics.md."""

from __future__ import annotations

import asyncio
import re
import urllib.request
from pathlib import Path

from prometheus_client import Metric
from prometheus_client.parser import text_string_to_metric_families

DOCS = Path(__file__).parents[1] / "docs"


async def get(port: int, path: str = "/metrics") -> tuple[str, str]:
    """Return the status line and the body of a response."""
    async with asyncio.timeout(60.0):
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(f"GET {path} HTTP/1.1\r\nHost: x\r\n\r\n".encode())
        head, _, body = (await reader.read()).decode().partition("\r\n\r\n")
    writer.close()
    return head.splitlines()[0], body


def scraped(port: int) -> dict[tuple[str, ...], float]:
    """Return the samples of a workload in the form of `values`, or an empty dict if it does not answer."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=20) as response:
            return values(response.read().decode())
    except OSError:
        return {}


def values(text: str) -> dict[tuple[str, ...], float]:
    """Return the value of each sample by its name followed by its label values, in the order of the label names."""
    families = text_string_to_metric_families(text)
    return {(s.name, *(v for _, v in sorted(s.labels.items()))): s.value for f in families for s in f.samples}


def documented(*sections: str) -> dict[str, tuple[str, set[str], str]]:
    """Return type, labels and description by name of the metrics in sections of docs/metrics.md. No section selects all."""
    parts = (DOCS / "metrics.md").read_text().split("\n## ")[1:]
    chosen = [part for part in parts if not sections or part.splitlines()[0] in sections]
    assert len(chosen) == len(sections or parts)
    return {
        name: (kind, set(re.findall(r"`(\w+)`", labels)), description.replace("`", ""))
        for part in chosen
        for name, kind, labels, description in re.findall(
            r"^\| `(\w+)` \| (\w+) \| (.*?) ?\| (.*) \|$", part, re.MULTILINE
        )
    }


def assert_documented(text: str, *sections: str) -> None:
    """Assert that metrics equal the sections in names, types, labels and descriptions.

    Labels of a metric without samples are not compared.
    """
    families = {name(family): family for family in text_string_to_metric_families(text)}
    rows = documented(*sections)
    assert {key: family.type for key, family in families.items()} == {key: kind for key, (kind, _, _) in rows.items()}
    for key, family in families.items():
        _, labels, description = rows[key]
        assert family.documentation == f"{description[0].upper()}{description[1:]}.", key
        for sample in family.samples:
            assert sample.labels.keys() - {"le"} == labels, key


def name(family: Metric) -> str:
    """Return the name of a metric as Prometheus stores it."""
    return str(family.name) + ("_total" if family.type == "counter" else "")
