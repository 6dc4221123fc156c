"""Tables over closed sets. A member that is missing in a table causes an error at import, not in flight."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, TypeVar, get_args

C = TypeVar("C", bound=Collection[Any])


def exhaustive(members: Any, table: C) -> C:
    """Return a table after checking that it has exactly one entry for each member of a closed set.

    If each member needs its own code, use `match` with `assert_never` instead, which mypy checks.

    Args:
        members: A `Literal` type.
        table: A collection of its members, or a mapping with them as keys.

    Raises:
        TypeError: A member is missing, or an entry is not a member.
    """
    wrong = set(get_args(members)) ^ set(table)
    if wrong or len(get_args(members)) != len(table):
        raise TypeError(f"the table does not match its closed set in {sorted(map(str, wrong))}")
    return table
