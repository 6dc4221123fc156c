"""Kubernetes through the official client: reads, writes, watches and leader election, of objects as plain dicts."""

from fractus_kube.access import Access, Unconfigured, from_environment, in_cluster, kubeconfig, with_certificate
from fractus_kube.blocking import BlockingClient
from fractus_kube.client import POD, Client, Page
from fractus_kube.connection import ContentType
from fractus_kube.errors import Conflict, Expired, Invalid, KubeError, NotFound
from fractus_kube.lease import LEASE, Lease, LeaseThread, LostLease
from fractus_kube.objects import Body, Key, Kind, key_of
from fractus_kube.pace import Backoff
from fractus_kube.reflector import Reflector

__all__ = [
    "LEASE",
    "POD",
    "Access",
    "Backoff",
    "BlockingClient",
    "Body",
    "Client",
    "Conflict",
    "ContentType",
    "Expired",
    "Invalid",
    "Key",
    "Kind",
    "KubeError",
    "Lease",
    "LeaseThread",
    "LostLease",
    "NotFound",
    "Page",
    "Reflector",
    "Unconfigured",
    "from_environment",
    "in_cluster",
    "key_of",
    "kubeconfig",
    "with_certificate",
]
