"""Plug-ins that replace how drones are ranked and how areas are covered: entry points of installed packages."""

from __future__ import annotations

import importlib.metadata
from typing import Any

GROUP = "fractus.planning"


class UnknownPlugin(Exception):
    """There is no plug-in of a name, or it is not a function."""


def load_plugin(name: str | None) -> Any:
    """The plug-in of a name; None when none is asked for.

    Raises:
        UnknownPlugin: there is none, or it is not a function.
    """
    if not name:
        return None
    known = {entry.name: entry for entry in importlib.metadata.entry_points(group=GROUP)}
    if name not in known:
        names = ", ".join(sorted(known)) or "none is installed"
        raise UnknownPlugin(f"there is no plug-in {name} ({names})")
    found = known[name].load()
    if not callable(found):
        raise UnknownPlugin(f"{known[name].value} is not a function")
    return found
