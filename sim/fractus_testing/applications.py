"""Programs under test."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field

from fractus_core.api.methods import Interface


@dataclass(frozen=True)
class App:
    """A program that flies a drone or uses its camera.

    Attributes:
        command: Program and arguments. `python` is replaced by the current interpreter. Relative paths are relative
            to the file of the test.
        params: Environment variables. Values other than text are passed as JSON.
        component: Component of the manifests that the program implements. Only needed with `set_manifests`.
        interface: `grpc` for programs of the SDK. `mavlink` for programs that speak MAVLink: FRACTUS_VEHICLE then contains
            the connection. With `set_manifests`, the manifests decide.
        port: Port at which the program listens. It is passed as PORT, and other programs get the address by the component.
    """

    command: tuple[str, ...]
    params: Mapping[str, object] = field(default_factory=dict)
    component: str | None = None
    port: int | None = None
    interface: Interface = "grpc"

    @property
    def environment(self) -> dict[str, str]:
        """Parameters as environment variables."""
        return {
            name: value if isinstance(value, str) else json.dumps(value, default=list)
            for name, value in self.params.items()
        }


def app_of(
    program: App | str,
    params: Mapping[str, object],
    component: str | None = None,
    port: int | None = None,
    interface: Interface | None = None,
) -> App:
    """Return an App with additional parameters. A text is the path of a Python program."""
    base = App(("python", program)) if isinstance(program, str) else program
    return App(
        base.command,
        {**base.params, **params},
        component or base.component,
        port or base.port,
        interface or base.interface,
    )
