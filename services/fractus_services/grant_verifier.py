"""Verification of Grants: the operator's signature, and a memory of the latest Grants against replays."""

from __future__ import annotations

import hashlib
import json
import logging
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from cryptography import x509
from fractus_core.api.grants import Grant
from fractus_core.policy.grant_signatures import (
    SIGNATURE_ANNOTATION,
    SIGNER_ANNOTATION,
    BadSignature,
    UnknownAuthority,
    read_authorities,
    signed_bytes,
    verify,
)
from fractus_runtime.files import read_file, read_json, remove_temporary, write_file

log = logging.getLogger(__name__)

MAX_REMEMBERED = 5_000
"""Maximum number of remembered instances. The instances with the oldest Grants are forgotten.

A Grant of an instance that is not remembered is rejected unless it was issued after all forgotten Grants.
"""

_EPOCH = datetime.fromtimestamp(0, UTC)


@dataclass(frozen=True, slots=True)
class _Seen:
    """The latest Grant of a component instance.

    Attributes:
        issued_at: Time of the signature, ISO 8601 in UTC.
        digest: Digest of the Grant with its signature.
        revoked: True if the Grant was removed on this node.
    """

    issued_at: str
    digest: str
    revoked: bool = False


class GrantVerifier:
    """Verifies Grants, and remembers the latest one of each component instance.

    A Grant is verified once. It then stays in force even if certificates expire or the authority changes, also after a
    restart. Otherwise a drone could lose its Grant in flight. A Grant ends when its file is removed or a later Grant
    replaces it. The memory prevents replays: an old Grant has a valid signature too.

    Args:
        directory: Directory that contains ca.crt.
        memory: File that stores the latest Grants.
    """

    def __init__(self, directory: Path, memory: Path) -> None:
        self._path = directory / "ca.crt"
        self._memory = memory
        self._stamp: tuple[int, int, int] | None = None
        self._authorities: tuple[x509.Certificate, ...] = ()
        self._seen: dict[str, _Seen] = {}
        self._oldest = _iso(_EPOCH)
        self._unsaved = False
        self._failing = False
        remove_temporary(memory)
        self._restore()

    def reload_authorities(self) -> bool:
        """Read ca.crt if the file has changed. Return True if the file has changed."""
        try:
            stat = self._path.stat()
            stamp = (stat.st_mtime_ns, stat.st_size, stat.st_ino)
            if stamp == self._stamp:
                return False
            self._authorities = read_authorities(read_file(self._path))
            self._stamp = stamp
        except FileNotFoundError:
            return False
        except (OSError, ValueError) as error:
            log.critical(
                "grants: cannot read the authority, keeping the previous one (file=%s error=%s)", self._path, error
            )
            return False
        return True

    def verify(self, grant: Grant) -> str:
        """Accept a Grant as the latest of its instance, and return its digest with its signature.

        Raises:
            BadSignature: The operator did not sign the Grant, or this node has seen a later one, or has revoked it.
        """
        identity = grant.spec.identity
        digest = _digest(grant)
        seen = self._seen.get(identity)
        if seen is not None and seen.digest == digest and not seen.revoked:
            return digest
        if not self._authorities:
            raise UnknownAuthority(f"cannot check the signature because {self._path} is missing")
        issued_at = _iso(verify(grant, self._authorities))
        latest = seen.issued_at if seen is not None else self._oldest
        if issued_at <= latest:
            raise BadSignature(
                f"it was issued at {issued_at}, not after the Grant of {latest} that was "
                f"{'revoked' if seen is not None and seen.revoked else 'granted'} here; sign it again"
            )
        self._seen[identity] = _Seen(issued_at, digest)
        self._unsaved = True
        return digest

    def is_latest(self, identity: str, digest: str) -> bool:
        """Return True if a Grant is still the latest of its instance."""
        seen = self._seen.get(identity)
        return seen is not None and seen.digest == digest and not seen.revoked

    def revoke(self, identity: str, digest: str) -> None:
        """Revoke a removed Grant. From now on only a later Grant of its instance is accepted."""
        seen = self._seen.get(identity)
        if seen is not None and seen.digest == digest and not seen.revoked:
            self._seen[identity] = replace(seen, revoked=True)
            self._unsaved = True

    def unsaved(self) -> bytes | None:
        """Return the content for `store`, or None if it is stored already."""
        if not self._unsaved:
            return None
        self._limit()
        self._unsaved = False
        body = {"floor": self._oldest, "seen": {name: asdict(seen) for name, seen in self._seen.items()}}
        return json.dumps(body).encode()

    def store(self, content: bytes) -> None:
        """Write the memory file. It may be called from another thread. After a failure, the content counts as unsaved."""
        try:
            self._memory.parent.mkdir(parents=True, exist_ok=True)
            write_file(self._memory, content, 0o644)
        except OSError as error:
            if not self._failing:
                log.critical(
                    "grants: cannot write the memory, a restart would forget replaced Grants (file=%s error=%s)",
                    self._memory,
                    error,
                )
            self._failing = True
            self._unsaved = True
        else:
            self._failing = False

    def _limit(self) -> None:
        """Forget the instances with the oldest Grants."""
        surplus = len(self._seen) - MAX_REMEMBERED
        if surplus > 0:
            for identity in sorted(self._seen, key=lambda name: self._seen[name].issued_at)[:surplus]:
                self._oldest = max(self._oldest, self._seen.pop(identity).issued_at)

    def _restore(self) -> None:
        try:
            body = read_json(self._memory)
            self._seen = {str(name): _Seen(**seen) for name, seen in body["seen"].items()}
            self._oldest = str(body["floor"])
        except FileNotFoundError:
            return
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            # Rejecting all Grants would strand the drone. Signatures are still verified.
            self._seen = {}
            self._oldest = _iso(_EPOCH)
            log.critical(
                "grants: cannot read the memory, replaced Grants are forgotten (file=%s error=%s)", self._memory, error
            )


def _iso(time: datetime) -> str:
    """Return a time as text that sorts chronologically."""
    return time.astimezone(UTC).isoformat(timespec="microseconds")


def _digest(grant: Grant) -> str:
    signed = [
        grant.metadata.uid,
        *(grant.metadata.annotations.get(key) for key in (SIGNATURE_ANNOTATION, SIGNER_ANNOTATION)),
    ]
    return hashlib.sha256(json.dumps(signed).encode() + signed_bytes(grant)).hexdigest()
