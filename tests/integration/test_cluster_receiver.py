"""Temporary registry that receives one push of buildah."""

from __future__ import annotations

import gzip
import hashlib
import http.client
import json
import subprocess
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest
from fractus_cluster.images.layout import Layout
from fractus_cluster.images.receiver import receiving


@pytest.fixture
def layout(tmp_path: Path) -> Layout:
    """An empty OCI image layout."""
    layout = Layout(tmp_path / "layout")
    layout.create()
    return layout


def buildah(*arguments: str) -> str:
    """Run buildah. Each test uses separate image names, because the storage is shared."""
    result = subprocess.run(["buildah", *arguments], capture_output=True, text=True, timeout=60, check=True)
    return result.stdout.strip()


@pytest.fixture
def image(tmp_path: Path) -> Iterator[str]:
    """A small image in buildah's storage."""
    name = f"localhost/fractus-test/receiver:{uuid.uuid4().hex}"
    container = buildah("from", "scratch")
    try:
        (tmp_path / "file").write_bytes(name.encode() * 1000)
        buildah("add", "--quiet", container, str(tmp_path / "file"), "/file")
        buildah("commit", "--quiet", container, name)
    finally:
        buildah("rm", container)
    yield name
    buildah("rmi", name)


@pytest.mark.root
def test_receiver_stores_pushed_image_uncompressed(layout: Layout, image: str) -> None:
    with receiving(layout) as address:
        buildah("push", "--quiet", "--tls-verify=false", image, f"docker://{address}/{image}")
    received = layout.image(image)
    *layers, config, _ = layout.digests(received)
    assert json.loads(layout.blob(config).read_text())["rootfs"]["diff_ids"] == layers
    for digest in layers:
        assert "sha256:" + hashlib.sha256(layout.blob(digest).read_bytes()).hexdigest() == digest
    assert buildah("inspect", "--format", "{{.FromImageID}}", image) == layout.image_id(received)
    assert not list(layout.path.glob(".upload-*"))


@pytest.mark.root
def test_second_push_transfers_no_layer_again(layout: Layout, image: str) -> None:
    with receiving(layout) as address:
        buildah("push", "--quiet", "--tls-verify=false", image, f"docker://{address}/{image}")
    written = {path.name: path.stat().st_mtime_ns for path in (layout.path / "blobs" / "sha256").iterdir()}
    with receiving(layout) as address:
        buildah("push", "--quiet", "--tls-verify=false", image, f"docker://{address}/{image}")
    layers = {digest.removeprefix("sha256:") for digest in layout.digests(layout.image(image))[:-2]}
    assert all((layout.path / "blobs" / "sha256" / name).stat().st_mtime_ns == written[name] for name in layers)


def upload(address: str, content: bytes, digest: str) -> int:
    """Upload a blob like a registry client, and return the last status."""
    connection = http.client.HTTPConnection(address, timeout=10)
    connection.request("POST", "/v2/a/b/blobs/uploads/")
    begun = connection.getresponse()
    begun.read()
    location = begun.headers["Location"]
    connection.request("PATCH", location, body=content)
    connection.getresponse().read()
    connection.request("PUT", f"{location}?digest={digest}")
    status = connection.getresponse().status
    connection.close()
    return status


def test_receiver_refuses_blob_with_wrong_digest(layout: Layout) -> None:
    with receiving(layout) as address:
        assert upload(address, b"content", "sha256:" + "0" * 64) == 400
        digest = "sha256:" + hashlib.sha256(b"content").hexdigest()
        assert upload(address, b"content", digest) == 201
        assert layout.blob(digest).read_bytes() == b"content"


def test_receiver_finds_compressed_layer_by_digest_of_uncompressed_layer(layout: Layout) -> None:
    packed = gzip.compress(b"layer" * 1000)
    plain = "sha256:" + hashlib.sha256(b"layer" * 1000).hexdigest()
    with receiving(layout) as address:
        assert upload(address, packed, "sha256:" + hashlib.sha256(packed).hexdigest()) == 201
        connection = http.client.HTTPConnection(address, timeout=10)
        connection.request("HEAD", f"/v2/a/b/blobs/{plain}")
        assert connection.getresponse().status == 200
        connection.close()
