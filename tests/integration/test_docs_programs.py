"""What kubectl and helm themselves say to the commands of the pages, and a real API server to what they read and would change."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Iterator
from functools import cache

import pytest
from chart import KUBERNETES
from control_plane import ControlPlane
from docs_commands import ROOT, Command, every_command, has_placeholder
from fractus_cluster.binaries import ensure_binaries
from operator_world import World

pytestmark = pytest.mark.slow

COMMANDS = [command for command in every_command() if command.argv[0] in {"kubectl", "helm"} and len(command.argv) > 1]
KUBECTL = [command for command in COMMANDS if command.argv[0] == "kubectl" and command.argv[1] != "fractus"]
HELM = [command for command in COMMANDS if command.argv[0] == "helm"]
TWO_WORDS = {"get values", "create secret generic", "create clusterrolebinding", "auth can-i"}
READ, CHANGE = {"get", "api-resources"}, {"apply", "label", "taint", "delete", "annotate", "create"}
NOT_THERE = re.compile(r"NotFound|not found")
"""What a command is told that names an object which only a reader's cluster has."""

OF_THE_READER = ("fractus-ca.yaml", "fractus.yaml", "application.yaml", "low.yaml")
TIMEOUT_S = 60


def shown(command: Command) -> str:
    """The name of a test."""
    return command.shown


@cache
def program(name: str) -> str:
    return str(ensure_binaries((name,), report=print)[name])


def ran(*argv: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(argv, capture_output=True, text=True, timeout=TIMEOUT_S, check=False, cwd=ROOT)


@cache
def options_of(name: str, verb: str) -> frozenset[str]:
    """The options of a verb, and those of every verb, by the program's own help."""
    known: set[str] = set()
    asked = [(*verb.split(), "--help"), ("options",) if name == "kubectl" else ("--help",)]
    for arguments in asked:
        done = ran(program(name), *arguments)
        assert done.returncode == 0, f"{name} {verb}: {done.stderr}"
        for line in done.stdout.splitlines():
            if match := re.match(r"\s+(?:(-\w), )?(--[\w-]+)", line):
                known |= {word for word in match.groups() if word}
    assert len(known) > 10, f"{name} {verb} --help lists no options"
    return frozenset(known)


def verb_of(command: Command) -> str:
    words = [word for word, before in zip(command.argv[1:], command.argv, strict=False) if before not in {"-n"}]
    words = [word for word in words if not word.startswith("-")]
    long = next((verb for verb in TWO_WORDS if " ".join(words).startswith(verb)), "")
    return long or words[0]


def own_words(command: Command) -> Iterator[str]:
    """The words of a command, without those of a command that it starts on a node."""
    for word in command.argv[1:]:
        if word == "--":
            return
        yield word


# `kubectl fractus` is a plug-in of ours, which test_docs_commands.py parses.
@pytest.mark.parametrize("command", (*KUBECTL, *HELM), ids=shown)
def test_the_program_knows_the_verb_and_the_options(command: Command) -> None:
    known = options_of(command.argv[0], verb_of(command))
    unknown = [word for word in own_words(command) if word.startswith("-") and word.partition("=")[0] not in known]
    assert not unknown, f"{command.shown}: {command.argv[0]} has no {', '.join(unknown)}"


def test_the_charts_take_what_they_are_given(control_plane: ControlPlane, world: World) -> None:
    """Rendered with the nodes of an API server, of which the chart of the example chooses one."""
    del world
    asked = 0
    for command in HELM:
        verb = verb_of(command)
        if len(command.argv) < 4 or verb not in {"install", "upgrade"}:
            continue
        words = [word for word in command.argv[1:] if word not in {"--reuse-values", "--create-namespace"}]
        words = [os.devnull if word == "values.yaml" else word for word in words]
        words[words.index(verb)] = "template"
        more = [
            "--kubeconfig",
            str(control_plane.kubeconfig),
            "--dry-run=server",
            KUBERNETES,
            *(["--is-upgrade"] if verb == "upgrade" else []),
        ]
        done = ran(program("helm"), *words, *more)
        assert done.returncode == 0, f"{command.shown}: {done.stderr}"
        assert "kind:" in done.stdout
        asked += 1
    assert asked >= 5


@pytest.mark.usefixtures("chart")
def test_an_api_server_takes_what_is_typed(control_plane: ControlPlane, world: World) -> None:
    """Nothing is changed: what would change something is a dry run of the server."""
    del world
    kubectl = [program("kubectl"), "--kubeconfig", str(control_plane.kubeconfig)]
    refused, asked = [], 0
    for command in KUBECTL:
        verb = verb_of(command)
        words = ["drone-1" if word in {"NODE", "NAME", "DRONE"} else word for word in command.argv[1:]]
        complete = len([word for word in words if not word.startswith("-")]) > 1 and not any(
            map(has_placeholder, words)
        )
        if verb.partition(" ")[0] not in READ | CHANGE or not complete or any(word in OF_THE_READER for word in words):
            continue
        words = [word.removeprefix("../") for word in words]
        dry = ["--dry-run=server"] if verb.partition(" ")[0] in CHANGE else []
        done = ran(*kubectl, *words, *dry)
        asked += 1
        if command.in_sentence and "no name was specified" in done.stderr:
            continue
        if done.returncode and not NOT_THERE.search(done.stderr):
            refused.append(f"{command.shown}: {done.stderr.strip()}")
    assert not refused, "\n".join(refused)
    assert asked > 20
