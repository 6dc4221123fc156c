"""Address and credentials of the API server: from a kubeconfig, a pod's service account, or a certificate."""

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
    """Address and credentials of an API server.

    Attributes:
        configuration: Configuration of the official client.
        renew: Reads the credentials into the configuration again, if the API server rejects them: a token file was
            rotated, or a credential plugin has a new token.
    """

    configuration: Configuration
    renew: Callable[[], Awaitable[None]]


async def kubeconfig(path: str | Path, context: str | None = None) -> Access:
    """Return the access of a context of a kubeconfig.

    Args:
        path: Path of the kubeconfig. Several paths are separated as in KUBECONFIG.
        context: Name of the context. Default: the current context.

    Raises:
        Unconfigured: The kubeconfig does not exist, the context is missing, or it is incomplete.
    """
    configuration = Configuration()

    async def load() -> None:
        try:
            await load_kube_config(str(path), context=context, client_configuration=configuration, persist_config=False)
        # The loader does not check types, so an invalid kubeconfig raises arbitrary errors.
        except (ConfigException, OSError, yaml.YAMLError, AttributeError, TypeError, ValueError) as error:
            cause = "it is not a kubeconfig" if isinstance(error, AttributeError | TypeError) else str(error)
            check = f"check it with `kubectl config view --kubeconfig {path}`"
            raise Unconfigured(f"the kubeconfig {path} cannot be used: {cause}; {check}") from error

    await load()
    return Access(configuration, load)


async def in_cluster(directory: Path = SERVICE_ACCOUNT) -> Access:
    """Return the access of the service account of this pod. Its token is read every minute, and when it is rejected.

    Raises:
        Unconfigured: This process does not run in a pod, or the pod has no service account.
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
    """Return the access of this pod's service account. Outside a pod, use KUBECONFIG or kubectl's default kubeconfig.

    Args:
        context: Context of the kubeconfig. With a context, the service account is not used.

    Raises:
        Unconfigured: There are no credentials.
    """
    if context is None:
        try:
            return await in_cluster()
        except Unconfigured:
            pass
    try:
        return await kubeconfig(os.environ.get("KUBECONFIG") or _KUBECONFIG, context)
    except Unconfigured as error:
        raise Unconfigured(
            f"no cluster: set KUBECONFIG to the kubeconfig of a cluster, or run in a pod ({error})"
        ) from error


def with_certificate(
    server: str, ca: Path | None = None, certificate: tuple[Path, Path] | None = None, token: str = ""
) -> Access:
    """Return the access by a client certificate (certificate and key) or a token."""
    configuration = Configuration(host=server, ssl_ca_cert=None if ca is None else str(ca))
    if certificate is not None:
        configuration.cert_file, configuration.key_file = map(str, certificate)
    if token:
        configuration.api_key["BearerToken"] = f"Bearer {token}"
    return unchanging(configuration)


def without_credentials(configuration: Configuration) -> Access:
    """Return the access to an API server without any credentials.

    Args:
        configuration: Configuration of another access to the same API server. Its credentials are not used.
    """
    anonymous = copy.copy(configuration)
    anonymous.cert_file = None
    anonymous.key_file = None
    anonymous.api_key = {}
    anonymous.refresh_api_key_hook = None
    return unchanging(anonymous)


def unchanging(configuration: Configuration) -> Access:
    """Return the access with a configuration whose credentials never change."""

    async def keep() -> None:
        """Do nothing, because neither the certificate nor the token changes."""

    return Access(configuration, keep)


def with_tokens(configuration: Configuration, token: Callable[[], Awaitable[str]], life_s: float) -> Access:
    """Return the access to an API server with tokens that are requested when they are needed.

    Args:
        configuration: Configuration of another access to the same API server. Its credentials are not used.
        token: Requests a new token.
        life_s: Time for which a token is used, in seconds. It should be valid for twice as long.
    """
    token_configuration = copy.copy(configuration)
    token_configuration.cert_file = None
    token_configuration.key_file = None
    # The client calls the hook only if it has a token, which may be empty.
    token_configuration.api_key = {"BearerToken": ""}
    renew_at_s = -math.inf

    async def renew() -> None:
        nonlocal renew_at_s
        token_configuration.api_key["BearerToken"] = f"Bearer {await token()}"
        renew_at_s = time.monotonic() + life_s

    async def renew_if_due(_configuration: Configuration) -> None:
        nonlocal renew_at_s
        if time.monotonic() < renew_at_s:
            return
        try:
            await renew()
        except KubeError:
            if not token_configuration.api_key["BearerToken"]:
                raise
            # Continue with the current token, which should be valid for twice `life_s`. If the API server rejects
            # the token, a new one is requested.
            renew_at_s = time.monotonic() + life_s / 10

    token_configuration.refresh_api_key_hook = renew_if_due
    return Access(token_configuration, renew)
