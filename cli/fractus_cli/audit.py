"""`fractus audit`: checks the hash chain of audit logs."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import click
from fractus_services.chain import lines_of, logs, verify


@click.group()
def audit() -> None:
    """Audit logs of node services."""


@audit.command("verify")
@click.argument("paths", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
def verify_command(paths: tuple[Path, ...]) -> None:
    """Check that no entry of the audit logs in PATHS was changed, removed or inserted.

    PATHS are directories, logs (with their segments), or single segments.
    """
    found = logs(paths)
    if not found:
        raise click.ClickException(f"{', '.join(map(str, paths))}: there is no audit log (*.jsonl)")
    for name, files in found.items():
        _check(name, files)


def _check(name: Path, files: list[Path]) -> None:
    begins: list[tuple[int, Path]] = []

    def lines() -> Iterable[bytes]:
        for total, (path, number, line) in enumerate(lines_of(files)):
            if number == 1:
                begins.append((total, path))
            yield line

    part = name not in files
    finding = verify(lines(), part)
    if finding.problem:
        before, path = next(begin for begin in reversed(begins) if begin[0] < finding.line)
        raise click.ClickException(f"{path}: line {finding.line - before} {finding.problem}")
    said = [f"{finding.entries} entries, chain sound"]
    if len(files) > 1:
        said.append(f"{len(files)} files")
    if finding.before:
        said.append(f"the {finding.before} before were removed to make room")
    if part:
        said.append("a part of the log, so what came before and after is not judged")
    if finding.torn:
        said.append("the last line is incomplete (a crash, or it is being written)")
    click.echo(f"{files[0] if part else name}: {'; '.join(said)}")
