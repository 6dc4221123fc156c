"""`fractus cp`: copies files of a component from its running pod, or from its PersistentVolumeClaim when no pod runs."""

from __future__ import annotations

import json
import re
import secrets
import shutil
import signal
import subprocess
import tarfile
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO, Any

import click
from fractus_core.api import API_VERSION
from fractus_core.api.names import CLASS_LABEL, shortened

from fractus_cli.output import printable

_READER_LIFETIME_S = 3600
"""Time after which Kubernetes ends a reader pod that was not deleted."""
_READER_READY_S = 120
_MAX_PADDING_BYTES = 2**20
"""Maximum length of the data after the end of an archive. tar fills its last 10 KiB."""
_USER = 10001
"""User and group of the pods of components, who own the files in their claims."""

Body = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Source:
    """Files of a component.

    Attributes:
        path: Absolute path in the container.
    """

    application: str
    component: str
    path: PurePosixPath

    def __str__(self) -> str:
        """Return APPLICATION/COMPONENT:PATH."""
        return f"{self.application}/{self.component}:{self.path}"


def _parse_source(context: click.Context, argument: click.Parameter, text: str) -> Source:
    """Parse APPLICATION/COMPONENT:PATH."""
    del context, argument
    match = re.fullmatch(r"([^/:]+)/([^/:]+):(/.*)", text)
    if match is None:
        raise click.BadParameter(
            f"{text!r} is not APPLICATION/COMPONENT:PATH with an absolute path, such as survey/Store:/data"
        )
    path = PurePosixPath(match[3])
    if ".." in path.parts:
        raise click.BadParameter(f"{text!r} contains '..'; specify the path without it")
    return Source(match[1], match[2], path)


@click.command()
@click.argument("source", callback=_parse_source, metavar="APPLICATION/COMPONENT:PATH")
@click.argument("destination", type=click.Path(path_type=Path))
@click.option("-n", "--namespace", default="default", show_default=True, help="Namespace of the Application.")
@click.option("--pod", help="Pod to copy from, if several pods of the component run.")
@click.option(
    "--image",
    help="Image of the pod that reads a claim; it must contain `sleep` and `tar`.  [default: image of the component]",
)
@click.option(
    "--kubeconfig",
    type=click.Path(exists=True, dir_okay=False),
    help="Kubeconfig of the cluster.  [default: KUBECONFIG or ~/.kube/config]",
)
def cp(
    *, source: Source, destination: Path, namespace: str, pod: str | None, image: str | None, kubeconfig: str | None
) -> None:
    """Copy a file or directory of a component to DESTINATION.

    If a pod of the component runs, its container needs `tar`. Otherwise, the files must be in a PersistentVolumeClaim of the
    component. A short-lived pod then reads the claim. Both need kubectl, and the user needs the role `edit` in the namespace.

    If DESTINATION is an existing directory, the files are copied into it. Only regular files and directories are copied.
    """
    kubectl = Kubectl(namespace, kubeconfig)
    application = kubectl.get("application.fractus.dev", source.application)
    component = _component(application, source)
    labels = f"fractus.dev/application={shortened(source.application, 63)},fractus.dev/component={source.component}"
    running = [body["metadata"]["name"] for body in kubectl.get("pods", "-l", labels)["items"] if _runs(body)]
    if pod is not None and pod not in running:
        raise click.ClickException(
            f"--pod {pod} is not a running pod of {source.component} (running: {_listed(running)})"
        )
    if pod is None and len(running) > 1:
        raise click.ClickException(
            f"{source.component} has several running pods; select one with --pod: {_listed(running)}"
        )
    with _interrupted_by_signals():
        if running:
            copied = _copy(kubectl, pod or running[0], source.path, destination)
        else:
            with _reader(kubectl, reader_pod(application, component, source, image)) as name:
                copied = _copy(kubectl, name, source.path, destination)
    click.echo(f"copied {copied} files from {source}")


@contextmanager
def _interrupted_by_signals() -> Iterator[None]:
    """Treat SIGTERM and SIGHUP as Ctrl+C, so that the command deletes its pod and its incomplete file. nohup ignores SIGHUP."""
    default = [s for s in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(s) == signal.SIG_DFL]
    for number in default:
        signal.signal(number, signal.default_int_handler)
    try:
        yield
    finally:
        for number in default:
            signal.signal(number, signal.SIG_DFL)


