"""`fractus zones`: import Zones from other formats and export Zones to other formats."""

from __future__ import annotations

import functools
import pathlib
from collections.abc import Callable, Collection, Iterable, Iterator

import click
from fractus_core.api import Depot, InvalidObject, Zone
from fractus_core.documents import BadDocument, dump_documents, parse_documents
from fractus_core.geo import area_center, formats
from fractus_core.plausibility import far_zones
from fractus_core.validation import check_zone

from fractus_cli.manifests import BadManifest, read_file, read_manifests
from fractus_cli.output import printable

_READERS: dict[str, Callable[[str, Collection[str]], formats.Imported]] = {
    "geojson": formats.read_geojson,
    "kml": formats.read_kml,
    "qgc-plan": formats.read_qgc_plan,
    "ed269": formats.read_ed269,
    "ed318": formats.read_ed318,
}
_DROPPING = {
    "geojson": formats.read_geojson,
    "kml": formats.read_kml,
    "ed269": formats.read_ed269,
    "ed318": formats.read_ed318,
}
_WRITERS: dict[str, Callable[[Iterable[Zone]], formats.Exported]] = {
    "geojson": formats.write_geojson,
    "kml": formats.write_kml,
    "ed269": formats.write_ed269,
}
_ZIP = b"PK\x03\x04"
"""First bytes of a ZIP archive."""


@click.group()
def zones() -> None:
    """Import and export Zones in other formats."""


@zones.command("import")
@click.argument("file", type=click.Path(exists=True, dir_okay=False, path_type=pathlib.Path))
@click.option("--from", "source", type=click.Choice(sorted(_READERS)), required=True, help="Format of the file.")
@click.option("--prefix", default="", help="Prefix for the names of all Zones.")
@click.option("--leave-out", "without", multiple=True, metavar="NAME", help="Feature or Zone to skip. May be repeated.")
@click.option("--drop", multiple=True, metavar="PROPERTY", help="Property to ignore. May be repeated.")
@click.option(
    "--depots",
    "depots",
    type=click.Path(exists=True, path_type=pathlib.Path),
    multiple=True,
    help="File or directory with Depots: report zones that are far from all of them. May be repeated.",
)
def import_(
    file: pathlib.Path,
    source: str,
    *,
    prefix: str,
    without: tuple[str, ...],
    drop: tuple[str, ...],
    depots: tuple[pathlib.Path, ...],
) -> None:
    """Print a Zone manifest for each zone in a file.

    A feature is rejected if a Zone cannot represent its area, altitudes or schedule exactly. Correct it, or skip it with
    --leave-out. The location of the zones is printed on standard error. Other properties that cannot be converted are listed on standard error. A property that may state a size,
    an altitude or a time is rejected unless it is ignored with --drop (all formats but qgc-plan).
    """
    read = _READERS[source]
    if drop and source not in _DROPPING:
        raise click.ClickException(f"--drop requires --from {', '.join(_DROPPING)}")
    if drop:
        read = functools.partial(_DROPPING[source], drop=drop)
    try:
        content = read_file(file)
    except BadManifest as error:
        raise click.ClickException(str(error)) from None
    if content.startswith(_ZIP):
        raise click.ClickException(
            f"{file}: this is a ZIP archive, such as a KMZ file; unpack it and import the file inside (doc.kml)"
        )
    try:
        imported = read(content.decode("utf-8-sig"), without)
        zones = [_renamed(zone, prefix) for zone in imported.zones]
        for zone in zones:
            check_zone(zone)
    except UnicodeDecodeError:
        raise click.ClickException(f"{file}: not a UTF-8 text file; convert it to UTF-8") from None
    except formats.InexactFeatures as error:
        *notes, last = _located(file, content, error.every)
        _print_notes(notes)
        raise click.ClickException(last) from None
    except InvalidObject as error:
        raise click.ClickException(f"{file}: {error}") from None
    _print_notes(imported.notes)
    if not zones:
        raise click.ClickException(
            f"{file}: the file contains no zone; draw a polygon or a circle in it, or specify another file"
        )
    _print_notes(_places(zones, depots))
    click.echo(dump_documents(map(_manifest, zones)), nl=False)


def _places(zones: Collection[Zone], depots: Iterable[pathlib.Path]) -> Iterator[str]:
    """Yield where the zones are, and whether they are far from the depots of manifests."""
    centers = [area_center(zone.spec.area) for zone in zones]
    lats = [center.lat for center in centers]
    lons = [center.lon for center in centers]
    yield (
        f"imported {len(zones)} {'zone' if len(zones) == 1 else 'zones'}, centers at latitude {min(lats):.4f} to {max(lats):.4f}"
        f" and longitude {min(lons):.4f} to {max(lons):.4f}"
    )
    try:
        bases = read_manifests(depots, (Depot,)).of(Depot).values()
    except BadManifest as error:
        raise click.ClickException(str(error)) from None
    if far := far_zones(zones, bases):
        yield f"note: {far}"


def _located(file: pathlib.Path, content: bytes, problems: Iterable[InvalidObject]) -> list[str]:
    """Return a message for each problem, with the file and, for JSON formats, the line of its field."""
    try:
        documents = parse_documents(content, str(file), is_json=True)
    except BadDocument:
        return [f"{file}: {problem}" for problem in problems]
    return [f"{documents.where(documents.values[0], problem.field)}: {problem}" for problem in problems]


@zones.command("export")
@click.argument("paths", type=click.Path(exists=True, path_type=pathlib.Path), nargs=-1, required=True)
@click.option(
    "--to", "target", type=click.Choice(sorted({*_WRITERS, "qgc-plan"})), required=True, help="Output format."
)
@click.option("--inclusion", is_flag=True, help="For qgc-plan: write inclusion fences instead of exclusion fences.")
def export(paths: tuple[pathlib.Path, ...], target: str, inclusion: bool) -> None:
    """Print the Zones of manifests in another format. Properties that cannot be converted are listed on standard error."""
    if inclusion and target != "qgc-plan":
        raise click.ClickException("--inclusion requires --to qgc-plan")
    try:
        zones = sorted(read_manifests(paths).of(Zone).values(), key=lambda zone: zone.name)
    except BadManifest as error:
        raise click.ClickException(str(error)) from None
    if not zones:
        raise click.ClickException("the manifests contain no Zone")
    write = _WRITERS.get(target)
    try:
        exported = write(zones) if write is not None else formats.write_qgc_plan(zones, inclusion=inclusion)
    except InvalidObject as error:
        raise click.ClickException(str(error)) from None
    _print_notes(exported.notes)
    click.echo(exported.text, nl=False)


def _renamed(zone: Zone, prefix: str) -> Zone:
    body = zone.to_dict()
    body["metadata"]["name"] = prefix + zone.name
    return Zone.from_body(body)


def _manifest(zone: Zone) -> dict[str, object]:
    body = zone.to_dict()
    spec = {key: value for key, value in body["spec"].items() if value not in ("", [])}
    metadata: dict[str, object] = {"name": zone.name}
    if zone.metadata.annotations:
        metadata["annotations"] = dict(zone.metadata.annotations)
    return {"apiVersion": body["apiVersion"], "kind": body["kind"], "metadata": metadata, "spec": spec}


def _print_notes(notes: Iterable[str]) -> None:
    for note in notes:
        click.echo(printable(note), err=True)
