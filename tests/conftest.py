"""What all rings of tests share."""

from depth import DEEP
from hypothesis import HealthCheck, settings

# How fast a machine makes examples or carries them out says nothing of the code: it may be busy with other work.
ANY_SPEED = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow]}
settings.register_profile("quick", max_examples=50, **ANY_SPEED)
settings.register_profile("deep", max_examples=200, **ANY_SPEED)
settings.load_profile("deep" if DEEP else "quick")
