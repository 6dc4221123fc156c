"""Credentials that are asked for, and renewed in time."""

from __future__ import annotations

import pytest
from fractus_runtime.kubernetes.access import Access, with_tokens
from fractus_runtime.kubernetes.errors import KubeError
from kubernetes.aio.client import Configuration


class Tokens:
    """Issues numbered tokens, unless it is told to refuse."""

    def __init__(self) -> None:
        self.given, self.refuses = 0, False

    async def __call__(self) -> str:
        if self.refuses:
            raise KubeError(403, "Forbidden", "not now")
        self.given += 1
        return str(self.given)


async def bearer(access: Access) -> str | None:
    return (await access.configuration.auth_settings())["BearerToken"]["value"]


async def test_the_first_token_comes_before_the_first_request_and_lives_for_its_time() -> None:
    tokens, base = Tokens(), Configuration(host="https://api", cert_file="crt", key_file="key")
    base.api_key["BearerToken"] = "Bearer of the pod"
    access = with_tokens(base, tokens, 3600.0)
    assert tokens.given == 0
    assert [await bearer(access) for _ in range(2)] == ["Bearer 1", "Bearer 1"]
    await access.renew()
    assert await bearer(access) == "Bearer 2", "of one that is refused a new one is asked for at once"
    assert access.configuration.host == "https://api"
    assert access.configuration.cert_file is access.configuration.key_file is None, "they say who else asks"
    assert base.api_key == {"BearerToken": "Bearer of the pod"}
    assert base.cert_file == "crt"


async def test_a_token_outlives_a_renewal_that_fails() -> None:
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
