"""`fractus audit`: checks the hash chain of audit logs, shows them, and writes them in the formats of others."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from fractus_services.recording.messages import parse_time_ns, sentence

from fractus_cli.audit_logs import Window, decided, entries, found_logs, judged
from fractus_cli.output import output_option, printable

if TYPE_CHECKING:
    from fractus_runtime.audit_checkpoints import Checkpoint

    from fractus_cli.flight_export import Places

_FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
_PATHS = click.argument("paths", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))


@click.group()
def audit() -> None:
    """Audit logs of a node's services and agent."""


@audit.command("verify")
@_PATHS
@click.option(
    "--since",
    multiple=True,
    help="A checkpoint that was kept elsewhere: a copy of the log's .checkpoint file, or LOG:NUMBER:HASH as the node's status"
    " has it. Every entry since must be there.",
)
@click.option("--ca", type=_FILE, help="ca.crt that the certificates in checkpoints must be of.")
@output_option
def verify_command(paths: tuple[Path, ...], since: tuple[str, ...], ca: Path | None, output: str) -> None:
    """Check that no entry of the audit logs in PATHS was changed, removed or inserted.

    PATHS are directories, logs (with their segments), or single segments. Exits with 1 at the first log that is not sound; json
    lists all of them first.
    """
    found = found_logs(paths)
    known = _checkpoints(since, ca)
    for absent in known.keys() - {log.stem for log, files in found.items() if log in files}:
        raise click.ClickException(f"--since: the checkpoint is of {absent}.jsonl; give that log, or its directory")
    for stem in known:
        same = [str(log) for log, files in found.items() if log in files and log.stem == stem]
        if len(same) > 1:
            raise click.ClickException(
                f"--since: the checkpoint is of {stem}.jsonl, and there are several: {', '.join(same)}; give one at a time"
            )
    if output == "json":
        click.echo(json.dumps([_judgement(name, files, known.get(name.stem)) for name, files in found.items()]))
    for name, files in found.items():
        said = _check(name, files, known.get(name.stem))
        if output == "text":
            click.echo(said)


def _moment(context: click.Context, option: click.Parameter, text: str | None) -> int | None:
    del context, option
    found = parse_time_ns(text)
    if text is not None and found is None:
        raise click.BadParameter(f"{text!r} is no time with its zone, such as 2026-06-01T12:00:00Z")
    return found


def _window(command: Callable[..., None]) -> Callable[..., None]:
    before = click.option("--before", metavar="TIME", callback=_moment, help="Only entries that are older.")
    return click.option("--after", metavar="TIME", callback=_moment, help="Only entries from then on.")(before(command))


def _problems(found: dict[Path, list[Path]]) -> list[str]:
    """Why the logs prove nothing, said on standard error; empty when their chains are sound."""
    problems = [problem for name, files in found.items() if (problem := judged(name, files)[1])]
    for problem in problems:
        click.echo(f"warning: not verified: {problem}", err=True)
    return problems


@audit.command()
@_PATHS
@_window
@click.option("--all", "every", is_flag=True, help="Also calls that were permitted, grants, and where the drone was.")
@output_option
def show(paths: tuple[Path, ...], after: int | None, before: int | None, every: bool, output: str) -> None:
    """Print what policies corrected, refused or took over, and who had the drone, from the audit logs in PATHS.

    PATHS are as for `verify`. Logs whose chains are not sound are shown with a warning on standard error. json is one object
    a line, as in the log, with `node` and `log`.
    """
    found = found_logs(paths)
    _problems(found)
    for entry in entries(found, Window(after, before)):
        if not every and not decided(entry):
            continue
        if output == "json":
            own = {key: value for key, value in entry.items() if key != "time_ns"}
            click.echo(json.dumps(own, sort_keys=True, ensure_ascii=False))
        else:
            click.echo(printable(f"{entry['time']}  {entry['node']}/{entry['log']}  {_line(entry)}"))


def _line(entry: dict[str, Any]) -> str:
    if entry.get("kind") != "state":
        return f"{entry.get('kind')}: {sentence(entry)}"
    words = ("lat", "lon", "alt", "speed", "mode", "controller", "battery", "in_air")
    return "state: " + ", ".join(f"{word}={entry[word]}" for word in words if word in entry)


