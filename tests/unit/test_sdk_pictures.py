"""Pictures that are taken in one call: what happens where they cannot be deleted from the node."""

from __future__ import annotations

from typing import Any, cast

import pytest
from fractus.errors import Unavailable
from fractus.pictures import Camera
from fractus.values import ImageInfo, Result


class Node(Camera):
    """A camera whose transfers break off."""

    def __init__(self, data: bytes | None) -> None:
        self.data = data

    async def capture(self, *_: Any, **__: Any) -> ImageInfo:
        return cast(ImageInfo, type("Info", (), {"name": "7.jpg"}))

    async def retrieve(self, name: str) -> bytes:
        if self.data is None:
            raise Unavailable("fetching broke off")
        return self.data

    async def delete(self, name: str) -> Result:
        raise Unavailable(f"deleting {name} broke off")


async def test_a_fetched_picture_is_kept_though_it_cannot_be_deleted(caplog: pytest.LogCaptureFixture) -> None:
    picture = await Node(b"jpeg").take()
    assert picture.data == b"jpeg"
    assert "stays on the node" in caplog.text


async def test_it_says_why_a_picture_was_not_fetched() -> None:
    with pytest.raises(Unavailable, match="fetching broke off"):
        await Node(None).take()
