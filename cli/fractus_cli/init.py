"""`fractus init`: the files of a new application."""

from __future__ import annotations

import importlib.resources
import json
from pathlib import Path
from string import Template

import click
from fractus_core.api.model import Metadata
from pydantic import ValidationError

from fractus_cli.schema import manifest_schema

NEXT_STEPS = """\
Next steps in {directory}:
  fractus plan -f application.yaml -f place.yaml   check the manifests
  fractus experiment run flight.yaml               fly on this machine
  pytest                                           fly and check the result
"""


@click.command()
@click.argument("name")
@click.option(
    "--directory",
    type=click.Path(file_okay=False, path_type=Path),
    help="New or empty directory for the files. Default: NAME.",
)
def init(name: str, directory: Path | None) -> None:
    """Write the files of a new application NAME: manifests, program, Dockerfile, simulated flight and test."""
    try:
        Metadata(name=name)
    except ValidationError:
        raise click.ClickException(
            f"NAME {name!r} must consist of lowercase letters, digits and hyphens, for example traffic-survey"
        ) from None
    target = directory or Path(name)
    if target.exists() and any(target.iterdir()):
        raise click.ClickException(f"{target} is not empty; specify another directory with --directory")
    target.mkdir(parents=True, exist_ok=True)
    for template in importlib.resources.files("fractus_cli").joinpath("new_application").iterdir():
        text = Template(template.read_text(encoding="utf-8")).substitute(name=name)
        (target / template.name.removesuffix(".template")).write_text(text, encoding="utf-8")
    (target / "fractus.schema.json").write_text(json.dumps(manifest_schema(), indent=2) + "\n", encoding="utf-8")
    click.echo(NEXT_STEPS.format(directory=target), nl=False)
