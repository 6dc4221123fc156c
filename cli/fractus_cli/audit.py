"""`fractus audit`: checks the hash chain of audit logs."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import click
from fractus_storage.chain import lines_of, logs, verify

if TYPE_CHECKING:
    from fractus_storage.checkpoints import Checkpoint

_FILE = click.Path(exists=True, dir_okay=False, path_type=Path)


@click.group()
def audit() -> None:
    """Audit logs of node services."""


@audit.command("verify")
@click.argument("paths", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option(
    "--since",
    multiple=True,
    help="A checkpoint that was kept elsewhere: a copy of the log's .checkpoint file, or LOG:NUMBER:HASH as the node's status"
    " has it. Every entry since must be there.",
)
@click.option("--ca", type=_FILE, help="ca.crt that the certificates in checkpoints must be of.")
def verify_command(paths: tuple[Path, ...], since: tuple[str, ...], ca: Path | None) -> None:
    """Check that no entry of the audit logs in PATHS was changed, removed or inserted.

    PATHS are directories, logs (with their segments), or single segments.
    """
    found = logs(paths)
    if not found:
        raise click.ClickException(f"{', '.join(map(str, paths))}: there is no audit log (*.jsonl)")
    known = _checkpoints(since, ca)
    for absent in known.keys() - {log.stem for log, files in found.items() if log in files}:
        raise click.ClickException(f"--since: the checkpoint is of {absent}.jsonl; give that log, or its directory")
    for stem in known:
        same = [str(log) for log, files in found.items() if log in files and log.stem == stem]
        if len(same) > 1:
            raise click.ClickException(
                f"--since: the checkpoint is of {stem}.jsonl, and there are several: {', '.join(same)}; give one at a time"
            )
    for name, files in found.items():
        _check(name, files, known.get(name.stem))


def _checkpoints(since: tuple[str, ...], ca: Path | None) -> dict[str, Checkpoint]:
    """The checkpoints by the names of their logs."""
    if not since:
        return {}
    # Imported here: what only verifies chains needs no cryptography.
    from cryptography import x509  # noqa: PLC0415
    from fractus_storage.checkpoints import InvalidCheckpoint, noted, read_checkpoint  # noqa: PLC0415

    known: dict[str, Checkpoint] = {}
    try:
        authorities = x509.load_pem_x509_certificates(ca.read_bytes()) if ca is not None else []
    except ValueError:
        raise click.ClickException(f"--ca {ca}: holds no certificate") from None
    for given in since:
        try:
            checkpoint = noted(given) or read_checkpoint(Path(given).read_bytes(), authorities)
        except (OSError, InvalidCheckpoint) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise click.ClickException(f"--since {given}: {reason}") from None
        if checkpoint.log in known:
            raise click.ClickException(
                f"--since {given}: is the second of {checkpoint.log}.jsonl; give one for each log"
            )
        known[checkpoint.log] = checkpoint
    return known


def _check(name: Path, files: list[Path], checkpoint: Checkpoint | None) -> None:
    begins: list[tuple[int, Path]] = [(0, files[0])]

    def lines() -> Iterable[bytes]:
        for total, (path, number, line) in enumerate(lines_of(files)):
            if number == 1 and total:
                begins.append((total, path))
            yield line

    part = name not in files
    try:
        finding = verify(lines(), part, checkpoint.link if checkpoint is not None else None)
    except FileNotFoundError as error:
        raise click.ClickException(f"{error.filename}: is missing; the log is not complete without it") from None
    if finding.problem:
        before, path = next(begin for begin in reversed(begins) if begin[0] < max(finding.line, 1))
        raise click.ClickException(f"{path}: line {finding.line - before} {finding.problem}")
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
    click.echo(f"{files[0] if part else name}: {'; '.join(said)}")
