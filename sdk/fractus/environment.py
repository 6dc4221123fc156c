"""Environment variables that Fractus sets in a component's pod: identity, addresses, control points."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from fractus.control_point import ControlPoint
from fractus.errors import NotConfigured

MOBILITY_PORT = 50051
CAMERA_PORT = 50052
DEFAULT_TLS_DIR = "/var/run/fractus/tls"


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Address of a node service, and the certificates for mutual TLS.

    Attributes:
        address: `host:port`.
        server_name: Name that the service's certificate must contain.
        tls_dir: Directory with `tls.crt`, `tls.key` and `ca.crt` of this component.
    """

    address: str
    server_name: str
    tls_dir: Path

    @classmethod
    def on_node(cls, node: str, address: str, tls_dir: Path) -> Endpoint:
        """Return the endpoint of a service on a node. The certificate contains the node's name, not the address."""
        return cls(address, f"{node}.node.fractus.dev", tls_dir)


def endpoint(service: str, env: Mapping[str, str] | None = None) -> Endpoint:
    """Return the endpoint of `mobility` or `camera` on this pod's node.

    Raises:
        NotConfigured: A variable is missing; the message names it.
    """
    values = os.environ if env is None else env
    node = _required(values, "FRACTUS_NODE")
    address = values.get(f"FRACTUS_{service.upper()}_ADDRESS")
    if not address:
        port = {"mobility": MOBILITY_PORT, "camera": CAMERA_PORT}[service]
        address = f"{_required(values, 'FRACTUS_HOST_IP')}:{port}"
    return Endpoint.on_node(node, address, Path(values.get("FRACTUS_TLS_DIR", DEFAULT_TLS_DIR)))


def egress(component: str, env: Mapping[str, str] | None = None) -> str:
    """Return the address (`host:port`) of a component that this component may call.

    Args:
        component: Name of the component in the application, for example `ImageChecker`.
        env: Environment variables; by default those of the process.

    Raises:
        NotConfigured: The application does not list the component in this component's `egress`.
    """
    values = os.environ if env is None else env
    kebab = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "-", component)
    name = f"FRACTUS_SERVICE_{kebab.upper().replace('-', '_')}"
    address = values.get(name)
    if not address:
        raise NotConfigured(f"{name} is not set; list {component} in the egress of this component")
    return address


def control_points(env: Mapping[str, str] | None = None) -> tuple[ControlPoint, ...]:
    """Return the driver's control points in flight order, from FRACTUS_CONTROL_POINTS or the Grant file in FRACTUS_GRANT.

    A driver with control finds its current control point in `control.task`, without these variables.

    Raises:
        NotConfigured: Both variables are missing, or their content is invalid.
    """
    values = os.environ if env is None else env
    source = "FRACTUS_CONTROL_POINTS"
    try:
        if not values.get(source) and values.get("FRACTUS_GRANT"):
            source = f"FRACTUS_GRANT ({values['FRACTUS_GRANT']})"
            points = json.loads(Path(values["FRACTUS_GRANT"]).read_bytes())["spec"].get("controlPoints") or []
        else:
            if not values.get(source):
                raise NotConfigured(
                    f"{source} is not set; set FRACTUS_GRANT to the file of a signed Grant, or use `control.task`"
                )
            points = json.loads(values[source])
        return tuple(ControlPoint.from_manifest(point) for point in points)
    except OSError as error:
        raise NotConfigured(
            f"{source} cannot be read: {error.strerror}; set it to the file of a signed Grant"
        ) from None
    except (ValueError, AttributeError, TypeError, KeyError) as error:
        raise NotConfigured(f"{source} does not contain valid control points: {error}") from None


def _required(values: Mapping[str, str], name: str) -> str:
    value = values.get(name)
    if not value:
        raise NotConfigured(f"{name} is not set; run this as a component of a Fractus application, or pass an Endpoint")
    return value
