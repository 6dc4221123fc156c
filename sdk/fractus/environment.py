"""What Fractus puts into the environment of a component's pod: identity, addresses, control points."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from fractus.errors import NotConfigured
from fractus.tasks import ControlPoint

MOBILITY_PORT = 50051
CAMERA_PORT = 50052
DEFAULT_TLS_DIR = "/var/run/fractus/tls"


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Where a node service listens, and how both sides prove who they are.

    Attributes:
        address: host:port.
        server_name: the name that the service's certificate must carry.
        tls_dir: folder with tls.crt, tls.key and ca.crt of this component.
    """

    address: str
    server_name: str
    tls_dir: Path

    @classmethod
    def on_node(cls, node: str, address: str, tls_dir: Path) -> Endpoint:
        """A service of a node, whose certificate carries the node's name whatever address is dialled."""
        return cls(address, f"{node}.node.fractus.dev", tls_dir)


def endpoint(service: str, env: Mapping[str, str] | None = None) -> Endpoint:
    """The endpoint of `mobility` or `camera` on the node that this pod runs on.

    Raises:
        NotConfigured: a variable is missing; the message names it.
    """
    values = os.environ if env is None else env
    node = _needed(values, "FRACTUS_NODE")
    address = values.get(f"FRACTUS_{service.upper()}_ADDRESS")
    if not address:
        port = {"mobility": MOBILITY_PORT, "camera": CAMERA_PORT}[service]
        address = f"{_needed(values, 'FRACTUS_HOST_IP')}:{port}"
    return Endpoint.on_node(node, address, Path(values.get("FRACTUS_TLS_DIR", DEFAULT_TLS_DIR)))


def egress(component: str, env: Mapping[str, str] | None = None) -> str:
    """Address (`host:port`) of a component that this one may call.

    Args:
        component: its name in the application, such as `ImageChecker`.
        env: variables to read instead of the process' own.

    Raises:
        NotConfigured: the application does not list it in this component's egress.
    """
    values = os.environ if env is None else env
    kebab = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "-", component)
    name = f"FRACTUS_SERVICE_{kebab.upper().replace('-', '_')}"
    address = values.get(name)
    if not address:
        raise NotConfigured(f"{name} is not set; list {component} in the egress of this component")
    return address


def control_points(env: Mapping[str, str] | None = None) -> tuple[ControlPoint, ...]:
    """The driver's control points, in the order flown: from FRACTUS_CONTROL_POINTS, or from the Grant of FRACTUS_GRANT.

    A driver that has control finds its own in `control.task`, without any of these.

    Raises:
        NotConfigured: both variables are missing, or what they give is not what Fractus writes.
    """
    values = os.environ if env is None else env
    source, points = "FRACTUS_CONTROL_POINTS", None
    try:
        if not values.get(source) and values.get("FRACTUS_GRANT"):
            source = f"FRACTUS_GRANT ({values['FRACTUS_GRANT']})"
            points = json.loads(Path(values["FRACTUS_GRANT"]).read_bytes())["spec"].get("controlPoints") or []
        else:
            if not values.get(source):
                raise NotConfigured(
                    f"{source} is not set; set FRACTUS_GRANT to a signed Grant's file, or see `control.task`"
                )
            points = json.loads(values[source])
        return tuple(ControlPoint.from_manifest(point) for point in points)
    except OSError as error:
        raise NotConfigured(f"{source} cannot be read: {error.strerror}; name a signed Grant's file") from None
    except (ValueError, AttributeError, TypeError, KeyError) as error:
        raise NotConfigured(f"{source} does not hold control points as Fractus writes them: {error}") from None


def _needed(values: Mapping[str, str], name: str) -> str:
    value = values.get(name)
    if not value:
        raise NotConfigured(f"{name} is not set; run this as a component of a Fractus application, or pass an Endpoint")
    return value
