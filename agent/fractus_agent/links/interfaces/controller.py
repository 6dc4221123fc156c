"""What all controllers of interfaces have in common."""

from __future__ import annotations

from typing import Protocol


class InterfaceProblem(Exception):
    """The interface cannot be used now.

    Args:
        reason: CamelCase, for programs.
        message: one sentence for people.
    """

    def __init__(self, reason: str, message: str) -> None:
        self.reason = reason
        super().__init__(message)


class Controller(Protocol):
    """Controls one interface.

    Attributes:
        device: its name.
    """

    device: str

    def check(self) -> None:
        """Look whether the device is there, and for direct links alone, without doing anything to it.

        Raises:
            InterfaceProblem: it is not.
        """

    async def up(self) -> None:
        """Bring it up on the network of its pairing, with this node's address; called again and again while it is wanted.

        Raises:
            InterfaceProblem: it cannot be.
        """

    async def down(self) -> None:
        """Leave the network and take the address away; what is gone already is no error."""
