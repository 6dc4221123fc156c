"""`Camera.take`: behaviour if the picture cannot be deleted from the node."""

from __future__ import annotations

from typing import Any, cast

import pytest
from fractus.errors import Unavailable
from fractus.pictures import Camera
from fractus.values import ImageInfo, Result


class Node(Camera):
    """Fake camera. Deletions fail, and so do retrievals if `data` is None."""

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


async def test_take_returns_picture_if_deletion_fails(caplog: pytest.LogCaptureFixture) -> None:
    picture = await Node(b"jpeg").take()
    assert picture.data == b"jpeg"
    assert "not deleted from the node" in caplog.text


async def test_take_reports_retrieval_error_if_deletion_also_fails() -> None:
    with pytest.raises(Unavailable, match="fetching broke off"):
        await Node(None).take()
