"""Settings of all tests."""

from depth import DEEP
from hypothesis import HealthCheck, settings

# The speed of examples depends on the other load of the machine.
ANY_SPEED = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow]}
settings.register_profile("quick", max_examples=50, **ANY_SPEED)
settings.register_profile("deep", max_examples=200, **ANY_SPEED)
settings.load_profile("deep" if DEEP else "quick")
