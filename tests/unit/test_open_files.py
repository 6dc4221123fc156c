"""Limit of open files of a server."""

from __future__ import annotations

import resource

import pytest
from fractus_runtime.open_files import REQUIRED, TooFewOpenFiles, raise_open_files


@pytest.fixture
def limits(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Soft and hard limit of the process."""
    values = [256, 4_096]

    def change(_kind: int, changed: tuple[int, int]) -> None:
        if changed[0] > values[1] != resource.RLIM_INFINITY:
            raise ValueError("not allowed to exceed maximum limit")
        values[:] = changed

    monkeypatch.setattr(resource, "getrlimit", lambda _kind: tuple(values))
    monkeypatch.setattr(resource, "setrlimit", change)
    return values


def test_open_files_are_raised_to_the_hard_limit(limits: list[int]) -> None:
    assert raise_open_files() == 4_096
    assert limits == [4_096, 4_096]


def test_open_files_are_raised_without_a_hard_limit(limits: list[int]) -> None:
    limits[1] = resource.RLIM_INFINITY
    assert raise_open_files() == 65_536


def test_open_files_are_not_lowered(limits: list[int]) -> None:
    limits[:] = [1_000_000, 1_000_000]
    assert raise_open_files() == 1_000_000
    limits[:] = [resource.RLIM_INFINITY, resource.RLIM_INFINITY]
    assert raise_open_files() >= REQUIRED
    assert limits == [resource.RLIM_INFINITY, resource.RLIM_INFINITY]


def test_too_few_open_files_are_refused_with_the_remedy(limits: list[int]) -> None:
    limits[:] = [256, 256]
    with pytest.raises(TooFewOpenFiles, match=r"limit of open files is 256; raise it to at least 1024 .*LimitNOFILE"):
        raise_open_files()
