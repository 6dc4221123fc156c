"""Output format option and escaping of terminal output."""

from __future__ import annotations

import click

output_option = click.option(
    "-o", "--output", type=click.Choice(["text", "json"]), default="text", help="Output format."
)


def printable(line: str) -> str:
    """Escape non-printable characters of a line for a terminal.

    Names, messages and error texts come from other users. They must not move the cursor, hide text or break lines.
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)
