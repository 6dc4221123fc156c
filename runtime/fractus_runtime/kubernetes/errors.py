"""What the API server refuses, by what a caller does about it."""

from __future__ import annotations

from typing import Any

from fractus_runtime.kubernetes.objects import Body


class KubeError(Exception):
    """The API server refused a request, or could not be reached; where it is no subclass, try again later.

    Attributes:
        status: HTTP status; 0 where there was no answer.
        reason: Kubernetes' CamelCase reason, such as Forbidden; "Unreachable" where there was no answer.
    """

    def __init__(self, status: int, reason: str, message: str) -> None:
        self.status = status
        self.reason = reason
        super().__init__(message)


class Invalid(KubeError):
    """The object itself is refused (400, 422): the same request fails again."""


class NotFound(KubeError):
    """There is no such object, or no such kind yet."""


class Conflict(KubeError):
    """An object of that name exists, or it changed meanwhile (409): read it again."""


class Expired(KubeError):
    """The resource version is too old to continue from (410): list again."""


_BY_STATUS: dict[int, type[KubeError]] = {400: Invalid, 404: NotFound, 409: Conflict, 410: Expired, 422: Invalid}


def unreachable(message: str) -> KubeError:
    """The error where there was no answer."""
    return KubeError(0, "Unreachable", message)


def from_status(code: int, status: Any) -> KubeError:
    """The error of an HTTP status and of what came with it, a Status object unless a proxy on the way answered."""
    body: Body = status if isinstance(status, dict) else {"message": str(status)[:500]}
    code = int(body.get("code") or code)
    message = str(body.get("message") or f"HTTP {code}")
    return _BY_STATUS.get(code, KubeError)(code, str(body.get("reason") or "Unknown"), message)
