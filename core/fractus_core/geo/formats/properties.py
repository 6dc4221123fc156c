"""Properties of others: which of them seem to say how high or when a zone counts."""

from __future__ import annotations

import re

_WORD = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])")
_SAYING = re.compile(
    r"""(
    alt | altitudes? | heights? | elevation | levels? | floor | ceiling | lower | upper | bottom | top | base | vertical |
    agl | [am]msl | asl | msl | fl | feet | ft |
    times? | timespan | dates? | datetime | starts? | begins? | ends? | from | until | valid | validity | active |
    activation | applicability | periods? | hours? | days? | weekdays? | months? | season | expires | expiry | expiration |
    effective | permanent | temporary | when | duration | schedules?
    )""",
    re.VERBOSE,
)


def says_height_or_time(name: str) -> bool:
    """Whether the name of a property has a word of heights or times: `upperLimit`, `VALID_FROM`, `height (AGL)`."""
    return any(_SAYING.fullmatch(word.lower()) for word in _WORD.findall(name))
