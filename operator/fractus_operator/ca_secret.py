"""Storage of the certificate authority: its key in a Secret, its certificate in a public ConfigMap."""

from __future__ import annotations

import logging
from datetime import UTC, datetime

from fractus_core.identity.authority import Authority, BrokenAuthority

from fractus_operator.kinds import CONFIG_MAP, SECRET, Body
from fractus_operator.labels import MANAGED_BY, MANAGED_LABEL
from fractus_operator.store import Conflict, NotFound, Store

log = logging.getLogger(__name__)

CERTIFICATE_PERIOD_S = 10.0
"""Period of the check that the ConfigMap with the certificate exists and is unchanged, in seconds."""

NAME = "fractus-ca"
"""Name of the Secret with the key of the authority, and of the ConfigMap with its certificate."""


async def open_authority(store: Store, namespace: str) -> Authority:
    """Read the certificate authority, or create it. Two operators that start at the same time use the same authority.

    Raises:
        BrokenAuthority: Its Secret is damaged.
    """
    try:
        secret = await store.get(SECRET, NAME, namespace)
    except NotFound:
        authority = Authority.generate(datetime.now(UTC))
        body = {**_managed(SECRET.header(NAME, namespace)), "type": "kubernetes.io/tls", "data": authority.to_data()}
        try:
            secret = await store.create(SECRET, body)
            log.info("ca secret: certificate authority created (secret=%s/%s)", namespace, NAME)
        except Conflict:
            secret = await store.get(SECRET, NAME, namespace)
    try:
        authority = Authority.from_data(secret.get("data") or {})
    except BrokenAuthority as error:
        raise BrokenAuthority(
            f"Secret {namespace}/{NAME}: {error}; restore it, or delete it to create a new authority"
        ) from error
    await publish_certificate(store, namespace, authority)
    return authority


async def publish_certificate(store: Store, namespace: str, authority: Authority) -> None:
    """Write the authority's certificate to its ConfigMap, unless the ConfigMap contains it. Agents read it from there.

    Raises:
        KubeError: The API server refused the write, or could not be reached.
    """
    data = {"ca.crt": authority.certificate_pem.decode()}
    try:
        present = (await store.get(CONFIG_MAP, NAME, namespace)).get("data")
    except NotFound:
        present = None
    if present != data:
        log.info("ca secret: certificate of the authority published (configmap=%s/%s)", namespace, NAME)
        await store.apply(CONFIG_MAP, {**_managed(CONFIG_MAP.header(NAME, namespace)), "data": data})


def _managed(header: Body) -> Body:
    header["metadata"]["labels"] = {MANAGED_LABEL: MANAGED_BY}
    return header
