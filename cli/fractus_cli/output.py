"""The option that every command with something to list has, so that programs read it as well as people."""

from __future__ import annotations

import click

output_option = click.option(
    "-o", "--output", type=click.Choice(["text", "json"]), default="text", help="text for people, json for programs."
)
