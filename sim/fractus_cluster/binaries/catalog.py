"""The programs a cluster runs: which Go module each comes from, and which versions are acceptable."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

KUBERNETES_VERSION = "1.35.4"
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
        package: What `go build` is given inside that folder.
        version: The version that is built.
        version_arguments: Make the program print its version; empty for one that has none to print.
        accepts: Prefix of the versions accepted from KUBEBUILDER_ASSETS or PATH; None means never look there.
    """

    name: str
    module: str
    package: str
    version: str
    version_arguments: tuple[str, ...] = ("--version",)
    accepts: str | None = None


@dataclass(frozen=True, slots=True)
class Module:
    """A Go module with everything needed to build programs from it.

    Attributes:
        name: Folder below `gomod/`.
        link_variables: Values the linker sets; servers report their version from them.
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


def _kubernetes(name: str, *version_arguments: str) -> Program:
    minor = KUBERNETES_VERSION.rsplit(".", 1)[0]
    return Program(
        name,
        "kubernetes",
        f"k8s.io/kubernetes/cmd/{name}",
        KUBERNETES_VERSION,
        version_arguments or ("--version",),
        accepts=f"{minor}.",
    )


PROGRAMS: Mapping[str, Program] = MappingProxyType(
    {
        program.name: program
        for program in (
            _kubernetes("kube-apiserver"),
            _kubernetes("kube-controller-manager"),
            _kubernetes("kube-scheduler"),
            _kubernetes("kubelet"),
            _kubernetes("kube-proxy"),
            _kubernetes("kubectl", "version", "--client"),
            # In a module of its own: what the others share does not change with what kubeadm alone needs.
            Program("kubeadm", "kubeadm", "k8s.io/kubernetes/cmd/kubeadm", KUBERNETES_VERSION, ("version",)),
            Program("kind", "kind", "sigs.k8s.io/kind", KIND_VERSION),
            Program("etcd", "etcd", ".", ETCD_VERSION, accepts="3."),
            Program("coredns", "coredns", ".", COREDNS_VERSION, ("-version",), accepts="1."),
            Program("helm", "helm", "helm.sh/helm/v3/cmd/helm", HELM_VERSION, ("version", "--short"), accepts="3."),
            Program("pause", "pause", ".", KUBERNETES_VERSION, ()),
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
    }
)

MODULES: Mapping[str, Module] = MappingProxyType(
    {
        "kubernetes": Module("kubernetes", _kubernetes_link_variables(KUBERNETES_VERSION)),
        "kubeadm": Module("kubeadm", _kubernetes_link_variables(KUBERNETES_VERSION)),
        "kind": Module("kind"),
        "etcd": Module("etcd"),
        "coredns": Module("coredns"),
        "helm": Module("helm", {"helm.sh/helm/v3/internal/version.version": f"v{HELM_VERSION}"}),
        "pause": Module("pause"),
        "kwok": Module("kwok", {"sigs.k8s.io/kwok/pkg/consts.Version": f"v{KWOK_VERSION}"}),
        "crane": Module("crane", {"github.com/google/go-containerregistry/cmd/crane/cmd.Version": f"v{CRANE_VERSION}"}),
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
"""What `fractus cluster up` needs; the other programs are built on request."""
