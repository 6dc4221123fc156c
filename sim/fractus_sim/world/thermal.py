"""How a picture looks to a thermal camera: white is hot. A look, not radiometry."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

# Grey value from blue, green, red: plants (green) are cool, asphalt and roofs (grey, red) are warmer, water is cold.
_WEIGHTS = np.array([[-0.10, -0.28, 0.62, 62.0]] * 3)


def thermal(picture: NDArray[np.uint8]) -> None:
    """Turn a picture of the ground in daylight colours into one of its warmth, in place."""
    cv2.transform(picture, _WEIGHTS, dst=picture)
