"""Settings of all tests."""

import gc
from collections.abc import Generator

import pytest
from depth import DEEP
from hypothesis import HealthCheck, settings

# The speed of examples depends on the other load of the machine.
ANY_SPEED = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow]}
settings.register_profile("quick", max_examples=50, **ANY_SPEED)
settings.register_profile("deep", max_examples=200, **ANY_SPEED)
settings.load_profile("deep" if DEEP else "quick")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Do not search the modules and tests for garbage, neither while they are collected nor later."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()
