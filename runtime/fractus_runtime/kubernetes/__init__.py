"""Kubernetes client on top of the official client: reads, writes, informers and leader election.

Objects are plain dicts.
"""

from fractus_runtime.kubernetes.access import (
    Access,
    Unconfigured,
    from_environment,
    in_cluster,
    kubeconfig,
    with_certificate,
    without_credentials,
)
from fractus_runtime.kubernetes.blocking import BlockingClient
from fractus_runtime.kubernetes.client import POD, Client, Page
from fractus_runtime.kubernetes.connection import ContentType
from fractus_runtime.kubernetes.errors import Conflict, Expired, Invalid, KubeError, NotFound
from fractus_runtime.kubernetes.informer import Informer
from fractus_runtime.kubernetes.leader_election import LEASE, Lease, LeaseThread, LostLease
from fractus_runtime.kubernetes.objects import Body, Key, Kind, key_of

__all__ = [
    "LEASE",
    "POD",
    "Access",
    "BlockingClient",
    "Body",
    "Client",
    "Conflict",
    "ContentType",
    "Expired",
    "Informer",
    "Invalid",
    "Key",
    "Kind",
    "KubeError",
    "Lease",
    "LeaseThread",
    "LostLease",
    "NotFound",
    "Page",
    "Unconfigured",
    "from_environment",
    "in_cluster",
    "key_of",
    "kubeconfig",
    "with_certificate",
    "without_credentials",
]
