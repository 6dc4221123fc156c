"""Camera driver for IP cameras: fetches each image with a GET request of a snapshot URL."""

from __future__ import annotations

import http.client
import time
import urllib.error
import urllib.parse
import urllib.request

from fractus_services.camera.drivers.driver import TIMEOUT_S, CameraFailed, CaptureRequest, InvalidCameraConnection
from fractus_services.camera.pixels import MAX_BYTES, InvalidImage, Pixels, decode_image

_READ_BYTES = 256 * 1024


class HttpSnapshot:
    """A camera with a snapshot URL.

    The requested size replaces {width} and {height} in the URL. If the URL has neither these placeholders nor a query, the size is
    added as a query. User name and password may precede the host, for basic and digest authentication. Error messages never contain
    them.

    Args:
        url: URL of the scheme http or https.

    Raises:
        InvalidCameraConnection: The URL is malformed.
    """

    latency_s = 2.0
    """Maximum age of an image, in seconds, because IP cameras return the image that they encoded last."""

    def __init__(self, url: str) -> None:
        parts = urllib.parse.urlsplit(url)
        try:
            host = parts.hostname
            port = parts.port
        except ValueError as error:
            raise InvalidCameraConnection(f"{parts.scheme}: URL of the camera: {error}") from None
        if parts.scheme not in {"http", "https"} or not host:
            raise InvalidCameraConnection("the camera's URL must be http://HOST[:PORT]/PATH")
        netloc = f"[{host}]" if ":" in host else host
        if port:
            netloc += f":{port}"
        self._url = urllib.parse.urlunsplit((parts.scheme, netloc, parts.path or "/", parts.query, ""))
        handlers: list[urllib.request.BaseHandler] = [urllib.request.ProxyHandler({}), _NoRedirect()]
        if parts.username:
            passwords = urllib.request.HTTPPasswordMgrWithDefaultRealm()
            user, password = (urllib.parse.unquote(value or "") for value in (parts.username, parts.password))
            passwords.add_password(None, self._url, user, password)
            handlers += [
                urllib.request.HTTPBasicAuthHandler(passwords),
                urllib.request.HTTPDigestAuthHandler(passwords),
            ]
        self._opener = urllib.request.build_opener(*handlers)

    def capture(self, request: CaptureRequest) -> Pixels:
        """See `CameraDriver`."""
        try:
            data = self._fetch(self._snapshot_url(request))
        except urllib.error.HTTPError as error:
            with error:
                body = error.read(200).decode("utf-8", "replace").strip()
            details = f": {body}" if body else ""
            raise CameraFailed(f"{self._url} returned {error.code} {error.reason}{details}") from None
        except (OSError, http.client.HTTPException) as error:
            reason = getattr(error, "reason", None) or error
            raise CameraFailed(
                f"{self._url} does not respond ({reason}); check the camera and its connection"
            ) from None
        try:
            return decode_image(data)
        except InvalidImage as error:
            raise CameraFailed(f"{self._url} returned no image: {error}") from None

    def close(self) -> None:
        """See `CameraDriver`."""

    def _snapshot_url(self, request: CaptureRequest) -> str:
        if "{width}" in self._url or "{height}" in self._url:
            return self._url.replace("{width}", str(request.width)).replace("{height}", str(request.height))
        if "?" in self._url:
            return self._url
        band = "&band=ir" if request.sensor == "IR" else ""
        return f"{self._url}?width={request.width}&height={request.height}{band}"

    def _fetch(self, url: str) -> bytes:
        """Read the body. The timeout applies to the entire body, because a slow camera could send it byte by byte."""
        deadline_s = time.monotonic() + TIMEOUT_S
        chunks = []
        size = 0
        with self._opener.open(url, timeout=TIMEOUT_S) as response:
            while chunk := response.read1(_READ_BYTES):
                chunks.append(chunk)
                size += len(chunk)
                if size > MAX_BYTES:
                    raise CameraFailed(f"{self._url} returned more than {MAX_BYTES // 1_000_000} MB for one image")
                if time.monotonic() > deadline_s:
                    raise TimeoutError(f"no complete image within {TIMEOUT_S:.0f} s")
        return b"".join(chunks)


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    """Rejects redirects, because a camera that redirects its clients is misconfigured or not a camera."""

    def redirect_request(self, *_args: object, **_kwargs: object) -> None:
        """Return no redirected request."""
