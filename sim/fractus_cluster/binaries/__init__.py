"""The Kubernetes programs: installed programs with a suitable version, or programs built once from Go modules."""

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
