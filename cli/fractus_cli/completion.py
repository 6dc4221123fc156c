"""`fractus completion`: completion scripts of shells."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class


@click.command()
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion(shell: str) -> None:
    """Print the script that completes commands and options in SHELL.

    For example in ~/.bashrc: eval "$(fractus completion bash)"
    """
    kind = get_completion_class(shell)
    root = click.get_current_context().find_root().command
    if kind is None:
        raise click.ClickException(f"click does not support the shell {shell}")
    click.echo(kind(root, {}, "fractus", "_FRACTUS_COMPLETE").source())
