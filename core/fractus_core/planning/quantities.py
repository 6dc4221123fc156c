"""Resource quantities as the API server spells them."""

from __future__ import annotations

from fractus_core.api.model import quantity

_RARE_SCALE = {"n": 1e-9, "u": 1e-6, "E": 1e18, "Ei": 2.0**60}


def amount_of(text: str | float) -> float:
    """Value of any quantity that the API server may hold, also those that manifests of ours may not use.

    Raises:
        ValueError: it is not a quantity.
    """
    try:
        return quantity(text)
    except ValueError:
        digits = str(text)
        for suffix, scale in _RARE_SCALE.items():
            if digits.endswith(suffix):
                return float(digits.removesuffix(suffix)) * scale
        return float(digits)
