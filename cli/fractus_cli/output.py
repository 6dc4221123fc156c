"""The option that every command with something to list has, so that programs read it as well as people."""

from __future__ import annotations

import click

output_option = click.option(
    "-o", "--output", type=click.Choice(["text", "json"]), default="text", help="text for people, json for programs."
)


def printable(line: str) -> str:
    """A line for a terminal: what is no character to read is escaped.

    Names, messages and last words of components come from others: they must not move the cursor, hide lines, or end them.
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)
