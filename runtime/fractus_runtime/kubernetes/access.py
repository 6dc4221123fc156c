"""Where the API server is, and who asks: from a kubeconfig, a pod's service account, or a certificate."""

from __future__ import annotations

import copy
import math
import os
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path

import yaml
from kubernetes.aio.client import Configuration
from kubernetes.aio.config import ConfigException, load_kube_config
from kubernetes.aio.config.incluster_config import InClusterConfigLoader

from fractus_runtime.kubernetes.errors import KubeError

SERVICE_ACCOUNT = Path("/var/run/secrets/kubernetes.io/serviceaccount")
_KUBECONFIG = "~/.kube/config"


class Unconfigured(Exception):
    """No usable credentials for an API server were found."""


@dataclass(frozen=True, slots=True)
class Access:
    """How to reach an API server.

    Attributes:
        configuration: What the official client asks with.
        renew: Reads the credentials again into the configuration, for when the API server no longer takes them:
            a token file was rotated, or a credential plugin has a fresh token.
    """

    configuration: Configuration
    renew: Callable[[], Awaitable[None]]


async def kubeconfig(path: str | Path, context: str | None = None) -> Access:
    """Access by a context of a kubeconfig, or its current one; several are separated as in KUBECONFIG.

    Raises:
        Unconfigured: there is none, or it has no such context that is whole.
    """
    configuration = Configuration()

    async def load() -> None:
        try:
            await load_kube_config(str(path), context=context, client_configuration=configuration, persist_config=False)
        # The loader does not check types: a kubeconfig of other shapes ends in whatever Python says of them.
        except (ConfigException, OSError, yaml.YAMLError, AttributeError, TypeError, ValueError) as error:
            raise Unconfigured(f"the kubeconfig {path} cannot be used: {error}") from error

    await load()
    return Access(configuration, load)


async def in_cluster(directory: Path = SERVICE_ACCOUNT) -> Access:
    """Access by the service account of this pod; its token is read again every minute, and when it is refused.

    Raises:
        Unconfigured: this is no pod, or it has no service account.
    """
    loader = InClusterConfigLoader(str(directory / "token"), str(directory / "ca.crt"))
    configuration = Configuration()

    async def load() -> None:
        try:
            loader.load_and_set(configuration)
        except (ConfigException, OSError) as error:
            raise Unconfigured(f"the service account cannot be used: {error}") from error

    await load()
    return Access(configuration, load)


async def from_environment(context: str | None = None) -> Access:
    """Access by the service account of this pod or, outside of one, by KUBECONFIG or kubectl's own kubeconfig.

    Args:
        context: of the kubeconfig; who names one does not mean the pod.

    Raises:
        Unconfigured: there is none of them.
    """
    if context is None:
        try:
            return await in_cluster()
        except Unconfigured:
            pass
    try:
        return await kubeconfig(os.environ.get("KUBECONFIG") or _KUBECONFIG, context)
    except Unconfigured as error:
        raise Unconfigured(f"no cluster: set KUBECONFIG, or run in a pod ({error})") from error


def with_certificate(
    server: str, ca: Path | None = None, certificate: tuple[Path, Path] | None = None, token: str = ""
) -> Access:
    """Access by a client certificate (certificate and key) or a token."""
    configuration = Configuration(host=server, ssl_ca_cert=None if ca is None else str(ca))
    if certificate is not None:
        configuration.cert_file, configuration.key_file = map(str, certificate)
    if token:
        configuration.api_key["BearerToken"] = f"Bearer {token}"

    async def nothing() -> None:
        """Neither changes."""

    return Access(configuration, nothing)


def with_tokens(configuration: Configuration, token: Callable[[], Awaitable[str]], life_s: float) -> Access:
    """Access to the API server of a configuration by tokens that are asked for: the first before the first request.

    Args:
        configuration: of any other access to it; its credentials are left out.
        token: asks for a new one.
        life_s: how long one is used before the next is asked for; it should be valid for twice as long.
    """
    own = copy.copy(configuration)
    own.cert_file = own.key_file = None
    # The client asks the hook for a token where it has had one, if only an empty one.
    own.api_key = {"BearerToken": ""}
    renew_at_s = -math.inf

    async def renew() -> None:
        nonlocal renew_at_s
        own.api_key["BearerToken"] = f"Bearer {await token()}"
        renew_at_s = time.monotonic() + life_s

    async def in_time(_configuration: Configuration) -> None:
        nonlocal renew_at_s
        if time.monotonic() < renew_at_s:
            return
        try:
            await renew()
        except KubeError:
            if not own.api_key["BearerToken"]:
                raise
            # The one that there is may be good for as long again; where it is not, the API server says so.
            renew_at_s = time.monotonic() + life_s / 10

    own.refresh_api_key_hook = in_time
    return Access(own, renew)
