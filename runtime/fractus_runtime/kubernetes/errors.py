"""Errors of requests to the API server: one class for each way in which a caller handles an error."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fractus_runtime.kubernetes.objects import Body


class KubeError(Exception):
    """The API server refused a request, or could not be reached. Retry later, except for the subclasses.

    Attributes:
        status: HTTP status. 0 if there was no response.
        reason: CamelCase reason of Kubernetes, such as Forbidden. "Unreachable" if there was no response.
        causes: Causes of an invalid object, each with `reason`, `message` and `field`, if the API server reported them.
    """

    def __init__(self, status: int, reason: str, message: str, causes: Sequence[Body] = ()) -> None:
        self.status = status
        self.reason = reason
        self.causes = causes
        super().__init__(message)


class Invalid(KubeError):
    """The object itself is invalid (400, 422). The same request fails again."""


class NotFound(KubeError):
    """The object or its kind does not exist (404)."""


class Conflict(KubeError):
    """An object of this name exists, or the object was changed since it was read (409). Read it again."""


class Expired(KubeError):
    """The resource version is too old to continue (410). List again."""


_BY_STATUS: dict[int, type[KubeError]] = {400: Invalid, 404: NotFound, 409: Conflict, 410: Expired, 422: Invalid}


def unreachable(message: str) -> KubeError:
    """Return the error for a request without a response."""
    return KubeError(0, "Unreachable", message)


def from_status(code: int, status: Any) -> KubeError:
    """Return the error for a response.

    Args:
        code: HTTP status.
        status: The response body. It is a Status object, unless a proxy responded.
    """
    body: Body = status if isinstance(status, dict) else {"message": str(status)[:500]}
    code = int(body.get("code") or code)
    message = str(body.get("message") or f"HTTP {code}")
    causes = (body.get("details") or {}).get("causes") or ()
    return _BY_STATUS.get(code, KubeError)(code, str(body.get("reason") or "Unknown"), message, causes)
