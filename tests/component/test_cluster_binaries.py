"""Programs of the cluster: pinned sources, accepted versions, and errors for missing programs."""

from __future__ import annotations

import re
from importlib import resources
from ipaddress import IPv4Network
from pathlib import Path

import pytest
from fractus_cluster import prerequisites
from fractus_cluster.binaries import (
    CLUSTER_PROGRAMS,
    DEFAULT_KUBERNETES,
    KUBERNETES_VERSIONS,
    PROGRAMS,
    ensure_binaries,
)
from fractus_cluster.binaries import build as build_module
from fractus_cluster.binaries.catalog import MODULES
from fractus_cluster.errors import ClusterError, PrerequisiteError
from fractus_cluster.ledger import write_ledger
from fractus_cluster.prerequisites import check_root
from fractus_cluster.spec import ClusterSpec
from fractus_cluster.startup import claim
from fractus_cluster.state import ClusterRecord, StateDirectory

GOMOD = resources.files("fractus_cluster.binaries") / "gomod"

REQUIRED = {
    "etcd": "go.etcd.io/etcd/server/v3",
    "coredns": "github.com/coredns/coredns",
    "helm": "helm.sh/helm/v3",
    "kwok": "sigs.k8s.io/kwok",
    "crane": "github.com/google/go-containerregistry",
    "kubelet": "k8s.io/kubernetes",
    "kubeadm": "k8s.io/kubernetes",
    "kind": "sigs.k8s.io/kind",
}