class Kubectl:
    """kubectl for one namespace."""

    def __init__(self, namespace: str, kubeconfig: str | None) -> None:
        program = shutil.which("kubectl")
        if program is None:
            raise click.ClickException("kubectl is not installed; install it, or add it to PATH")
        self._command = [program, "-n", namespace, *(["--kubeconfig", kubeconfig] if kubeconfig is not None else [])]

    def run(self, *arguments: str, stdin: str | None = None) -> str:
        """Run kubectl and return its standard output.

        Raises:
            ClickException: The command failed.
        """
        result = subprocess.run([*self._command, *arguments], input=stdin, capture_output=True, text=True, check=False)
        if result.returncode:
            raise click.ClickException(printable(result.stderr.strip().removeprefix("Error from server ")))
        return result.stdout

    def get(self, *arguments: str) -> Body:
        """Return an object or a list.

        Raises:
            ClickException: The object does not exist, or the cluster is not reachable.
        """
        body: Body = json.loads(self.run("get", *arguments, "-o", "json"))
        return body

    @contextmanager
    def reading(self, *arguments: str) -> Iterator[IO[bytes]]:
        """Run kubectl and yield its standard output as a stream.

        Raises:
            ClickException: The command failed, its archive is invalid, or data follows the archive.
        """
        with tempfile.TemporaryFile() as errors:
            with subprocess.Popen([*self._command, *arguments], stdout=subprocess.PIPE, stderr=errors) as process:
                assert process.stdout is not None
                failed = False
                try:
                    yield process.stdout
                    if len(process.stdout.read(_MAX_PADDING_BYTES + 1)) > _MAX_PADDING_BYTES:
                        raise click.ClickException("stopped: the pod sent data after the end of its archive")
                except (tarfile.TarError, ValueError):
                    failed = True
                except BaseException:
                    process.kill()
                    raise
            if process.returncode or failed:
                errors.seek(0)
                text = errors.read().decode(errors="replace").strip().splitlines()
                reason = "; ".join(text) or "the connection ended early, or the archive is invalid"
                raise click.ClickException(f"the files were not copied completely: {printable(reason)}")


def _component(application: Body, source: Source) -> Body:
    components: list[Body] = application["spec"]["components"]
    for component in components:
        if component["name"] == source.component:
            return component
    names = _listed([component["name"] for component in components])
    raise click.ClickException(f"{source.application} has no component {source.component} (components: {names})")


def _runs(pod: Body) -> bool:
    """Return True if a pod runs and is not being stopped."""
    ends = "deletionTimestamp" in pod["metadata"] or "activeDeadlineSeconds" in pod["spec"]
    return pod["status"].get("phase") == "Running" and not ends


def _listed(names: Sequence[str]) -> str:
    return ", ".join(sorted(names)) or "none"


def _copy(kubectl: Kubectl, pod: str, path: PurePosixPath, destination: Path) -> int:
    """Copy files from a running pod. Return their number."""
    name = path.name or "."
    command = ("exec", pod, "--", "tar", "-cf", "-", "-C", str(path.parent), f"./{path.name}")
    with kubectl.reading(*command) as stream:
        return extract(stream, name, destination / name if destination.is_dir() else destination)


def extract(stream: IO[bytes], name: str, target: Path) -> int:
    """Write the regular files and directories of an archive. The archive comes from a container, which may be malicious.

    Args:
        stream: The archive.
        name: First part of all paths in the archive.
        target: File or directory that replaces this part.

    Returns:
        Number of files.

    Raises:
        ClickException: The archive contains a path with NUL or outside of `name`, or a file cannot be written.
        TarError: The archive is incomplete.
        ValueError: A header of the archive is invalid.
    """
    copied = 0
    with tarfile.open(fileobj=stream, mode="r|") as archive:
        for member in archive:
            path = PurePosixPath(member.name)
            inside = path.parts[1:] if name != "." and path.parts[:1] == (name,) else path.parts
            outside = path.is_absolute() or ".." in inside or (name != "." and path.parts[:1] != (name,))
            if outside or "\0" in member.name:
                raise click.ClickException(
                    f"refused: the archive of the pod contains the path {printable(member.name)}"
                )
            file = target.joinpath(*inside)
            try:
                if member.isdir():
                    file.mkdir(parents=True, exist_ok=True)
                elif member.isreg():
                    _write(archive, member, file)
                    copied += 1
                else:
                    click.echo(
                        printable(f"warning: not copied, because it is not a regular file: {member.name}"), err=True
                    )
            except OSError as error:
                raise click.ClickException(f"cannot write {printable(str(file))}: {error.strerror or error}") from None
    return copied


