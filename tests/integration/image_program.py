"""Program that runs inside an image. It imports all modules of packages, and uses installed libraries with native code.

Usage: python3 - PACKAGE... < image_program.py
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import pkgutil
import sys
from collections.abc import Iterator
from pathlib import Path


def modules(package: str) -> Iterator[str]:
    """Yield the names of all modules of a package, except programs."""
    yield package
    for module in pkgutil.walk_packages(importlib.import_module(package).__path__, package + "."):
        if not module.name.endswith("__main__"):
            yield module.name


def check_bytecode() -> None:
    """Check that no bytecode file is validated by the time stamp of its source, because images reset time stamps."""
    for name, module in list(sys.modules.items()):
        source = getattr(module, "__file__", None) or ""
        if source.endswith(".py"):
            cached = Path(importlib.util.cache_from_source(source))
            flags = int.from_bytes(cached.read_bytes()[4:8], "little")
            assert flags == 1, f"{name}: the bytecode depends on the time stamp of its source"


def check_geometry() -> None:
    import shapely

    square = shapely.box(0, 0, 10, 10)
    assert shapely.STRtree([square]).query(shapely.Point(1, 1), predicate="within").tolist() == [0]


def check_linear_algebra() -> None:
    import numpy as np

    a = np.random.default_rng(1).standard_normal((60, 60))
    assert np.allclose(a @ np.linalg.inv(a), np.eye(60))


def check_images() -> None:
    import cv2
    import numpy as np

    picture = np.zeros((480, 640, 3), np.uint8)
    assert cv2.imdecode(cv2.imencode(".jpg", picture)[1], cv2.IMREAD_COLOR).shape == picture.shape


def main() -> None:
    """Check the image."""
    names = [name for package in sys.argv[1:] for name in modules(package)]
    for name in names:
        importlib.import_module(name)
    for library, check in (("numpy", check_linear_algebra), ("shapely", check_geometry), ("cv2", check_images)):
        if importlib.util.find_spec(library):
            check()
    check_bytecode()
    assert importlib.metadata.version("fractus-drones")
    print(f"imported {len(names)} modules")


if __name__ == "__main__":
    main()
