"""IP cameras: a picture for each GET of a snapshot URL."""

from __future__ import annotations

import http.client
import time
import urllib.error
import urllib.parse
import urllib.request

from fractus_services.camera.drivers.driver import TIMEOUT_S, BadConnection, CameraFailed, CaptureRequest
from fractus_services.camera.pixels import MAX_BYTES, NotAPicture, Pixels, decoded

_PIECE_BYTES = 256 * 1024


class HttpSnapshot:
    """A camera with a snapshot URL.

    The size that is wanted goes into {width} and {height} of the URL; into its query where it has none. User name and
    password may stand before the host (basic and digest authentication); messages never show them.

    Args:
        url: of http or https.

    Raises:
        BadConnection: it is no such URL.
    """

    latency_s = 2.0
    """IP cameras answer with the picture that they encoded last."""

    def __init__(self, url: str) -> None:
        parts = urllib.parse.urlsplit(url)
        try:
            host, port = parts.hostname, parts.port
        except ValueError as error:
            raise BadConnection(f"{parts.scheme}: URL of the camera: {error}") from None
        if parts.scheme not in {"http", "https"} or not host:
            raise BadConnection("the camera's URL must be http://HOST[:PORT]/PATH")
        place = (f"[{host}]" if ":" in host else host) + (f":{port}" if port else "")
        self._url = urllib.parse.urlunsplit((parts.scheme, place, parts.path or "/", parts.query, ""))
        handlers: list[urllib.request.BaseHandler] = [urllib.request.ProxyHandler({}), _NoRedirect()]
        if parts.username:
            known = urllib.request.HTTPPasswordMgrWithDefaultRealm()
            user, password = (urllib.parse.unquote(v or "") for v in (parts.username, parts.password))
            known.add_password(None, self._url, user, password)
            handlers += [urllib.request.HTTPBasicAuthHandler(known), urllib.request.HTTPDigestAuthHandler(known)]
        self._opener = urllib.request.build_opener(*handlers)

    def capture(self, wanted: CaptureRequest) -> Pixels:
        """See `Driver`."""
        try:
            data = self._fetch(self._address(wanted))
        except urllib.error.HTTPError as error:
            with error:
                said = error.read(200).decode("utf-8", "replace").strip()
            raise CameraFailed(f"{self._url} answers {error.code} {error.reason}{': ' if said else ''}{said}") from None
        except (OSError, http.client.HTTPException) as error:
            reason = getattr(error, "reason", None) or error
            raise CameraFailed(f"{self._url} does not answer ({reason}); check the camera and its connection") from None
        try:
            return decoded(data)
        except NotAPicture as error:
            raise CameraFailed(f"{self._url} sends no picture: {error}") from None

    def close(self) -> None:
        """Nothing to close."""

    def _address(self, wanted: CaptureRequest) -> str:
        if "{width}" in self._url or "{height}" in self._url:
            return self._url.replace("{width}", str(wanted.width)).replace("{height}", str(wanted.height))
        if "?" in self._url:
            return self._url
        band = "&band=ir" if wanted.sensor == "IR" else ""
        return f"{self._url}?width={wanted.width}&height={wanted.height}{band}"

    def _fetch(self, address: str) -> bytes:
        """The body, within the time-out even when it trickles."""
        until = time.monotonic() + TIMEOUT_S
        pieces, size = [], 0
        with self._opener.open(address, timeout=TIMEOUT_S) as reply:
            while piece := reply.read1(_PIECE_BYTES):
                pieces.append(piece)
                size += len(piece)
                if size > MAX_BYTES:
                    raise CameraFailed(f"{self._url} sends more than {MAX_BYTES // 1_000_000} MB for one picture")
                if time.monotonic() > until:
                    raise TimeoutError(f"no whole picture in {TIMEOUT_S:.0f} s")
        return b"".join(pieces)


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    """A camera that sends its clients elsewhere is misconfigured, or not a camera."""

    def redirect_request(self, *_args: object, **_more: object) -> None:
        """Never."""
