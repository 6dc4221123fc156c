"""Counts of taken and refused pictures, from the camera service to the agent."""

from __future__ import annotations

from pathlib import Path

import pytest
from fractus_agent.registration.diagnostics import read_picture_counts
from fractus_services.camera.picture_counts import PictureCounts


def test_counts_continue_after_restart_and_end_with_the_grant(tmp_path: Path) -> None:
    file = tmp_path / "camera" / "picture-counts.json"
    file.parent.mkdir()
    active = ["a"]
    counts = PictureCounts(file, lambda: active)
    counts.count("a", refused=False)
    counts.count("a", refused=True)
    assert read_picture_counts(tmp_path) == {"a": (1, 1)}
    counts = PictureCounts(file, lambda: active)
    counts.count("a", refused=False)
    assert read_picture_counts(tmp_path) == {"a": (2, 1)}
    active[:] = ["b"]
    counts.count("b", refused=False)
    assert read_picture_counts(tmp_path) == {"b": (1, 0)}


@pytest.mark.parametrize("content", ["", "[]", "5", '{"a": 5}', '{"a": [1]}', '{"a": ["x", 1]}', "{" * 10_000])
def test_invalid_counts_are_ignored(content: str, tmp_path: Path) -> None:
    file = tmp_path / "camera" / "picture-counts.json"
    file.parent.mkdir()
    file.write_text(content)
    assert read_picture_counts(tmp_path) == {}
    PictureCounts(file, tuple).count("a", refused=True)
    assert read_picture_counts(tmp_path) == {"a": (0, 1)}


def test_counts_that_cannot_be_written_do_not_affect_the_picture(tmp_path: Path) -> None:
    PictureCounts(tmp_path / "missing" / "picture-counts.json", tuple).count("a", refused=False)
