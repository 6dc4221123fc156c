"""`fractus api`: serves the management API until interrupted, and prints its OpenAPI description."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
from collections.abc import Awaitable, Iterator
from contextlib import aclosing
from pathlib import Path
from types import FrameType
from typing import Any
from urllib.parse import urlsplit

import click
import uvicorn
from fractus_runtime import logs
from fractus_runtime.kubernetes import (
    Access,
    Client,
    Unconfigured,
    from_environment,
    with_certificate,
    without_credentials,
)
from fractus_runtime.kubernetes import kubeconfig as from_kubeconfig
from fractus_runtime.loopback import is_loopback
from fractus_runtime.metrics import serve_metrics
from fractus_runtime.open_files import TooFewOpenFiles, raise_open_files

from fractus_management.app import collect, create_app
from fractus_management.openapi import text
from fractus_management.settings import DEFAULT_NAMESPACE, DEFAULT_REQUESTS_PER_S, AutomatedTesting, Settings

log = logging.getLogger(__name__)

DEFAULT_LISTEN = "127.0.0.1:8660"
GRACE_S = 20
"""Seconds for which requests in progress may continue after SIGTERM. It is longer than a wait for a decision."""
_MAX_CONNECTIONS = 1024
_MAX_PORT = 65535


@click.group()
def api() -> None:
    """Serve the REST API for flights as a service."""


@api.command()
def openapi() -> None:
    """Print the OpenAPI description of the API."""
    click.echo(text(create_app(Settings())), nl=False)


def _address(_context: click.Context, _option: click.Parameter, value: str) -> tuple[str, int]:
    host, _, port = value.rpartition(":")
    if not host or not port.isdecimal() or int(port) > _MAX_PORT:
        raise click.BadParameter(f"{value!r} is not HOST:PORT, for example {DEFAULT_LISTEN}")
    return host.removeprefix("[").removesuffix("]"), int(port)


@api.command()
@click.option(
    "--listen",
    callback=_address,
    default=DEFAULT_LISTEN,
    show_default=True,
    metavar="HOST:PORT",
    help="Address of the API. It is served without TLS: put a TLS proxy in front of other addresses than localhost.",
)
@click.option("--server", default="", metavar="URL", help="Kubernetes API server. Default: that of the kubeconfig.")
@click.option(
    "--ca",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help="CA certificate of --server.",
)
@click.option(
    "--node-ca",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="CA certificate of the drones (ConfigMap fractus-ca), to read records of flights. Default: no records.",
)
@click.option("--context", help="Context of the kubeconfig. Default: its current context.")
@click.option(
    "--kubeconfig",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help="Kubeconfig with the API server. Its credentials are not used. Default: KUBECONFIG, or ~/.kube/config.",
)
@click.option(
    "-n", "--namespace", default=DEFAULT_NAMESPACE, show_default=True, help="Namespace of requests without a namespace."
)
@click.option(
    "--requests-per-second",
    type=click.FloatRange(min=0, min_open=True),
    default=DEFAULT_REQUESTS_PER_S,
    show_default=True,
    help="Requests that a token may send per second. It may send five times as many at once.",
)
@click.option(
    "--metrics", default="", metavar="[HOST]:PORT", help="Address of the Prometheus metrics. Default: no metrics."
)
@click.option(
    "--automated-testing", "template", metavar="TEMPLATE",
    help="Also serve InterUSS' flight planning interface for automated testing below /flight_planning/v1, with flights of this"
    " ApplicationTemplate. It removes flight plans on request: use a namespace for tests only.",
)  # fmt: skip
@click.option(
    "--geoid", type=click.FloatRange(-110, 90), default=0.0, show_default=True, metavar="METRES",
    help="For --automated-testing: height of the geoid above the WGS 84 ellipsoid where the tests fly.",
)  # fmt: skip
def serve(
    *,
    listen: tuple[str, int],
    server: str,
    ca: Path | None,
    node_ca: Path | None,
    context: str | None,
    kubeconfig: Path | None,
    namespace: str,
    requests_per_second: float,
    metrics: str,
    template: str | None,
    geoid: float,
) -> None:
    """Serve the API until SIGTERM or SIGINT.

    Each request is sent to the Kubernetes API server with the bearer token of its caller. The API has no permissions of its own.
    """
    if server and (context or kubeconfig):
        raise click.UsageError("specify --server, or a kubeconfig")
    try:
        logs.configure(
            (os.environ.get("FRACTUS_LOG_LEVEL") or "INFO").upper(), os.environ.get("FRACTUS_LOG_FORMAT") or "text"
        )
    except ValueError as error:
        raise click.ClickException(f"FRACTUS_LOG_LEVEL, FRACTUS_LOG_FORMAT: {error}") from None
    try:
        raise_open_files()
    except TooFewOpenFiles as error:
        raise click.ClickException(str(error)) from None
    testing = AutomatedTesting(template, geoid) if template is not None else None
    settings = Settings(namespace, requests_per_s=requests_per_second, automated_testing=testing, node_ca=node_ca)
    asyncio.run(_serve(listen, settings, _access(server, ca, context, kubeconfig), metrics))


async def _access(server: str, ca: Path | None, context: str | None, kubeconfig: Path | None) -> Access:
    """Return the access to the API server without credentials.

    Raises:
        click.ClickException: There is no usable address of an API server.
    """
    try:
        if server:
            access = with_certificate(server, ca)
        elif kubeconfig is not None:
            access = await from_kubeconfig(kubeconfig, context)
        else:
            access = await from_environment(context)
    except Unconfigured as error:
        raise click.ClickException(str(error)) from error
    return without_credentials(access.configuration)


def token_risks(host: str, server: str, *, verified: bool) -> Iterator[str]:
    """Yield a sentence for each way in which others could read the tokens of users.

    Args:
        host: Host on which the API listens.
        server: URL of the Kubernetes API server.
        verified: True if the certificate of the API server is verified.
    """
    if not is_loopback(host):
        yield (
            f"connections to {host} are not encrypted, so others on this network can read the tokens of users; put a TLS proxy in"
            " front of this server"
        )
    address = urlsplit(server)
    if address.scheme != "https" and not is_loopback(address.hostname or ""):
        yield (
            f"connections to the Kubernetes API server {server} are not encrypted, so others on this network can read the tokens"
            " of users; use its https address"
        )
    elif address.scheme == "https" and not verified:
        yield (
            f"the certificate of the Kubernetes API server {server} is not verified, so another server can receive the tokens of"
            " users; specify its CA instead of insecure-skip-tls-verify"
        )


async def _serve(listen: tuple[str, int], settings: Settings, access: Awaitable[Access], metrics: str) -> None:
    try:
        api_server = await access
        client = Client(api_server, "fractus-api", max_connections=_MAX_CONNECTIONS)
    except Unconfigured as error:
        raise click.ClickException(str(error)) from error
    app = create_app(settings, client)
    host, port = listen
    configuration = api_server.configuration
    for risk in token_risks(host, str(configuration.host), verified=configuration.verify_ssl):
        log.warning("management: tokens are at risk (reason=%s)", risk)
    config = uvicorn.Config(
        app,
        host=host,
        port=port,
        log_config=None,
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=GRACE_S,
    )
    # uvicorn raises the signal again after the shutdown, which would end the process before the client is closed.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: None)
    async with aclosing(client), serve_metrics(metrics, lambda: collect(app)):
        await _Server(config).serve()


class _Server(uvicorn.Server):
    """Server that ends event streams at its shutdown, and does not wait for their clients."""

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Begin the shutdown."""
        super().handle_exit(sig, frame)
        app: Any = self.config.app
        asyncio.get_running_loop().call_soon_threadsafe(app.state.stopping.set)
