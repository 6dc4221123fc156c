"""Exception of experiments."""

from __future__ import annotations


class ExperimentError(Exception):
    """The experiment cannot be set up or completed. The message says what to do."""
