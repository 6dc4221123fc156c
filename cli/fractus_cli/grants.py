"""`fractus grants`: keys, certificates and signed Grants for services without Kubernetes."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

import click
from fractus_core.api import Grant, InvalidObject
from fractus_core.identity.authority import BrokenAuthority

from fractus_cli.manifests import BadManifest, read_documents
from fractus_cli.standalone import StandalonePki

_DIRECTORY = click.Path(file_okay=False, path_type=Path)
_FILE = click.Path(exists=True, dir_okay=False, path_type=Path)


@click.group()
def grants() -> None:
    """Sign Grants and issue certificates of nodes and components, without Kubernetes."""


@grants.command()
@click.argument("directory", type=_DIRECTORY)
@click.option(
    "--node",
    "nodes",
    multiple=True,
    required=True,
    help="Name of a node whose services need a certificate. May be repeated.",
)
@click.option(
    "--days", type=click.IntRange(1, 3650), default=365, show_default=True, help="Validity of the certificates in days."
)
def init(directory: Path, nodes: tuple[str, ...], days: int) -> None:
    """Create a certificate authority in DIRECTORY unless it exists, and issue certificates of nodes."""
    try:
        pki = StandalonePki.create(directory, life=timedelta(days=days))
        for node in nodes:
            click.echo(f"--tls {pki.node(node)}    for the services of {node}")
    except (BrokenAuthority, InvalidObject) as error:
        raise click.ClickException(str(error)) from None


@grants.command()
@click.argument("files", type=_FILE, nargs=-1, required=True)
@click.option("--tls", type=_DIRECTORY, required=True, help="Directory created by `fractus grants init`.")
@click.option(
    "--to", type=_DIRECTORY, required=True, help="Directory for the signed Grants (--grants of the services)."
)
@click.option(
    "--days", type=click.IntRange(1, 3650), default=365, show_default=True, help="Validity of the certificates in days."
)
def sign(files: tuple[Path, ...], tls: Path, to: Path, days: int) -> None:
    """Sign the Grants in FILES (YAML or JSON), and issue a certificate for the component of each Grant.

    A Grant that replaces another one takes effect immediately, also in flight. A Grant whose file was removed stays
    revoked. To grant it again, sign its manifest again.
    """
    try:
        pki = StandalonePki.open(tls, life=timedelta(days=days))
        for file in files:
            manifests = list(read_documents(file))
            if not manifests:
                raise BadManifest(f"{file}: contains no Grant")
            for manifest in manifests:
                try:
                    identity = Grant.from_body(manifest.body).spec.identity
                    path = pki.grant(manifest.body, to)
                except InvalidObject as error:
                    raise manifest.bad(error) from None
                click.echo(f"{path}    FRACTUS_TLS_DIR={pki.component(identity)}")
    except (BadManifest, BrokenAuthority, InvalidObject) as error:
        raise click.ClickException(str(error)) from None
