"""`fractus images`: command line for the container images."""

from __future__ import annotations

from pathlib import Path

import click
from fractus_runtime.files import write_file

from fractus_cluster.cluster import print_report
from fractus_cluster.images.bill import image_bill
from fractus_cluster.images.build import TARGETS, build_images, find_source
from fractus_cluster.images.store import ImageStore


@click.group()
def images() -> None:
    """Build the container images of Fractus from its Dockerfile with buildah, and list them."""


@images.command()
@click.argument("targets", nargs=-1, type=click.Choice(TARGETS), metavar="[TARGET]...")
@click.option(
    "--source", type=click.Path(path_type=Path, file_okay=False, exists=True), help="Checkout with the Dockerfile."
)
@click.option("--tag", default="dev", show_default=True, help="Tag of the images.")
@click.option("--force", is_flag=True, help="Build images even if their sources did not change.")
@click.option(
    "--sbom",
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder for a bill of materials of each image (CycloneDX).",
)
def build(targets: tuple[str, ...], source: Path | None, tag: str, force: bool, sbom: Path | None) -> None:
    """Build the TARGETs (all by default) whose sources changed, and print the names of the images."""
    targets = targets or TARGETS
    built = build_images(source or find_source(), targets=targets, tag=tag, force=force, report=print_report)
    if sbom is not None:
        sbom.mkdir(parents=True, exist_ok=True)
    for target, image in zip(targets, built, strict=True):
        if sbom is not None:
            write_file(sbom / f"{target}.cdx.json", image_bill(image).encode(), 0o644, durable=False)
        click.echo(image)


@images.command("list")
def list_images() -> None:
    """Print the images of the clusters on this machine with their digests, as ApplicationTemplates name images."""
    for image in ImageStore.default(report=print_report).layout.images().values():
        click.echo(image.pinned_name)
