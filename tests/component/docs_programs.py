"""What programs other than `fractus` would say to a command of the pages, as far as files tell.

A check raises `AssertionError` with a sentence: what is wrong, and where it stands.
"""

from __future__ import annotations

import ast
import functools
import importlib
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import click
import yaml
from docs_commands import ROOT, Command, has_placeholder
from docs_fractus import check_fractus, need
from fractus_cli.main import fractus
from fractus_cli.manifests import BadManifest, read_manifests
from fractus_core.api import KINDS

OF_KUBERNETES = {
    "clusterrole", "clusterrolebinding", "configmap", "crd", "csr", "daemonset", "deploy", "events", "job", "lease", "namespace", "node", "nodes",
    "pod", "pods", "role", "rolebinding", "secret", "service", "serviceaccount", "validatingadmissionpolicybindings",
}  # fmt: skip
OURS = {name for kind in KINDS for name in (kind.PLURAL, kind.KIND.lower(), kind.SHORT)} | {"fractus"}
OF_THE_READER = {"fractus-ca.yaml", "fractus.yaml"}
"""Manifests that a page has the reader write by kubectl itself."""

KINDS_FIRST = {"annotate", "delete", "describe", "exec", "get", "label", "logs", "port-forward", "taint", "wait"}
WITH_VALUES = {
    "-n", "-f", "-l", "-o", "-c", "--namespace", "--filename", "--selector", "--output", "--field-selector", "--raw", "--for", "--tail",
    "--timeout", "--from-literal", "--api-group", "--set",
}  # fmt: skip
"""Options of kubectl and helm that take a value; whether there are such options is asked of kubectl itself (tests/integration)."""


# make, docker, python, pytest, pip

MAKEFILE = (ROOT / "Makefile").read_text()
DOCKERFILE = (ROOT / "Dockerfile").read_text()


def check_make(command: Command, folder: Path) -> None:
    """The target exists, and something reads its variables."""
    del folder
    words = list(command.argv[1:])
    if words[0] == "-C":
        words = words[2:]
    targets = re.findall(r"^([a-z][a-z0-9-]*):", MAKEFILE, re.MULTILINE)
    for word in words:
        name, is_set, _value = word.partition("=")
        if is_set:
            need(
                re.search(rf"\$\(or \$\({name}\)|\$\({name}\)|\$\$\{{{name}[:}}]", MAKEFILE),
                command,
                f"no {name} in the Makefile",
            )
        else:
            need(name in targets, command, f"the Makefile has no target {name}")
    for variable in command.variables:
        _check_variable(command, variable.partition("=")[0])


def check_image_build(command: Command, folder: Path) -> None:
    """The stage and the arguments exist; the context is a directory with a Dockerfile."""
    argv = command.argv[1:] if command.argv[1] == "buildx" else command.argv
    need(argv[1] in {"build", "save"}, command, "only build and save are known")
    words, context = iter(argv[2:]), None
    for word in words:
        if word == "--target":
            target = next(words)
            need(
                has_placeholder(target) or re.search(rf"^FROM .* AS {target}$", DOCKERFILE, re.MULTILINE),
                command,
                f"no stage {target}",
            )
        elif word == "--build-arg":
            name = next(words).partition("=")[0]
            need(re.search(rf"^ARG {name}\b", DOCKERFILE, re.MULTILINE), command, f"no argument {name}")
        elif word in {"-t", "--tag", "--output", "--platform"}:
            need(re.fullmatch(r"[\w./:=,-]+", next(words)), command, f"{word} has no name")
        else:
            need(not word.startswith("-"), command, f"{word} is not known to this test")
            context = word
    if argv[1] == "build":
        need(
            context is not None and (folder / context / "Dockerfile").is_file(),
            command,
            "its directory has no Dockerfile",
        )


def check_python(command: Command, folder: Path) -> None:
    """The file exists and knows the options; a module is parsed like `fractus`."""
    words = list(command.argv[1:])
    if words[0] == "-m":
        module = importlib.import_module(f"{words[1]}.__main__")
        entry = next(one for one in vars(module).values() if isinstance(one, click.Command))
        check_fractus(command, entry, words[2:])
        return
    _check_script(command, folder, words)


def check_script(command: Command, folder: Path) -> None:
    """A benchmark that is named by its file."""
    _check_script(command, folder, list(command.argv))


def _check_script(command: Command, folder: Path, words: list[str]) -> None:
    file = next((path for path in (folder / words[0], ROOT / words[0]) if path.is_file()), None)
    need(file is not None, command, f"there is no {words[0]}")
    known = {
        argument.value
        for call in ast.walk(ast.parse(file.read_text()))
        if isinstance(call, ast.Call)
        and isinstance(call.func, ast.Attribute)
        and call.func.attr in {"add_argument", "option"}
        for argument in call.args
        if isinstance(argument, ast.Constant)
    }
    for word in words[1:]:
        need(not word.startswith("-") or word.partition("=")[0] in known, command, f"{words[0]} has no option {word}")
    for variable in command.variables:
        _check_variable(command, variable.partition("=")[0])


def check_uv(command: Command, folder: Path) -> None:
    """`uv run` runs a program of the environment."""
    need(command.argv[1] == "run", command, "only `uv run` is known")
    inner = Command(command.page, command.line, command.argv[2:], in_sentence=command.in_sentence, text=command.text)
    check(inner, folder)


