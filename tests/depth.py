"""How many examples property-based tests try: few by default, all of them where `FRACTUS_DEEP` is set (`make test-deep`)."""

import os

DEEP = bool(os.environ.get("FRACTUS_DEEP"))


def examples(deep: int, quick: int | None = None) -> int:
    """The number of examples of a test: `deep` in a deep run; else `quick`, or a quarter of `deep`."""
    return deep if DEEP else quick or max(deep // 4, 10)