def _write(archive: tarfile.TarFile, member: tarfile.TarInfo, file: Path) -> None:
    """Write a file. An incomplete file never has its final name."""
    content = archive.extractfile(member)
    assert content is not None
    scratch = file.with_name(f".fractus-cp-{secrets.token_hex(4)}")
    try:
        with scratch.open("xb") as out:
            shutil.copyfileobj(content, out)
        scratch.replace(file)
    finally:
        scratch.unlink(missing_ok=True)


def reader_pod(application: Body, component: Body, source: Source, image: str | None) -> Body:
    """Return a pod that mounts the claim with the files of a component, without write access.

    It is as restricted as the pods of components, so it may run on drones and edge nodes, where claims of local storage are.
    The Application owns the pod: if the command is killed, the pod is deleted with the Application.

    Raises:
        ClickException: The files are in no claim.
    """
    container = component["container"]
    mounts = {PurePosixPath(v["mountPath"]): v for v in container.get("volumes") or () if "claim" in v}
    mount = next((p for p in (source.path, *source.path.parents) if p in mounts), None)
    if mount is None:
        paths = _listed([str(path) for path in mounts])
        raise click.ClickException(
            f"no pod of {source.component} runs, and {source.path} is in no PersistentVolumeClaim of the component (claims: {paths});"
            " other files are deleted with the pod: write results to a claim, or copy them before the pod ends (spec.afterFlight)"
        )
    reader = {
        "name": "reader",
        "image": image or container["image"],
        "command": ["sleep", str(_READER_LIFETIME_S)],
        "resources": {"requests": {"cpu": "10m", "memory": "16Mi"}, "limits": {"cpu": "500m", "memory": "128Mi"}},
        "securityContext": {
            "allowPrivilegeEscalation": False,
            "capabilities": {"drop": ["ALL"]},
            "readOnlyRootFilesystem": True,
        },
        "volumeMounts": [{"name": "results", "mountPath": str(mount), "readOnly": True}],
    }
    spec = {
        "restartPolicy": "Never",
        "activeDeadlineSeconds": _READER_LIFETIME_S,
        "terminationGracePeriodSeconds": 1,
        "automountServiceAccountToken": False,
        "enableServiceLinks": False,
        "securityContext": {
            "runAsNonRoot": True,
            "runAsUser": _USER,
            "runAsGroup": _USER,
            "fsGroup": _USER,
            "fsGroupChangePolicy": "OnRootMismatch",
            "seccompProfile": {"type": "RuntimeDefault"},
        },
        "tolerations": [{"key": CLASS_LABEL, "operator": "Exists"}],
        "containers": [reader],
        "volumes": [{"name": "results", "persistentVolumeClaim": {"claimName": mounts[mount]["claim"]}}],
    }
    owner = {"apiVersion": API_VERSION, "kind": "Application", "name": source.application}
    metadata = {
        "name": f"fractus-cp-{secrets.token_hex(4)}",
        "labels": {"app.kubernetes.io/name": "fractus-cp"},
        "ownerReferences": [{**owner, "uid": application["metadata"]["uid"]}],
    }
    return {"apiVersion": "v1", "kind": "Pod", "metadata": metadata, "spec": spec}


@contextmanager
def _reader(kubectl: Kubectl, body: Body) -> Iterator[str]:
    """Run a reader pod, and delete it at the end. Yield its name when it runs."""
    name = body["metadata"]["name"]
    try:
        kubectl.run("create", "-f", "-", stdin=json.dumps(body))
        try:
            kubectl.run("wait", f"pod/{name}", "--for=condition=Ready", f"--timeout={_READER_READY_S}s")
        except click.ClickException as error:
            problem = reader_problem(kubectl.get("pod", name)) or error.message
            raise click.ClickException(
                f"the claim cannot be read, because its reader pod does not start: {problem}; if the image is the problem,"
                " specify another one with --image"
            ) from None
        yield name
    finally:
        kubectl.run("delete", "pod", name, "--ignore-not-found", "--wait=false")


def reader_problem(pod: Body) -> str:
    """Return why a pod does not start, or an empty string."""
    status = pod.get("status") or {}
    for container in status.get("containerStatuses") or ():
        for state in (container.get("state") or {}).values():
            if state.get("reason") or state.get("message"):
                return printable(": ".join(filter(None, (state.get("reason"), state.get("message")))))
    waiting = [
        c.get("message")
        for c in status.get("conditions") or ()
        if c["type"] == "PodScheduled" and c["status"] == "False"
    ]
    return printable(waiting[0] or "") if waiting else ""
