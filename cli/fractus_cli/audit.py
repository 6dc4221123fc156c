"""`fractus audit`: verify the hash chains of audit logs, show their entries, and export them to other formats."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from fractus_services.recording.messages import parse_time_ns, sentence

from fractus_cli.audit_logs import Window, entries, find_logs, is_decision, verify_log
from fractus_cli.output import output_option, printable

if TYPE_CHECKING:
    from fractus_runtime.audit_checkpoints import Checkpoint

    from fractus_cli.flight_export import Places

_FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
_PATHS = click.argument("paths", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))


@click.group()
def audit() -> None:
    """Verify, show and export audit logs of a node's services and agent."""


@audit.command("verify")
@_PATHS
@click.option(
    "--since",
    multiple=True,
    help="Checkpoint stored off the node: a copy of the log's .checkpoint file, or LOG:NUMBER:HASH from the node's status."
    " The log must contain this entry and every later one. May be repeated, once for each log.",
)
@click.option("--ca", type=_FILE, help="CA certificate that must have issued the certificates in checkpoints.")
@output_option
def verify_command(paths: tuple[Path, ...], since: tuple[str, ...], ca: Path | None, output: str) -> None:
    """Verify that no entry of the audit logs in PATHS was changed, removed or inserted.

    PATHS are directories, logs (including their segments) or single segments. The exit code is 1 if a log is not sound. Text output
    stops at the first such log; JSON output lists all logs.
    """
    found = find_logs(paths)
    known = _checkpoints(since, ca)
    for absent in known.keys() - {log.stem for log, files in found.items() if log in files}:
        raise click.ClickException(
            f"--since: the checkpoint belongs to {absent}.jsonl; add that log or its directory to PATHS"
        )
    for stem in known:
        same = [str(log) for log, files in found.items() if log in files and log.stem == stem]
        if len(same) > 1:
            raise click.ClickException(
                f"--since: several logs match the checkpoint of {stem}.jsonl: {', '.join(same)}; verify one at a time"
            )
    if output == "json":
        click.echo(json.dumps([_judgement(name, files, known.get(name.stem)) for name, files in found.items()]))
    for name, files in found.items():
        summary = _check(name, files, known.get(name.stem))
        if output == "text":
            click.echo(summary)


def _moment(context: click.Context, option: click.Parameter, text: str | None) -> int | None:
    del context, option
    found = parse_time_ns(text)
    if text is not None and found is None:
        raise click.BadParameter(f"{text!r} is not a time with a time zone, such as 2026-06-01T12:00:00Z")
    return found


def _window(command: Callable[..., None]) -> Callable[..., None]:
    before = click.option("--before", metavar="TIME", callback=_moment, help="Only entries before this time.")
    return click.option("--after", metavar="TIME", callback=_moment, help="Only entries at or after this time.")(
        before(command)
    )


def _problems(found: dict[Path, list[Path]]) -> list[str]:
    """Return the problems of logs whose chains are not sound, and print them to standard error."""
    problems = [problem for name, files in found.items() if (problem := verify_log(name, files)[1])]
    for problem in problems:
        click.echo(f"warning: not verified: {problem}", err=True)
    return problems


