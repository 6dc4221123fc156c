"""`fractus zones`: Zones from and to the formats of others."""

from __future__ import annotations

import pathlib
from collections.abc import Callable, Iterable

import click
import yaml
from fractus_core.api import InvalidObject, Zone
from fractus_core.geo import formats

from fractus_cli.manifests import BadManifest, read_manifests

_READERS: dict[str, Callable[[str], formats.Imported]] = {
    "geojson": formats.read_geojson,
    "kml": formats.read_kml,
    "qgc-plan": formats.read_qgc_plan,
    "ed269": formats.read_ed269,
}
_WRITERS: dict[str, Callable[[Iterable[Zone]], formats.Exported]] = {
    "geojson": formats.write_geojson,
    "kml": formats.write_kml,
    "ed269": formats.write_ed269,
}


@click.group()
def zones() -> None:
    """Read and write zones in the formats of others."""


@zones.command("import")
@click.argument("file", type=click.Path(exists=True, dir_okay=False, path_type=pathlib.Path))
@click.option("--from", "source", type=click.Choice(sorted(_READERS)), required=True, help="The format of the file.")
@click.option("--prefix", default="", help="Put before the name of every zone.")
def import_(file: pathlib.Path, source: str, prefix: str) -> None:
    """Print a Zone manifest for each zone in a file; what does not map is listed on standard error."""
    try:
        found = _READERS[source](file.read_text(encoding="utf-8"))
        named = [_renamed(zone, prefix) for zone in found.zones]
    except UnicodeDecodeError:
        raise click.ClickException(f"{file}: this is no text file in UTF-8") from None
    except InvalidObject as error:
        raise click.ClickException(f"{file}: {error}") from None
    _tell(found.notes)
    if not named:
        raise click.ClickException(f"{file}: there is no zone in the file")
    click.echo(yaml.safe_dump_all(map(_manifest, named), sort_keys=False, width=120), nl=False)


@zones.command("export")
@click.argument("paths", type=click.Path(exists=True, path_type=pathlib.Path), nargs=-1, required=True)
@click.option("--to", "target", type=click.Choice(sorted(_READERS)), required=True, help="The format to print.")
@click.option("--inclusion", is_flag=True, help="For qgc-plan: fences to stay in, instead of out of.")
def export(paths: tuple[pathlib.Path, ...], target: str, inclusion: bool) -> None:
    """Print the Zones of some manifests in another format; what does not map is listed on standard error."""
    if inclusion and target != "qgc-plan":
        raise click.ClickException("--inclusion is for --to qgc-plan")
    try:
        every = sorted(read_manifests(paths).of(Zone).values(), key=lambda zone: zone.name)
    except BadManifest as error:
        raise click.ClickException(str(error)) from None
    if not every:
        raise click.ClickException("there is no Zone in the manifests")
    write = _WRITERS.get(target)
    found = write(every) if write is not None else formats.write_qgc_plan(every, inclusion=inclusion)
    _tell(found.notes)
    click.echo(found.text, nl=False)


def _renamed(zone: Zone, prefix: str) -> Zone:
    body = zone.to_dict()
    body["metadata"]["name"] = prefix + zone.name
    return Zone.from_body(body)


def _manifest(zone: Zone) -> dict[str, object]:
    body = zone.to_dict()
    spec = {key: value for key, value in body["spec"].items() if value not in ("", [])}
    return {"apiVersion": body["apiVersion"], "kind": body["kind"], "metadata": {"name": zone.name}, "spec": spec}


def _tell(notes: Iterable[str]) -> None:
    for note in notes:
        click.echo(note, err=True)
