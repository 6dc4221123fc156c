"""Number of examples of property-based tests: few by default, all of them if `FRACTUS_DEEP` is set (`make test-all`)."""

import os
from collections.abc import Iterable
from itertools import product
from typing import Any

DEEP = bool(os.environ.get("FRACTUS_DEEP"))


def examples(deep: int, quick: int | None = None) -> int:
    """Return the number of examples of a test: `deep` in a deep run, otherwise `quick` or a quarter of `deep`."""
    return deep if DEEP else quick or max(deep // 4, 10)


def cells(*axes: Iterable[Any], quick: list[Any]) -> list[Any]:
    """Return the parameter combinations of a test: all in a deep run, otherwise `quick`, a subset of them."""
    table = list(product(*axes)) if len(axes) > 1 else list(*axes)
    assert all(cell in table for cell in quick)
    return table if DEEP else quick
