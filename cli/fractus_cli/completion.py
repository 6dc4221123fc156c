"""`fractus completion`: what a shell sources to complete commands and options."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class


@click.command()
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion(shell: str) -> None:
    """Print what SHELL sources to complete this command.

    For instance in ~/.bashrc: eval "$(fractus completion bash)"
    """
    kind = get_completion_class(shell)
    root = click.get_current_context().find_root().command
    if kind is None:
        raise click.ClickException(f"{shell} is not known to click")
    click.echo(kind(root, {}, "fractus", "_FRACTUS_COMPLETE").source())