def script(path: Path, output: str) -> None:
    """Create a program that prints its version."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\necho '{output}'\n")
    path.chmod(0o755)


@pytest.mark.parametrize("minor", KUBERNETES_VERSIONS)
@pytest.mark.parametrize(("program", "module"), REQUIRED.items())
def test_go_mod_pins_the_version_in_the_catalog(program: str, module: str, minor: str) -> None:
    entry = PROGRAMS[minor][program]
    text = (GOMOD / entry.module / "go.mod").read_text()
    requirement = re.search(rf"^(?:require )?\s*{re.escape(module)} v(\S+)", text, re.MULTILINE)
    assert requirement is not None
    assert requirement[1] == entry.version


@pytest.mark.parametrize("module", sorted(set(MODULES) - {"pause"}))
def test_sources_are_pinned_by_checksum(module: str) -> None:
    assert (GOMOD / module / "go.sum").read_text().count("h1:") > 20


@pytest.mark.parametrize(("minor", "version"), KUBERNETES_VERSIONS.items())
@pytest.mark.parametrize("module", ["kubernetes", "kubeadm"])
def test_staging_modules_match_kubernetes(module: str, minor: str, version: str) -> None:
    assert version.startswith(f"{minor}.")
    text = (GOMOD / f"{module}-{minor}" / "go.mod").read_text()
    versions = set(re.findall(r"=> k8s\.io/\S+ v(\S+)", text))
    assert versions == {"0" + version[1:]}


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Machine with an empty cache, an empty PATH and no Go."""
    monkeypatch.setenv("FRACTUS_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("PATH", str(tmp_path / "path"))
    for name in ("KUBEBUILDER_ASSETS", "FRACTUS_KUBERNETES"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path


def test_programs_are_found_in_assets_and_on_path(machine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script(machine / "assets" / "etcd", "etcd Version: 3.5.1")
    script(machine / "path" / "etcd", "etcd Version: 3.6.0")
    script(machine / "path" / "kubectl", f"Client Version: v{KUBERNETES_VERSIONS[DEFAULT_KUBERNETES]}")
    assert ensure_binaries(["etcd", "kubectl"], report=print)["etcd"] == machine / "path" / "etcd"
    monkeypatch.setenv("KUBEBUILDER_ASSETS", str(machine / "assets"))
    binaries = ensure_binaries(["etcd", "kubectl"], report=print)
    assert binaries["etcd"] == machine / "assets" / "etcd"
    assert binaries["kubectl"] == machine / "path" / "kubectl"


def test_program_of_another_version_is_not_used(machine: Path) -> None:
    script(machine / "path" / "kubectl", "Client Version: v1.32.4")
    with pytest.raises(PrerequisiteError, match=r"Go 1\.25"):
        ensure_binaries(["kubectl"], report=print)


def test_programs_of_the_chosen_version_are_used(machine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script(machine / "assets" / "kubectl", "Client Version: v1.34.1")
    script(machine / "path" / "kubectl", "Client Version: v1.35.1")
    monkeypatch.setenv("KUBEBUILDER_ASSETS", str(machine / "assets"))
    assert ensure_binaries(["kubectl"], report=print)["kubectl"] == machine / "path" / "kubectl"
    monkeypatch.setenv("FRACTUS_KUBERNETES", "1.34")
    assert ensure_binaries(["kubectl"], report=print)["kubectl"] == machine / "assets" / "kubectl"


def test_each_kubernetes_version_has_its_own_build_directory(machine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for minor, version in KUBERNETES_VERSIONS.items():
        directory = machine / "cache" / f"v{version}"
        script(directory / "bin" / "kubelet", f"Kubernetes v{version}")
        digest = build_module.module_digest(MODULES[f"kubernetes-{minor}"])
        write_ledger(directory / "built.json", {"kubelet": digest})
        monkeypatch.setenv("FRACTUS_KUBERNETES", minor)
        assert ensure_binaries(["kubelet"], report=print)["kubelet"] == directory / "bin" / "kubelet"


@pytest.mark.parametrize("chosen", ["1.33", "1.34.4", "latest"])
def test_unsupported_kubernetes_version_is_refused(machine: Path, monkeypatch: pytest.MonkeyPatch, chosen: str) -> None:
    monkeypatch.setenv("FRACTUS_KUBERNETES", chosen)
    with pytest.raises(ClusterError) as error:
        ensure_binaries(["kubelet"], report=print)
    assert str(error.value) == f"Kubernetes {chosen} is not supported; set FRACTUS_KUBERNETES to 1.35 or 1.34"


def test_cluster_keeps_its_kubernetes_version(tmp_path: Path) -> None:
    state = StateDirectory(tmp_path)
    state.write_record(ClusterRecord(IPv4Network("10.200.0.0/16"), {}, "1.35"))
    with pytest.raises(ClusterError, match=r"runs Kubernetes 1\.35; set FRACTUS_KUBERNETES=1\.35, or remove it before"):
        claim(ClusterSpec.placeholder("demo"), state, "1.34", print)
    assert state.read_record() == ClusterRecord(IPv4Network("10.200.0.0/16"), {}, "1.35")


def test_old_go_is_refused(machine: Path) -> None:
    script(machine / "path" / "go", "go1.21.3\nlocal")
    with pytest.raises(PrerequisiteError, match=r"building pause needs Go 1\.25 or newer; this is go1\.21\.3"):
        ensure_binaries(["pause"], report=print)


def test_failed_build_leaves_no_files(machine: Path) -> None:
    go = machine / "path" / "go"
    script(go, "")
    go.write_text('#!/bin/sh\n[ "$1" = env ] && echo go1.25.0 local && exit 0\necho "compiler on fire" >&2\nexit 2\n')
    with pytest.raises(ClusterError, match="compiler on fire"):
        ensure_binaries(["pause"], report=print)
    remaining = list((machine / "cache").rglob("*"))
    assert [path.name for path in remaining if path.is_file()] == ["lock"]


def test_built_program_with_wrong_version_is_refused(machine: Path) -> None:
    script(machine / "etcd", "etcd Version: 3.5.9")
    with pytest.raises(ClusterError, match=r"reports 3\.5\.9"):
        build_module.check_version(machine / "etcd", PROGRAMS[DEFAULT_KUBERNETES]["etcd"])


def test_unknown_program_is_named() -> None:
    with pytest.raises(ClusterError, match="unknown program vim"):
        ensure_binaries(["vim"], report=print)


def test_cluster_programs_are_in_the_catalog() -> None:
    for programs in PROGRAMS.values():
        assert set(CLUSTER_PROGRAMS) <= set(programs) == set(PROGRAMS[DEFAULT_KUBERNETES])
    assert not {"kwok", "crane"} & set(CLUSTER_PROGRAMS)


def test_error_for_other_users_suggests_sudo(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    with pytest.raises(PrerequisiteError, match="sudo"):
        check_root()


def test_missing_packages_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    installed = {"containerd", "ctr", "ip", "nsenter", "unshare", "mount", "iptables"}
    monkeypatch.setattr("shutil.which", lambda name, path=None: name if name in installed else None)
    monkeypatch.setattr(prerequisites, "plugin_directory", lambda: None)
    assert prerequisites.missing_packages() == ["containernetworking-plugins", "nftables", "runc"]
    monkeypatch.setattr(prerequisites, "check_root", lambda: None)
    with pytest.raises(PrerequisiteError, match="apt-get install containernetworking-plugins nftables runc"):
        prerequisites.check_prerequisites()
