"""What all rings of tests share."""

from depth import DEEP
from hypothesis import settings

settings.register_profile("quick", max_examples=50)
settings.register_profile("deep", max_examples=200)
settings.load_profile("deep" if DEEP else "quick")
