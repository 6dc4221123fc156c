"""Catalog of the cluster's programs: Go modules and accepted versions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

KUBERNETES_VERSIONS: Mapping[str, str] = MappingProxyType({"1.35": "1.35.4", "1.34": "1.34.4"})
"""Programs that are built for each supported minor version of Kubernetes."""

DEFAULT_KUBERNETES = "1.35"
ETCD_VERSION = "3.6.13"
COREDNS_VERSION = "1.14.2"
HELM_VERSION = "3.21.0"
KWOK_VERSION = "0.8.0"
CRANE_VERSION = "0.22.1"
KIND_VERSION = "0.32.0"


@dataclass(frozen=True, slots=True)
class Program:
    """One program.

    Attributes:
        name: File name of the program.
        module: Folder below `gomod/` whose go.mod and go.sum pin its sources.
        package: Argument of `go build` in that folder.
        version: Version that is built.
        version_arguments: Arguments that print the version. Empty if the program has none.
        accepts: Version prefix accepted from KUBEBUILDER_ASSETS or PATH. None: always build.
    """

    name: str
    module: str
    package: str
    version: str
    version_arguments: tuple[str, ...] = ("--version",)
    accepts: str | None = None


@dataclass(frozen=True, slots=True)
class Module:
    """A Go module and its build settings.

    Attributes:
        name: Folder below `gomod/`.
        link_variables: Values set by the linker, such as the version that a server reports.
    """

    name: str
    link_variables: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))


def _kubernetes_link_variables(version: str) -> dict[str, str]:
    major, minor, _ = version.split(".")
    values = {
        "gitVersion": f"v{version}",
        "gitMajor": major,
        "gitMinor": minor,
        "gitTreeState": "clean",
        "gitCommit": "unknown",
    }
    packages = ("k8s.io/component-base/version", "k8s.io/client-go/pkg/version")
    return {f"{package}.{name}": value for package in packages for name, value in values.items()}


def _kubernetes(minor: str, name: str, *version_arguments: str) -> Program:
    return Program(
        name,
        f"kubernetes-{minor}",
        f"k8s.io/kubernetes/cmd/{name}",
        KUBERNETES_VERSIONS[minor],
        version_arguments or ("--version",),
        accepts=f"{minor}.",
    )


def _programs(minor: str) -> Mapping[str, Program]:
    version = KUBERNETES_VERSIONS[minor]
    programs = (
        _kubernetes(minor, "kube-apiserver"),
        _kubernetes(minor, "kube-controller-manager"),
        _kubernetes(minor, "kube-scheduler"),
        _kubernetes(minor, "kubelet"),
        _kubernetes(minor, "kube-proxy"),
        _kubernetes(minor, "kubectl", "version", "--client"),
        # kubeadm is a separate module, so that its dependencies do not affect the versions in the other programs.
        Program("kubeadm", f"kubeadm-{minor}", "k8s.io/kubernetes/cmd/kubeadm", version, ("version",)),
        Program("kind", "kind", "sigs.k8s.io/kind", KIND_VERSION),
        Program("etcd", "etcd", ".", ETCD_VERSION, accepts="3."),
        Program("coredns", "coredns", ".", COREDNS_VERSION, ("-version",), accepts="1."),
        Program("helm", "helm", "helm.sh/helm/v3/cmd/helm", HELM_VERSION, ("version", "--short"), accepts="3."),
        Program("pause", "pause", ".", version, ()),
        Program("kwok", "kwok", "sigs.k8s.io/kwok/cmd/kwok", KWOK_VERSION, accepts="0."),
        Program(
            "crane",
            "crane",
            "github.com/google/go-containerregistry/cmd/crane",
            CRANE_VERSION,
            ("version",),
            accepts="0.",
        ),
    )
    return MappingProxyType({program.name: program for program in programs})


PROGRAMS: Mapping[str, Mapping[str, Program]] = MappingProxyType(
    {minor: _programs(minor) for minor in KUBERNETES_VERSIONS}
)
"""Programs by minor version of Kubernetes and by name. All versions have the same names."""

MODULES: Mapping[str, Module] = MappingProxyType(
    {
        module.name: module
        for module in (
            *(
                Module(f"{name}-{minor}", _kubernetes_link_variables(version))
                for name in ("kubernetes", "kubeadm")
                for minor, version in KUBERNETES_VERSIONS.items()
            ),
            Module("kind"),
            Module("etcd"),
            Module("coredns"),
            Module("helm", {"helm.sh/helm/v3/internal/version.version": f"v{HELM_VERSION}"}),
            Module("pause"),
            Module("kwok", {"sigs.k8s.io/kwok/pkg/consts.Version": f"v{KWOK_VERSION}"}),
            Module("crane", {"github.com/google/go-containerregistry/cmd/crane/cmd.Version": f"v{CRANE_VERSION}"}),
        )
    }
)

CLUSTER_PROGRAMS = (
    "etcd",
    "kube-apiserver",
    "kube-controller-manager",
    "kube-scheduler",
    "kubelet",
    "kube-proxy",
    "kubectl",
    "coredns",
    "pause",
    "helm",
)
"""Programs that `fractus cluster up` needs. All other programs are built on request only."""
