"""The headers ETag and If-Match: a write applies only to the version that the caller has read."""

from __future__ import annotations

import re
from typing import Annotated

from fastapi import Header

from fractus_management.problem_details import Refused, refused

IfMatch = Annotated[
    str | None, Header(max_length=1024, description='ETag of the version that the request is based on, or "*" for any.')
]


def required(if_match: str | None) -> str:
    """Return the header If-Match.

    Raises:
        Refused: The header is missing.
    """
    if if_match is None:
        message = "send the header If-Match with the ETag of the object, or If-Match: * to change any version"
        raise refused(428, "PreconditionRequired", message, "If-Match")
    return if_match


def check_version(if_match: str, etag: str) -> bool:
    """Return True if the header permits only the version with an ETag, False if it permits any version.

    Raises:
        Refused: The header does not contain the ETag.
    """
    if if_match.strip() == "*":
        return False
    if etag not in re.findall(r'(?:W/)?"[^"]*"', if_match):
        raise mismatch()
    return True


def mismatch() -> Refused:
    """Return the error for an object that has another version."""
    message = "the object was changed meanwhile; read it again, and repeat the change with its new ETag"
    return refused(412, "PreconditionFailed", message, "If-Match")
