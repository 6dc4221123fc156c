"""Fuzz zones in external formats: each file is refused with a reason, or can be written and read again."""

from __future__ import annotations

import json
import logging
import sys
from pathlib import Path

import atheris

with atheris.instrument_imports(
    include=["fractus_core.geo.formats", "fractus_core.api.geometry", "fractus_core.validation"]
):
    from fractus_core.api import InvalidObject, Zone
    from fractus_core.documents import dump_documents, parse_documents
    from fractus_core.geo import formats
    from fractus_core.validation import check_zone

READERS = [formats.read_geojson, formats.read_kml, formats.read_qgc_plan, formats.read_ed269, formats.read_ed318]
WRITERS = [formats.write_geojson, formats.write_kml, formats.write_qgc_plan, formats.write_ed269]
EXAMPLE = Path(__file__).parents[2] / "examples" / "traffic-monitoring" / "zones.yaml"
ZONES = [Zone.from_body(body) for body in parse_documents(EXAMPLE.read_bytes(), EXAMPLE.name).values]
HELD = {
    "apiVersion": "fractus.dev/v1alpha1", "kind": "Zone", "metadata": {"name": "held"},
    "spec": {
        "area": {"circle": {"center": {"lat": 39.36, "lon": 22.95}, "radius": 50.0}}, "altitude": {"lower": 10.0, "upper": 60.0, "reference": "amsl"},
        "schedule": [{"days": ["Mon"], "start": "08:00", "end": "17:00"}],
    },
}  # fmt: skip
ED318 = Path(__file__).parents[1] / "imported" / "ed318.json"
TEXTS = [*(write([*ZONES, Zone.from_body(HELD)]).text for write in WRITERS), ED318.read_text()]
"""The example's zones in each format that is written, and a file of the format that is only read."""

SPLICES = [
    "", "0", "-", "1e999", "NaN", "null", "true", "[]", "{}", '""', "180", "-180", "90", "9" * 20, "<", "&amp;", "&x;",
    "2026-01-01T00:00:00Z", "FOREVER", "AGL", "AMSL", "FT", "M", "H24", "<when>", "\u00e9", "\U0001f600", "\0", "1000000",
]  # fmt: skip
logging.disable(logging.CRITICAL)


def text_of(data_provider: atheris.FuzzedDataProvider, format_index: int) -> str:
    """Return an example with some characters changed, or arbitrary text."""
    if not data_provider.ConsumeIntInRange(0, 7):
        return data_provider.ConsumeUnicodeNoSurrogates(data_provider.remaining_bytes())
    text = TEXTS[format_index]
    for _ in range(data_provider.ConsumeIntInRange(0, 6)):
        begin = data_provider.ConsumeIntInRange(0, max(len(text) - 1, 0))
        end = begin + data_provider.ConsumeIntInRange(0, 12)
        inserted = (
            data_provider.PickValueInList(SPLICES)
            if data_provider.ConsumeBool()
            else data_provider.ConsumeUnicodeNoSurrogates(6)
        )
        if not data_provider.ConsumeIntInRange(0, 3):
            inserted = text[begin : begin + data_provider.ConsumeIntInRange(0, 200)] + inserted
            end = begin
        text = text[:begin] + inserted + text[end:]
    return text


def fuzz_one(data: bytes) -> None:
    """Read one file, and write and read its zones again."""
    data_provider = atheris.FuzzedDataProvider(data)
    format_index = data_provider.ConsumeIntInRange(0, len(READERS) - 1)
    try:
        imported = READERS[format_index](text_of(data_provider, format_index))
        for zone in imported.zones:
            check_zone(zone)
    except InvalidObject as error:
        assert str(error)
        return
    for zone in imported.zones:
        body = zone.to_dict()
        body["spec"] = {key: part for key, part in body["spec"].items() if part not in ("", [])}
        (read,) = parse_documents(dump_documents([body]).encode(), "zone").values
        assert Zone.from_body(read).spec == zone.spec, zone
        json.dumps(read)
    for write in WRITERS:
        try:
            exported = write(imported.zones)
        except InvalidObject as error:
            assert str(error)
            continue
        exported.text.encode()


if __name__ == "__main__":
    atheris.Setup(sys.argv, fuzz_one)
    atheris.Fuzz()