def check_pytest(command: Command, folder: Path) -> None:
    """The files exist, and have tests of that name."""
    del folder
    words = list(command.argv[1:])
    paths = [ROOT / word for word in words if "/" in word]
    need(paths and all(path.exists() for path in paths), command, "there is no such file")
    if "-k" in words:
        name = words[words.index("-k") + 1]
        tests = [test for path in paths for test in re.findall(r"def (test_\w+)", path.read_text())]
        need(any(name in test for test in tests), command, f"there is no test of {name}")
    for variable in command.variables:
        _check_variable(command, variable.partition("=")[0])


def check_pip(command: Command, folder: Path) -> None:
    """Extras exist."""
    del folder
    extras = re.search(
        r"\[project.optional-dependencies\]\n(.*?)\n\[", (ROOT / "pyproject.toml").read_text(), re.DOTALL
    )
    assert extras is not None
    asked = re.fullmatch(r"(?:\.|fractus-drones)\[(.*)\]", command.argv[-1])
    need(command.argv[1] == "install" and asked, command, "only our own extras are known")
    for name in asked[1].split(","):
        need(re.search(rf"^{name} = ", extras[1], re.MULTILINE), command, f"there is no extra {name}")


def check_export(command: Command, folder: Path) -> None:
    """Something reads the variables."""
    del folder
    for word in command.argv[1:]:
        _check_variable(command, word.partition("=")[0])


def _check_variable(command: Command, name: str) -> None:
    need(name in _readers(), command, f"nothing reads {name}")


@functools.cache
def _readers() -> str:
    folders = ("sdk", "cli", "services", "agent", "operator", "tests/e2e")
    return "".join(file.read_text() for folder in folders for file in (ROOT / folder).rglob("*.py")) + MAKEFILE


# kubectl, helm


def check_kubectl(command: Command, folder: Path) -> None:
    """Kinds are ours or Kubernetes' own, and files are manifests. Its options: tests/integration/test_docs_programs.py."""
    words = operands(command.argv[1:])
    need(words, command, "it lacks a verb")
    verb, *rest = words
    if verb == "fractus":
        check_fractus(command, fractus, command.argv[2:])
        return
    if verb in KINDS_FIRST and rest and not (verb in {"exec", "logs", "port-forward"} and "/" not in rest[0]):
        for kind in rest[0].split(","):
            name = kind.partition("/")[0].removesuffix(".fractus.dev")
            need(
                name in OURS | OF_KUBERNETES,
                command,
                f"{name} is no kind of ours, nor one of Kubernetes' that this test knows",
            )
    for name in files_of(command.argv):
        if name not in OF_THE_READER:
            try:
                need(read_manifests([folder / name]).found, command, f"there is no object of ours in {name}")
            except BadManifest as error:
                raise AssertionError(f"{command.shown}: {error}") from None


def files_of(argv: Sequence[str]) -> list[str]:
    """What -f names."""
    return [argv[i + 1] for i, word in enumerate(argv[:-1]) if word in {"-f", "--filename"} and "logs" not in argv]


def operands(words: Sequence[str]) -> list[str]:
    """What is neither an option nor its value."""
    found, after = [], ""
    for word in words:
        if word == "--":
            break
        if not word.startswith("-") and after not in WITH_VALUES:
            found.append(word)
        after = word if word.startswith("-") else ""
    return found


def check_helm(command: Command, folder: Path) -> None:
    """The chart exists and knows the values. Whether they fit it: tests/integration/test_docs_programs.py."""
    del folder
    words = operands(command.argv[1:])
    need(
        words and words[0] in {"get", "install", "upgrade", "uninstall", "rollback", "template", "test"},
        command,
        "this verb is not known to this test",
    )
    if words[0] in {"install", "upgrade"} and len(words) > 1:
        need(len(words) == 3, command, "it takes a release and a chart")
        chart = ROOT / words[2]
        need((chart / "Chart.yaml").is_file(), command, f"there is no chart {words[2]}")
        values = yaml.safe_load((chart / "values.yaml").read_text())
        for i, word in enumerate(command.argv):
            if word == "--set":
                path = command.argv[i + 1].partition("=")[0].split(".")
                need(_has(values, path), command, f"the chart has no value {'.'.join(path)}")


def _has(values: object, path: Sequence[str]) -> bool:
    return not path or (isinstance(values, dict) and path[0] in values and _has(values[path[0]], path[1:]))


CHECKS: dict[str, Callable[[Command, Path], None]] = {
    "fractus": lambda command, _folder: check_fractus(command),
    "kubectl": check_kubectl,
    "helm": check_helm,
    "make": check_make,
    "docker": check_image_build,
    "buildah": check_image_build,
    "python": check_python,
    "uv": check_uv,
    "pytest": check_pytest,
    "pip": check_pip,
    "export": check_export,
}


def program_of(command: Command) -> str:
    """The name of what it starts."""
    return command.argv[0].rpartition("/")[2]


def check(command: Command, folder: Path) -> bool:
    """Check a command; whether there is a check for its program."""
    found = CHECKS.get(program_of(command), check_script if command.argv[0].startswith("bench/") else None)
    if found is not None:
        found(command, folder)
    return found is not None
