"""The Kubernetes programs: found on the machine when their version fits, else built once from Go modules."""

from fractus_cluster.binaries.catalog import CLUSTER_PROGRAMS, DEFAULT_KUBERNETES, KUBERNETES_VERSIONS, PROGRAMS
from fractus_cluster.binaries.provision import Binaries, cache_directory, chosen_kubernetes, ensure_binaries

__all__ = [
    "CLUSTER_PROGRAMS",
    "DEFAULT_KUBERNETES",
    "KUBERNETES_VERSIONS",
    "PROGRAMS",
    "Binaries",
    "cache_directory",
    "chosen_kubernetes",
    "ensure_binaries",
]