@audit.command()
@_PATHS
@click.option(
    "--to", "target", type=click.Choice(["csv", "geojson", "kml", "mcap"]), required=True, help="The format to write."
)
@click.option("--file", type=click.Path(dir_okay=False, path_type=Path), help="Where to; else standard output.")
@click.option(
    "--zones",
    multiple=True,
    type=click.Path(exists=True, path_type=Path),
    help="Manifests (files or directories) whose Zones, and zones and areas of Grants, are drawn, too; may be repeated.",
)
@_window
def export(
    *,
    paths: tuple[Path, ...],
    target: str,
    file: Path | None,
    zones: tuple[Path, ...],
    after: int | None,
    before: int | None,
) -> None:
    """Write the audit logs in PATHS for other programs: flown paths, verdicts, takeovers, and zones.

    PATHS are as for `verify`, of one drone or several. geojson and kml have paths and decisions, csv a row for every entry, mcap everything for
    Foxglove. Logs whose chains are not sound are written with a warning, which geojson, kml and mcap also carry.
    """
    from fractus_cli.flight_export import WRITERS, Export  # noqa: PLC0415 - showing and verifying need no geometry

    found = found_logs(paths)
    given = Export(entries(found, Window(after, before)), _places(zones), _problems(found))
    if file is None:
        if target == "mcap" and sys.stdout.isatty():
            raise click.ClickException("mcap is no text; give --file, or redirect standard output")
        WRITERS[target](given, sys.stdout.buffer)
        return
    with file.open("wb") as out:
        WRITERS[target](given, out)


def _places(paths: Sequence[Path]) -> Places:
    from fractus_core.api import Grant, Zone  # noqa: PLC0415
    from fractus_services.recording.map_features import areas_of, zones_of  # noqa: PLC0415

    from fractus_cli.flight_export import Places  # noqa: PLC0415
    from fractus_cli.manifests import BadManifest, read_manifests  # noqa: PLC0415

    try:
        manifests = read_manifests(paths, (Grant, Zone)) if paths else None
    except BadManifest as error:
        raise click.ClickException(str(error)) from None
    if manifests is None:
        return Places()
    specs = [grant.spec for grant in manifests.of(Grant).values()]
    named = {zone.name: zone for zone in zones_of(specs)} | manifests.of(Zone)
    shapes = [(zone, "zone", "") for _, zone in sorted(named.items())]
    shapes += [(area, area.name, spec.component) for spec in specs for area in areas_of(spec)]
    if not shapes:
        raise click.ClickException(
            f"--zones {', '.join(map(str, paths))}: there is no Zone and no Grant in the manifests"
        )
    return Places(shapes)


def _checkpoints(since: tuple[str, ...], ca: Path | None) -> dict[str, Checkpoint]:
    """The checkpoints by the names of their logs."""
    if not since:
        return {}
    # Imported here: what only verifies chains needs no cryptography.
    from cryptography import x509  # noqa: PLC0415
    from fractus_runtime.audit_checkpoints import InvalidCheckpoint, parse_status_checkpoint, read_checkpoint  # noqa: PLC0415

    known: dict[str, Checkpoint] = {}
    try:
        authorities = x509.load_pem_x509_certificates(ca.read_bytes()) if ca is not None else []
    except ValueError:
        raise click.ClickException(f"--ca {ca}: holds no certificate") from None
    for given in since:
        try:
            checkpoint = parse_status_checkpoint(given) or read_checkpoint(Path(given).read_bytes(), authorities)
        except (OSError, InvalidCheckpoint) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise click.ClickException(f"--since {given}: {reason}") from None
        if checkpoint.log in known:
            raise click.ClickException(
                f"--since {given}: is the second of {checkpoint.log}.jsonl; give one for each log"
            )
        known[checkpoint.log] = checkpoint
    return known


def _judgement(name: Path, files: list[Path], checkpoint: Checkpoint | None) -> dict[str, Any]:
    finding, problem = judged(name, files, checkpoint.link if checkpoint is not None else None)
    return {
        "log": str(name if name in files else files[0]), "files": [str(file) for file in files], "entries": finding.entries,
        "sound": not problem, "problem": problem, "removed": finding.before, "torn": finding.torn, "whole": name in files,
    }  # fmt: skip


def _check(name: Path, files: list[Path], checkpoint: Checkpoint | None) -> str:
    """What is said of a log that is sound.

    Raises:
        click.ClickException: it is not.
    """
    finding, problem = judged(name, files, checkpoint.link if checkpoint is not None else None)
    if problem:
        raise click.ClickException(problem)
    part = name not in files
    said = [f"{finding.entries} entries, chain sound"]
    if len(files) > 1:
        said.append(f"{len(files)} files")
    if checkpoint is not None:
        by = f", as signed by {checkpoint.node}" if checkpoint.node else ""
        unsure = "" if checkpoint.certified else ", whose certificate was not checked (give --ca)"
        said.append(f"all since number {checkpoint.link.sequence} are there{by}{unsure if by else ''}")
    if finding.before:
        said.append(f"the {finding.before} before were removed to make room")
    if part:
        said.append("a part of the log, so what came before and after is not judged")
    if finding.torn:
        said.append("the last line is incomplete (a crash, or it is being written)")
    return f"{files[0] if part else name}: {'; '.join(said)}"
