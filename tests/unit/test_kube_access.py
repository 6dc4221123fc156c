"""Kubernetes client with requested tokens, and their renewal."""

from __future__ import annotations

import pytest
from fractus_runtime.kubernetes.access import Access, with_tokens
from fractus_runtime.kubernetes.errors import KubeError
from kubernetes.aio.client import Configuration


class Tokens:
    """Issues numbered tokens, or refuses if `refuses` is set."""

    def __init__(self) -> None:
        self.issued = 0
        self.refuses = False

    async def __call__(self) -> str:
        if self.refuses:
            raise KubeError(403, "Forbidden", "not now")
        self.issued += 1
        return str(self.issued)


async def bearer(access: Access) -> str | None:
    return (await access.configuration.auth_settings())["BearerToken"]["value"]


async def test_token_is_requested_before_first_request_and_reused() -> None:
    tokens = Tokens()
    base = Configuration(host="https://api", cert_file="crt", key_file="key")
    base.api_key["BearerToken"] = "Bearer of the pod"
    access = with_tokens(base, tokens, 3600.0)
    assert tokens.issued == 0
    assert [await bearer(access) for _ in range(2)] == ["Bearer 1", "Bearer 1"]
    await access.renew()
    assert await bearer(access) == "Bearer 2", "a refused token is replaced at once"
    assert access.configuration.host == "https://api"
    assert access.configuration.cert_file is access.configuration.key_file is None, (
        "no client certificate is sent in addition to the token"
    )
    assert base.api_key == {"BearerToken": "Bearer of the pod"}
    assert base.cert_file == "crt"


async def test_token_is_kept_when_renewal_fails() -> None:
    tokens = Tokens()
    access = with_tokens(Configuration(host="https://api"), tokens, 0.0)
    tokens.refuses = True
    with pytest.raises(KubeError):
        await bearer(access)
    tokens.refuses = False
    assert await bearer(access) == "Bearer 1"
    tokens.refuses = True
    assert await bearer(access) == "Bearer 1"
    tokens.refuses = False
    assert await bearer(access) == "Bearer 2"
    tokens.refuses = True
    with pytest.raises(KubeError):
        await access.renew()
