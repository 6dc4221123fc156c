"""The Secrets of instances: written and deleted, and never read."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from http import HTTPStatus
from typing import Literal

from fractus_operator.cluster.kinds import SECRET, Body, Key, key_of
from fractus_operator.cluster.labels import labelled, secret_name
from fractus_operator.cluster.store import Conflict, KubeError, NotFound, Store

logger = logging.getLogger(__name__)

SecretWrite = Literal["new", "renewed", "lost"]
"""Why a Secret is written: there is none that is known of; it is due; or its pod may wait for one that is gone."""

_EXISTS = "AlreadyExists"


class ComponentSecrets:
    """Secrets with the certificates of instances.

    The chart's admission policy refuses the operator to write or delete one that it has not made.

    Args:
        store: The API server.
        turn: How many are written at a time.
    """

    def __init__(self, store: Store, turn: asyncio.Semaphore) -> None:
        self._store = store
        self._turn = turn
        self._kept: dict[Key, set[Key]] = {}
        """By application: those that the API server kept when their Deployments were removed."""

    async def write(self, application: Key, body: Body, why: SecretWrite) -> None:
        """Write one.

        Raises:
            KubeError: the API server refuses it, or cannot be reached.
        """
        async with self._turn:
            self._kept.get(labelled(application), set()).discard(key_of(body))
            if why == "renewed":
                # A creation that fails counts against the quota of its namespace.
                with contextlib.suppress(NotFound):
                    await self._store.replace(SECRET, body)
                    return
            try:
                await self._store.create(SECRET, body)
            except KubeError as refused:
                exists = isinstance(refused, Conflict) and refused.reason == _EXISTS
                # Of a namespace whose quota is used up the API server says no more, also of a Secret that is there.
                if not exists and refused.status != HTTPStatus.FORBIDDEN:
                    raise
                if exists and why == "lost":
                    return
                try:
                    await self._store.replace(SECRET, body)
                except NotFound:
                    raise refused from None

    async def remove_of(self, application: Key, deployment: Body) -> None:
        """Delete that of a Deployment which is about to be removed, after which nothing tells its name.

        What runs is removed all the same where that is refused; a pod that still runs keeps what it has mounted.

        Args:
            application: Its key, or what labels say of it.
            deployment: Which.
        """
        namespace, instance = key_of(deployment)
        secret = namespace, secret_name(instance)
        try:
            await self._store.delete(SECRET, secret)
        except KubeError as error:
            logger.debug("children: Secret is kept for now (secret=%s/%s): %s", *secret, error)
            self._kept.setdefault(labelled(application), set()).add(secret)

    async def remove_kept(self, application: Key) -> None:
        """Delete those that were kept when their Deployments were removed.

        Raises:
            KubeError: the API server still refuses one, or cannot be reached.
        """
        left = self._kept.get(labelled(application), set())
        for secret in list(left):
            await self._store.delete(SECRET, secret)
            left.discard(secret)
        if not left:
            self._kept.pop(labelled(application), None)
