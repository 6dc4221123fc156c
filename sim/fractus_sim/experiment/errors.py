"""What goes wrong with experiments before or beside their checks."""

from __future__ import annotations


class ExperimentError(Exception):
    """The experiment cannot be run, or not to its end; the text says what to do."""