@audit.command()
@_PATHS
@_window
@click.option("--all", "every", is_flag=True, help="Also print permitted calls, Grants and positions of the drone.")
@output_option
def show(paths: tuple[Path, ...], after: int | None, before: int | None, every: bool, output: str) -> None:
    """Print corrected and denied calls, takeovers and changes of control from the audit logs in PATHS.

    PATHS are as for `verify`. If the chain of a log is not sound, a warning is printed to standard error. JSON output has one
    object per line: the entry with the additional fields `node` and `log`.
    """
    found = find_logs(paths)
    _problems(found)
    for entry in entries(found, Window(after, before)):
        if not every and not is_decision(entry):
            continue
        if output == "json":
            fields = {key: value for key, value in entry.items() if key != "time_ns"}
            click.echo(json.dumps(fields, sort_keys=True, ensure_ascii=False))
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
    "--to", "target", type=click.Choice(["csv", "geojson", "kml", "mcap"]), required=True, help="Output format."
)
@click.option(
    "--file", type=click.Path(dir_okay=False, path_type=Path), help="Output file.  [default: standard output]"
)
@click.option(
    "--zones",
    multiple=True,
    type=click.Path(exists=True, path_type=Path),
    help="Manifests (file or directory) whose Zones, and zones and areas of Grants, are exported too. May be repeated.",
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
    """Export flight paths, verdicts, takeovers and zones from the audit logs in PATHS.

    PATHS are as for `verify`, for one or several drones. geojson and kml contain paths and decisions, csv has a row for each entry, and
    mcap contains everything for Foxglove. If the chain of a log is not sound, a warning is printed, and written to geojson, kml and mcap.
    """
    from fractus_cli.flight_export import WRITERS, Export  # noqa: PLC0415 - showing and verifying need no geometry

    found = find_logs(paths)
    given = Export(entries(found, Window(after, before)), _places(zones), _problems(found))
    if file is None:
        if target == "mcap" and sys.stdout.isatty():
            raise click.ClickException("mcap is a binary format; specify --file or redirect standard output")
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
        raise click.ClickException(f"--zones {', '.join(map(str, paths))}: the manifests contain no Zone and no Grant")
    return Places(shapes)


def _checkpoints(since: tuple[str, ...], ca: Path | None) -> dict[str, Checkpoint]:
    """Return the checkpoints by log name."""
    if not since:
        return {}
    # Imported here because verification without checkpoints does not need cryptography.
    from cryptography import x509  # noqa: PLC0415
    from fractus_runtime.audit_checkpoints import InvalidCheckpoint, parse_status_checkpoint, read_checkpoint  # noqa: PLC0415

    known: dict[str, Checkpoint] = {}
    try:
        authorities = x509.load_pem_x509_certificates(ca.read_bytes()) if ca is not None else []
    except ValueError:
        raise click.ClickException(f"--ca {ca}: contains no certificate") from None
    for given in since:
        try:
            checkpoint = parse_status_checkpoint(given) or read_checkpoint(Path(given).read_bytes(), authorities)
        except (OSError, InvalidCheckpoint) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise click.ClickException(f"--since {given}: {reason}") from None
        if checkpoint.log in known:
            raise click.ClickException(
                f"--since {given}: second checkpoint of {checkpoint.log}.jsonl; specify one for each log"
            )
        known[checkpoint.log] = checkpoint
    return known


def _judgement(name: Path, files: list[Path], checkpoint: Checkpoint | None) -> dict[str, Any]:
    finding, problem = verify_log(name, files, checkpoint.entry if checkpoint is not None else None)
    return {
        "log": str(name if name in files else files[0]), "files": [str(file) for file in files], "entries": finding.entries,
        "sound": not problem, "problem": problem, "removed": finding.before, "torn": finding.torn, "whole": name in files,
    }  # fmt: skip


def _check(name: Path, files: list[Path], checkpoint: Checkpoint | None) -> str:
    """Return a summary of a sound log.

    Raises:
        click.ClickException: The log is not sound.
    """
    finding, problem = verify_log(name, files, checkpoint.entry if checkpoint is not None else None)
    if problem:
        raise click.ClickException(problem)
    partial = name not in files
    details = [f"{finding.entries} entries, chain sound"]
    if len(files) > 1:
        details.append(f"{len(files)} files")
    if checkpoint is not None:
        signed = ""
        if checkpoint.node:
            unverified = "" if checkpoint.certified else "; its certificate was not verified (specify --ca)"
            signed = f" (checkpoint signed by {checkpoint.node}{unverified})"
        details.append(f"complete since entry {checkpoint.entry.sequence}{signed}")
    if finding.before:
        details.append(f"the first {finding.before} entries were removed to free space")
    if partial:
        details.append("part of a log: earlier and later entries were not verified")
    if finding.torn:
        details.append("the last line is incomplete (crash, or write in progress)")
    return f"{files[0] if partial else name}: {'; '.join(details)}"
