"""Whether a Grant is the operator's, and the latest one: its signature, and a memory against replays."""

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
from fractus_runtime.files import remove_temporary, write_file

log = logging.getLogger(__name__)

MAX_REMEMBERED = 5_000
"""Instances that are remembered one by one; older ones share one date, and no grant issued before it counts."""

_EPOCH = datetime.fromtimestamp(0, UTC)


@dataclass(frozen=True, slots=True)
class _Seen:
    """The latest grant of an instance.

    Attributes:
        issued_at: when it was signed, ISO 8601 in UTC.
        digest: of the grant with its signature.
        revoked: it was removed on this node and no longer counts.
    """

    issued_at: str
    digest: str
    revoked: bool = False


class GrantVerifier:
    """Verifies grants and remembers the latest one of each instance.

    A grant is verified once. It stays in force, also over a restart, when certificates expire or the authority changes
    meanwhile: a drone in flight must not lose its grant to a date. It ends when its file goes, or when a later one takes
    its place. The memory is what stops a replay: an old grant has a valid signature too.

    Args:
        directory: where ca.crt is.
        memory: file that remembers the grants seen on this node.
    """

    def __init__(self, directory: Path, memory: Path) -> None:
        self._path = directory / "ca.crt"
        self._memory = memory
        self._stamp: tuple[int, int, int] | None = None
        self._authorities: tuple[x509.Certificate, ...] = ()
        self._seen: dict[str, _Seen] = {}
        self._oldest = _iso(_EPOCH)
        self._unsaved = self._failing = False
        remove_temporary(memory)
        self._restore()

    def reload_authorities(self) -> bool:
        """Read ca.crt if it changed; True if it did."""
        try:
            stat = self._path.stat()
            stamp = (stat.st_mtime_ns, stat.st_size, stat.st_ino)
            if stamp == self._stamp:
                return False
            self._authorities = read_authorities(self._path.read_bytes())
            self._stamp = stamp
        except FileNotFoundError:
            return False
        except (OSError, ValueError) as error:
            log.critical("grants: cannot read the authority, keeping the previous one (file=%s): %s", self._path, error)
            return False
        return True

    def verify(self, grant: Grant) -> str:
        """Accept a grant as the latest of its instance; returns the digest of it with its signature.

        Raises:
            BadSignature: the operator did not sign it, a later one was seen here, or it was revoked here.
        """
        identity, digest = grant.spec.identity, _digest(grant)
        seen = self._seen.get(identity)
        if seen is not None and seen.digest == digest and not seen.revoked:
            return digest
        if not self._authorities:
            raise UnknownAuthority(f"there is no {self._path} to check its signature by")
        issued_at = _iso(verify(grant, self._authorities))
        latest = seen.issued_at if seen is not None else self._oldest
        if issued_at <= latest:
            raise BadSignature(
                f"it was issued at {issued_at}, and not after the one of {latest} that was "
                f"{'revoked' if seen is not None and seen.revoked else 'granted'} here; sign it again"
            )
        self._seen[identity] = _Seen(issued_at, digest)
        self._unsaved = True
        return digest

    def is_latest(self, identity: str, digest: str) -> bool:
        """Whether a grant is still the latest one of its instance."""
        seen = self._seen.get(identity)
        return seen is not None and seen.digest == digest and not seen.revoked

    def revoke(self, identity: str, digest: str) -> None:
        """A grant was removed: from now on only a later one of its instance counts."""
        seen = self._seen.get(identity)
        if seen is not None and seen.digest == digest and not seen.revoked:
            self._seen[identity] = replace(seen, revoked=True)
            self._unsaved = True

    def unsaved(self) -> bytes | None:
        """Content for `store`; None when it is stored already."""
        if not self._unsaved:
            return None
        self._limit()
        self._unsaved = False
        body = {"floor": self._oldest, "seen": {name: asdict(seen) for name, seen in self._seen.items()}}
        return json.dumps(body).encode()

    def store(self, content: bytes) -> None:
        """Write the memory; may be called from another thread. What cannot be written is unsaved again."""
        try:
            self._memory.parent.mkdir(parents=True, exist_ok=True)
            write_file(self._memory, content, 0o644)
        except OSError as error:
            if not self._failing:
                log.critical(
                    "grants: cannot write the memory, a restart would forget replaced grants (file=%s): %s",
                    self._memory,
                    error,
                )
            self._failing = self._unsaved = True
        else:
            self._failing = False

    def _limit(self) -> None:
        """Keep the instances that were granted last."""
        surplus = len(self._seen) - MAX_REMEMBERED
        if surplus > 0:
            for identity in sorted(self._seen, key=lambda name: self._seen[name].issued_at)[:surplus]:
                self._oldest = max(self._oldest, self._seen.pop(identity).issued_at)

    def _restore(self) -> None:
        try:
            body = json.loads(self._memory.read_bytes())
            self._seen = {str(name): _Seen(**seen) for name, seen in body["seen"].items()}
            self._oldest = str(body["floor"])
        except FileNotFoundError:
            return
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            # Refusing every grant from now on would strand the drone; signatures are still verified.
            self._seen, self._oldest = {}, _iso(_EPOCH)
            log.critical(
                "grants: the memory cannot be read, replaced grants are forgotten (file=%s): %s", self._memory, error
            )


def _iso(moment: datetime) -> str:
    """A moment as text that sorts like it."""
    return moment.astimezone(UTC).isoformat(timespec="microseconds")


def _digest(grant: Grant) -> str:
    signed = [
        grant.metadata.uid,
        *(grant.metadata.annotations.get(key) for key in (SIGNATURE_ANNOTATION, SIGNER_ANNOTATION)),
    ]
    return hashlib.sha256(json.dumps(signed).encode() + signed_bytes(grant)).hexdigest()
