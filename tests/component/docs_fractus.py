"""What `fractus` says to a command of the pages, without a cluster, hardware or a network.

A check raises `AssertionError` with a sentence: what is wrong, and where it stands.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from enum import Enum

import click
from docs_commands import SUBSTITUTED, Command, has_placeholder
from fractus_cli.main import fractus, run

NOT_RUN = {
    "camera serve": "serves until it is stopped",
    "camera-world": "serves until it is stopped",
    "cluster": "makes or changes a cluster",
    "doctor": "asks a cluster",
    "explain": "asks a cluster; its tests do",
    "forward": "follows a drone until it is stopped",
    "images": "builds images",
    "mobility serve": "serves until it is stopped; the tutorial's test does",
    "status": "asks a cluster; its tests do",
    "telemetry": "follows a drone until it is stopped",
    "vehicle": "flies until it is stopped; the tutorial's test does",
    "view": "serves until it is stopped",
}
"""Commands of `fractus` that are only parsed. All others of blocks are carried out as they stand, in one directory a page."""


def need(truth: object, command: Command, what: str) -> None:
    """Fail with a sentence unless something holds."""
    assert truth, f"{command.shown}: {what}"


def check_fractus(command: Command, click_command: click.Command = fractus, words: Sequence[str] | None = None) -> None:
    """Parse it as the program does: every option, every value that is no placeholder, every file that it reads."""
    rest = [here(word) for word in (command.argv[1:] if words is None else words)]
    # With its settings, as the program has it: a command remembers the names of its help option from then on.
    context = click.Context(click_command, info_name=click_command.name, **click_command.context_settings)
    while True:
        if any(has_placeholder(word) for word in rest[:1]) and isinstance(click_command, click.Group):
            return
        values, left = _parsed(command, click_command, context, rest)
        if values.get("help") or not isinstance(click_command, click.Group) or not left:
            break
        found = click_command.get_command(context, left[0])
        need(found is not None, command, f"there is no command {left[0]}")
        context = click.Context(found, parent=context, info_name=left[0])
        click_command, rest = found, left[1:]
    if isinstance(click_command, click.Group):
        need(command.in_sentence or values.get("help"), command, "it lacks a subcommand")
        return
    need(not left, command, f"it takes no {' '.join(left)}")
    for parameter in click_command.params:
        given = values.get(parameter.name)
        if given is None or given == ():
            need(command.in_sentence or not parameter.required, command, f"it lacks {parameter.human_readable_name}")
        elif not any(has_placeholder(str(one)) or one == SUBSTITUTED for one in _flat(given)):
            _convert(command, context, parameter, given)


def _parsed(
    command: Command, of: click.Command, context: click.Context, words: list[str]
) -> tuple[dict[str, object], list[str]]:
    if command.in_sentence and words and words[-1].startswith("-") and not isinstance(of, click.Group):
        # A sentence names an option without saying a value.
        options = {name: one for one in of.params for name in (*one.opts, *one.secondary_opts)}
        need(words[-1] in {*options, "--help", "-h"}, command, f"there is no option {words[-1]}")
        option = options.get(words[-1])
        if isinstance(option, click.Option) and not option.is_flag:
            words = words[:-1]
    try:
        values, left, _order = of.make_parser(context).parse_args(list(words))
    except click.UsageError as error:
        raise AssertionError(f"{command.shown}: {error.format_message()}") from None
    # click marks arguments that are not given by a member of an Enum.
    return {name: value for name, value in values.items() if not isinstance(value, Enum)}, left


def _flat(given: object) -> Iterator[object]:
    if isinstance(given, list | tuple):
        for one in given:
            yield from _flat(one)
    else:
        yield given


def _convert(command: Command, context: click.Context, parameter: click.Parameter, given: object) -> None:
    if isinstance(parameter, click.Option) and (parameter.is_flag or parameter.count):
        return
    try:
        parameter.process_value(context, given)
    except click.UsageError as error:
        raise AssertionError(f"{command.shown}: {error.format_message()}") from None


def runnable(command: Command) -> bool:
    """Whether it is carried out here."""
    said = " ".join(command.argv[1:])
    words = [word for word in command.argv if has_placeholder(word) or SUBSTITUTED in word]
    listed = [name for name in NOT_RUN if said == name or said.startswith(f"{name} ")]
    return command.argv[0] == "fractus" and not (command.in_sentence or words or listed)


def here(word: str) -> str:
    """A path on a node, as it is where commands are typed here."""
    return word.replace("/var/lib/fractus", "node")


def carry_out(command: Command, said: Callable[[], tuple[str, str]]) -> None:
    """Run it; what the page says that it prints, it prints.

    Args:
        command: of `fractus`.
        said: what was written to standard output and standard error.
    """
    try:
        code = run([here(word) for word in command.argv[1:]])
    except SystemExit as ended:
        code = int(ended.code or 0)
    text, problem = said()
    need(code == 0, command, f"exit code {code}: {text[-500:]}{problem}")
    printed = {" ".join(line.split()) for line in text.splitlines()}
    for line in command.output:
        need(line.strip() == "..." or " ".join(line.split()) in printed, command, f"does not print: {line}\n{text}")
