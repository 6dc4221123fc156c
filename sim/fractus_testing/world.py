"""World that the cameras of virtual drones see."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class World:
    """A generated world.

    Attributes:
        seed: Seed of the ground and of the objects on it.
        arguments: Additional arguments of `fractus camera-world`.
    """

    seed: int = 1
    arguments: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the world as a field of an experiment file."""
        return {"seed": self.seed, "arguments": list(self.arguments)}
