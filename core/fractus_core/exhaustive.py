"""Tables over closed sets: a member that is added to the set and not to the table fails at import, not in flight."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, TypeVar, get_args

C = TypeVar("C", bound=Collection[Any])


def exhaustive(members: Any, table: C) -> C:
    """The table, which has one entry for each member of a closed set and no other.

    Where each member needs code of its own, `match` with `assert_never` says the same to mypy.

    Args:
        members: a `Literal`.
        table: its members, or a mapping from them.

    Raises:
        TypeError: a member is missing, or something is not a member.
    """
    wrong = set(get_args(members)) ^ set(table)
    if wrong or len(get_args(members)) != len(table):
        raise TypeError(f"the table does not match its closed set in {sorted(map(str, wrong))}")
    return table
