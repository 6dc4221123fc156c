"""Temporary registry on the loopback interface that receives images from buildah into an OCI layout.

buildah omits layers that the destination already has, but only if the destination is a registry. buildah compresses the
layers that it sends, but looks for existing layers by the digest of the uncompressed layer. The registry therefore
stores layers uncompressed and rewrites the manifests accordingly. Nodes also import uncompressed layers fastest.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import os
import re
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

from fractus_cluster.images.layout import CONFIG_TYPE, LAYER_TYPE, MANIFEST_TYPE, Layout

_PIECE_BYTES = 1 << 20
_GZIP_MAGIC = b"\x1f\x8b"
_BLOB = re.compile(r"^/v2/.+/blobs/(sha256:[0-9a-f]{64})$")
_UPLOAD = re.compile(r"^/v2/.+/blobs/uploads/([0-9a-f]*)$")
_MANIFEST = re.compile(r"^/v2/(.+)/manifests/([^/]+)$")


@contextmanager
def receiving(layout: Layout) -> Iterator[str]:
    """Run the registry inside the block.

    Yields:
        The registry's address, `host:port`.
    """
    server = _Server(layout)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
    thread.start()
    try:
        yield f"127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join(timeout=10)
        for left in layout.path.glob(".upload-*"):
            left.unlink()


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self, layout: Layout) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.layout = layout
        self.unpacked: dict[str, str] = {}  # digest of a compressed layer -> digest of the stored layer

    def store(self, file: Path) -> str:
        """Move an uploaded file into the layout, uncompressed. Return the digest of the uploaded file."""
        sent = _digest_of(file)
        with file.open("rb") as content:
            packed = content.read(2) == _GZIP_MAGIC
        if not packed:
            file.replace(self.layout.blob(sent))
            return sent
        plain = file.with_name(file.name + ".plain")
        with gzip.open(file) as source, plain.open("wb") as out:
            shutil.copyfileobj(source, out, _PIECE_BYTES)
        stored = _digest_of(plain)
        plain.replace(self.layout.blob(stored))
        file.unlink()
        self.unpacked[sent] = stored
        return sent

    def store_manifest(self, name: str, content: bytes) -> None:
        """Add a manifest to the layout, with the digests of the uncompressed layers."""
        manifest = json.loads(content)
        for layer in manifest["layers"]:
            layer["digest"] = self.unpacked.get(layer["digest"], layer["digest"])
            layer["size"] = self.layout.blob(layer["digest"]).stat().st_size
            layer["mediaType"] = LAYER_TYPE
        manifest["mediaType"] = MANIFEST_TYPE
        manifest["config"]["mediaType"] = CONFIG_TYPE
        self.layout.add_manifest(name, manifest)


class _Handler(BaseHTTPRequestHandler):
    """The part of the OCI distribution protocol that a push uses."""

    protocol_version = "HTTP/1.1"
    server: _Server

    def log_message(self, format: str, *args: object) -> None:
        """Suppress the log."""

    def do_GET(self) -> None:
        """Confirm the protocol version. The registry serves no content."""
        self._respond(HTTPStatus.OK if self.path == "/v2/" else HTTPStatus.NOT_FOUND)

    def do_HEAD(self) -> None:
        """Return 200 if the layout has a layer."""
        match = _BLOB.match(self.path)
        path = self.server.layout.blob(match[1]) if match else None
        if match and path is not None and path.is_file():
            self._respond(
                HTTPStatus.OK,
                {"Docker-Content-Digest": match[1], "Content-Type": "application/octet-stream"},
                length=path.stat().st_size,
            )
        else:
            self._respond(HTTPStatus.NOT_FOUND)

    def do_POST(self) -> None:
        """Start an upload."""
        self._drain()
        name = os.urandom(8).hex()
        self._upload_file(name).touch()
        self._respond(
            HTTPStatus.ACCEPTED, {"Location": f"{urlsplit(self.path).path.rstrip('/')}/{name}", "Range": "0-0"}
        )

    def do_PATCH(self) -> None:
        """Receive a part of an upload."""
        match = _UPLOAD.match(urlsplit(self.path).path)
        if match is None:
            self._respond(HTTPStatus.NOT_FOUND)
            return
        file = self._upload_file(match[1])
        with file.open("ab") as out:
            for piece in self._body():
                out.write(piece)
        self._respond(HTTPStatus.ACCEPTED, {"Location": self.path, "Range": f"0-{file.stat().st_size - 1}"})

    def do_PUT(self) -> None:
        """Complete an upload, or receive a manifest."""
        address = urlsplit(self.path)
        upload = _UPLOAD.match(address.path)
        manifest = _MANIFEST.match(address.path)
        if upload is not None:
            file = self._upload_file(upload[1])
            with file.open("ab") as out:
                for piece in self._body():
                    out.write(piece)
            digest = self.server.store(file)
            if parse_qs(address.query).get("digest") != [digest]:
                self._respond(HTTPStatus.BAD_REQUEST)
                return
            self._respond(HTTPStatus.CREATED, {"Docker-Content-Digest": digest})
        elif manifest is not None:
            self.server.store_manifest(f"{manifest[1]}:{manifest[2]}", b"".join(self._body()))
            self._respond(HTTPStatus.CREATED)
        else:
            self._respond(HTTPStatus.NOT_FOUND)

    def _upload_file(self, name: str) -> Path:
        return self.server.layout.path / f".upload-{name}"

    def _drain(self) -> None:
        for _ in self._body():
            continue

    def _body(self) -> Iterator[bytes]:
        if self.headers.get("Transfer-Encoding", "").lower() == "chunked":
            while size := int(self.rfile.readline().split(b";")[0], 16):
                yield from self._read(size)
                self.rfile.readline()
            self.rfile.readline()
        else:
            yield from self._read(int(self.headers.get("Content-Length") or 0))

    def _read(self, size: int) -> Iterator[bytes]:
        while size > 0:
            piece = self.rfile.read(min(size, _PIECE_BYTES))
            if not piece:
                raise ConnectionError("the connection was closed during an upload")
            size -= len(piece)
            yield piece

    def _respond(self, status: HTTPStatus, headers: dict[str, str] | None = None, *, length: int = 0) -> None:
        self.send_response(status)
        for name, value in (headers or {}).items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(length))
        self.end_headers()


def _digest_of(path: Path) -> str:
    with path.open("rb") as content:
        return "sha256:" + hashlib.file_digest(content, "sha256").hexdigest()
