"""Roles of the chart on a real API server: read and write access to each kind, alone and aggregated."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml
from chart import CHARTS, path_of, render
from control_plane import wait_for
from docs_pages import ROOT, shell_lines
from docs_shell import Shell
from operator_world import World

Body = dict[str, Any]

NAMES = [yaml.safe_load(path.read_text())["spec"]["names"] for path in (CHARTS.parent / "crds").glob("*.yaml")]
KINDS = {names["singular"]: names["plural"] for names in NAMES}
WRITTEN_BY_THE_OPERATOR = {"deploymentplan", "grant", "nodegrants", "directlink"}
WRITTEN_BY_USERS = {"application", "flightplan"}
WRITTEN_BY_AUTHORITIES = set(KINDS) - WRITTEN_BY_THE_OPERATOR - WRITTEN_BY_USERS

READ = ("get", "list", "watch")
WRITE = ("create", "update", "patch", "delete")
ALL = ("deletecollection",)


@cache
def chart_roles() -> dict[str, Body]:
    """Return the ClusterRoles for users that the chart contains, by name."""
    names = {f"fractus-{kind}-{role}" for kind in KINDS for role in ("viewer", "editor", "admin")}
    return {body["metadata"]["name"]: body for body in render() if body["metadata"]["name"] in names}


@pytest.fixture(scope="module")
def roles(control_plane: Any) -> Iterator[World]:
    """A control plane with the roles. Kubernetes has added their rules to the built-in roles."""
    world = World(control_plane)
    for body in chart_roles().values():
        world.api.apply(path_of(body), body)
    for role in ("view", "edit", "admin"):
        with bound(world, role, f"t-settled-{role}"):
            wait_for(lambda role=role: aggregated(world, role), f"the built-in role {role} to be aggregated")
    yield world
    for body in chart_roles().values():
        world.api.delete(path_of(body))


def aggregated(world: World, role: str) -> bool:
    """Return True if Kubernetes has added the rules of the chart to a built-in role that is bound to a group."""
    verbs = READ if role == "view" else (*READ, *WRITE, *ALL)
    return all(may(world, f"t-settled-{role}", "get", kind) for kind in KINDS.values()) and all(
        may(world, f"t-settled-{role}", verb, KINDS[kind]) for verb in verbs for kind in WRITTEN_BY_USERS
    )


@contextmanager
def bound(world: World, role: str, group: str) -> Iterator[None]:
    """Bind a ClusterRole to a group in the whole cluster."""
    body = {
        "apiVersion": "rbac.authorization.k8s.io/v1",
        "kind": "ClusterRoleBinding",
        "metadata": {"name": group},
        "roleRef": {"apiGroup": "rbac.authorization.k8s.io", "kind": "ClusterRole", "name": role},
        "subjects": [{"apiGroup": "rbac.authorization.k8s.io", "kind": "Group", "name": group}],
    }
    world.api.apply(path_of(body), body)
    try:
        yield
    finally:
        world.api.delete(path_of(body))


def may(world: World, group: str, verb: str, plural: str, subresource: str = "") -> bool:
    """Return True if the API server permits a request of the group."""
    attributes = {"group": "fractus.dev", "resource": plural, "verb": verb, "subresource": subresource}
    review = {
        "apiVersion": "authorization.k8s.io/v1",
        "kind": "SubjectAccessReview",
        "spec": {"user": "someone", "groups": [group], "resourceAttributes": attributes},
    }
    return bool(
        world.api.call("POST", "/apis/authorization.k8s.io/v1/subjectaccessreviews", review)["status"]["allowed"]
    )


def allowed(world: World, role: str) -> set[tuple[str, str]]:
    """Return the verbs and kinds that a role permits."""
    group = f"t-{role}"
    with bound(world, role, group):
        # The authorizer receives bindings through a watch, with a delay.
        wait_for(lambda: any(may(world, group, "get", kind) for kind in KINDS.values()), f"{role} to be in force")
        permitted = {(v, kind) for kind in KINDS for v in (*READ, *WRITE, *ALL) if may(world, group, v, KINDS[kind])}
        assert not any(may(world, group, verb, kind, "status") for verb in WRITE for kind in KINDS.values())
    return permitted


def test_every_kind_has_viewer_editor_and_admin_roles() -> None:
    every = {f"fractus-{kind}-viewer" for kind in KINDS}
    assert set(chart_roles()) == every | {
        f"fractus-{kind}-{role}" for kind in set(KINDS) - WRITTEN_BY_THE_OPERATOR for role in ("editor", "admin")
    }


@pytest.mark.parametrize("kind", KINDS)
def test_role_permits_only_its_kind(roles: World, kind: str) -> None:
    assert allowed(roles, f"fractus-{kind}-viewer") == {(verb, kind) for verb in READ}
    if kind not in WRITTEN_BY_THE_OPERATOR:
        more = ALL if kind in WRITTEN_BY_USERS else ()
        assert allowed(roles, f"fractus-{kind}-editor") == {(verb, kind) for verb in (*READ, *WRITE, *more)}
        assert allowed(roles, f"fractus-{kind}-admin") == {(verb, kind) for verb in (*READ, *WRITE, *ALL)}


def test_builtin_roles_read_all_kinds_and_write_those_of_users(roles: World) -> None:
    read = {(verb, kind) for verb in READ for kind in KINDS}
    write = {(verb, kind) for verb in (*WRITE, *ALL) for kind in WRITTEN_BY_USERS}
    assert allowed(roles, "view") == read
    assert allowed(roles, "edit") == read | write
    assert allowed(roles, "admin") == read | write
    assert {kind for _, kind in write} & WRITTEN_BY_AUTHORITIES == set()


PAGE = "docs/roles.md"


def test_roles_page_lists_every_kind() -> None:
    rows = re.findall(r"^\| (`\w+`.*?) \| yes \| (yes|no).*? \|", (ROOT / PAGE).read_text(), re.MULTILINE)
    documented = {kind: writes == "yes" for kinds, writes in rows for kind in re.findall(r"`(\w+)`", kinds)}
    assert documented == {kind: kind not in WRITTEN_BY_THE_OPERATOR for kind in KINDS}


def test_documented_commands_permit_zones_and_policies(roles: World, tmp_path: Path) -> None:
    shell = Shell(tmp_path, roles.plane)
    lines = shell_lines(PAGE)
    for line in lines:
        shell.type(line)
    try:
        for request, expected in (
            ("create zones", "yes"),
            ("patch policies.fractus.dev", "yes"),
            ("create drones", "no"),
        ):
            line = f"kubectl auth can-i {request} --as=anna --as-group=aviation || true"
            wait_for(lambda line=line, expected=expected: shell.type(line).split() == [expected], request)
    finally:
        for line in lines:
            shell.type(f"kubectl delete clusterrolebinding {line.split()[3]}")


def test_roles_are_not_aggregated_if_disabled() -> None:
    rendered = {body["metadata"]["name"]: body for body in render("--set=rbac.aggregate=false")}
    for name, role in chart_roles().items():
        assert rendered[name]["rules"] == role["rules"]
        assert not [label for label in rendered[name]["metadata"]["labels"] if "aggregate" in label]
