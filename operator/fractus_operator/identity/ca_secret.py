"""Where the key of the certificate authority is kept: a Secret; its certificate is public, in a ConfigMap."""

from __future__ import annotations

import logging
from datetime import UTC, datetime

from fractus_core.identity.authority import Authority, BrokenAuthority

from fractus_operator.cluster.kinds import CONFIG_MAP, SECRET, Body
from fractus_operator.cluster.labels import MANAGED_BY, MANAGED_LABEL
from fractus_operator.cluster.store import Conflict, NotFound, Store

logger = logging.getLogger(__name__)

NAME = "fractus-ca"
"""Name of the Secret with the authority's key, and of the ConfigMap with its certificate."""


async def open_authority(store: Store, namespace: str) -> Authority:
    """Read the system's authority, or make it once; two operators that start at once end with the same one.

    Raises:
        BrokenAuthority: its Secret is damaged.
    """
    try:
        secret = await store.get(SECRET, NAME, namespace)
    except NotFound:
        authority = Authority.generate(datetime.now(UTC))
        body = {**_owned(SECRET.header(NAME, namespace)), "type": "kubernetes.io/tls", "data": authority.to_data()}
        try:
            secret = await store.create(SECRET, body)
            logger.info("identity: certificate authority created (secret=%s/%s)", namespace, NAME)
        except Conflict:
            secret = await store.get(SECRET, NAME, namespace)
    try:
        authority = Authority.from_data(secret.get("data") or {})
    except BrokenAuthority as error:
        raise BrokenAuthority(
            f"Secret {namespace}/{NAME}: {error}; restore it, or delete it to make a new one"
        ) from error
    public = {**_owned(CONFIG_MAP.header(NAME, namespace)), "data": {"ca.crt": authority.certificate_pem.decode()}}
    await store.apply(CONFIG_MAP, public)
    return authority


def _owned(header: Body) -> Body:
    header["metadata"]["labels"] = {MANAGED_LABEL: MANAGED_BY}
    return header
