"""Plug-ins for the ranking of drones and the coverage of areas: entry points of installed packages."""

from __future__ import annotations

import importlib.metadata
from typing import Any

GROUP = "fractus.planning"


class UnknownPlugin(Exception):
    """A plug-in does not exist, or is not a function."""


def load_plugin(name: str | None) -> Any:
    """Load a plug-in by name. Return None for an empty name.

    Raises:
        UnknownPlugin: The plug-in does not exist, or is not a function.
    """
    if not name:
        return None
    entries = {entry.name: entry for entry in importlib.metadata.entry_points(group=GROUP)}
    if name not in entries:
        names = ", ".join(sorted(entries)) or "none"
        raise UnknownPlugin(f"plug-in {name} is not installed (installed: {names})")
    plugin = entries[name].load()
    if not callable(plugin):
        raise UnknownPlugin(f"{entries[name].value} is not a function")
    return plugin
