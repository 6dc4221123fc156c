"""The Kubernetes programs: found on the machine when their version fits, else built once from Go modules."""

from fractus_cluster.binaries.catalog import CLUSTER_PROGRAMS, KUBERNETES_VERSION, PROGRAMS
from fractus_cluster.binaries.provision import Binaries, cache_directory, ensure_binaries

__all__ = [
    "CLUSTER_PROGRAMS",
    "KUBERNETES_VERSION",
    "PROGRAMS",
    "Binaries",
    "cache_directory",
    "ensure_binaries",
]
