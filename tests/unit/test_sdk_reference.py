"""The SDK reference page matches the docstrings."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

from fractus.reference import reference

_CODE = re.compile(r"```python\n.*?\n```", re.DOTALL)
PAGE = Path(__file__).parents[2] / "docs" / "reference" / "sdk.md"


def test_sdk_reference_page_matches_docstrings() -> None:
    assert PAGE.read_text() == reference(), "run `make generate`"


def test_every_public_method_and_field_has_a_docstring() -> None:
    blocks = [block.strip() for block in _CODE.sub("", reference()).split("\n\n") if block.strip()]
    for head, after in itertools.pairwise(blocks):
        if head.startswith(("### ", "#### ")):
            assert not after.startswith("#"), f"{head} has no docstring"
    page = reference()
    for name in (
        "Mobility.goto",
        "Control.remaining",
        "`waypoints_reached`",
        "Watch.status_texts",
        "fractus.MissionEnded",
    ):
        assert name in page
