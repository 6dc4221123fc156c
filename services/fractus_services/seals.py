"""Whether a Grant is the operator's word, and its last one: signatures, and a memory against replays."""

from __future__ import annotations

import hashlib
import json
import logging
import os
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from cryptography import x509
from fractus_core.api.plans import Grant
from fractus_core.policy.signatures import (
    SIGNATURE_ANNOTATION,
    SIGNER_ANNOTATION,
    BadSignature,
    UnknownAuthority,
    canonical,
    read_authorities,
    verify,
)

log = logging.getLogger(__name__)

MOST_KNOWN = 5_000
"""So many instances are remembered; for older ones there is one date before which nothing counts."""

_EPOCH = datetime.fromtimestamp(0, UTC)


@dataclass(frozen=True, slots=True)
class _Seen:
    """The last grant of an instance.

    Attributes:
        issued_at: when it was signed, ISO 8601 in UTC.
        digest: of the grant with its signature.
        revoked: it was taken away on this node, and counts no more.
    """

    issued_at: str
    digest: str
    revoked: bool = False


class Seals:
    """Judges where grants come from.

    A grant is verified once. It goes on to hold, over a restart too, when certificates expire or the authority changes
    meanwhile; it ends when its file goes, or when a later one takes its place.

    Args:
        directory: where ca.crt is.
        memory: file of what was seen here, so that no older grant comes back.
    """

    def __init__(self, directory: Path, memory: Path) -> None:
        self._path = directory / "ca.crt"
        self._memory = memory
        self._stamp: tuple[int, int, int] | None = None
        self._authorities: tuple[x509.Certificate, ...] = ()
        self._seen: dict[str, _Seen] = {}
        self._floor = _iso(_EPOCH)
        self._unsaved = self._failing = False
        self._recall()

    def renewed(self) -> bool:
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
            log.critical("cannot read %s, keeping to the authority known before: %s", self._path, error)
            return False
        return True

    def check(self, grant: Grant) -> str:
        """Take a grant as the last one of its instance; the digest of it with its signature.

        Raises:
            BadSignature: the operator did not sign it, or there was a later one here, or it was revoked here.
        """
        identity, digest = grant.spec.identity, _digest(grant)
        seen = self._seen.get(identity)
        if seen is not None and seen.digest == digest and not seen.revoked:
            return digest
        if not self._authorities:
            raise UnknownAuthority(f"there is no {self._path} to check its signature by")
        issued_at = _iso(verify(grant, self._authorities))
        last = seen.issued_at if seen is not None else self._floor
        if issued_at <= last:
            raise BadSignature(
                f"it was issued at {issued_at}, and not after the one of {last} that was "
                f"{'revoked' if seen is not None and seen.revoked else 'granted'} here; sign it again"
            )
        self._seen[identity] = _Seen(issued_at, digest)
        self._unsaved = True
        return digest

    def holds(self, identity: str, digest: str) -> bool:
        """Whether a grant is still the last one of its instance."""
        seen = self._seen.get(identity)
        return seen is not None and seen.digest == digest and not seen.revoked

    def revoke(self, identity: str, digest: str) -> None:
        """A grant was taken away: only a later one of its instance counts from now on."""
        seen = self._seen.get(identity)
        if seen is not None and seen.digest == digest and not seen.revoked:
            self._seen[identity] = replace(seen, revoked=True)
            self._unsaved = True

    def unsaved(self) -> bytes | None:
        """What is to be stored, for `store`; None when it is stored already."""
        if not self._unsaved:
            return None
        self._forget()
        self._unsaved = False
        body = {"floor": self._floor, "seen": {name: asdict(seen) for name, seen in self._seen.items()}}
        return json.dumps(body).encode()

    def store(self, content: bytes) -> None:
        """Have it on disk; may be called from another thread. What cannot be written is unsaved again."""
        fresh = self._memory.with_name(f".{self._memory.name}.new")
        try:
            self._memory.parent.mkdir(parents=True, exist_ok=True)
            with fresh.open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            fresh.replace(self._memory)
        except OSError as error:
            if not self._failing:
                log.critical("cannot write %s: a restart would forget which grants were replaced: %s", fresh, error)
            self._failing = self._unsaved = True
        else:
            self._failing = False

    def _forget(self) -> None:
        """Keep the instances that were granted last."""
        surplus = len(self._seen) - MOST_KNOWN
        if surplus > 0:
            for identity in sorted(self._seen, key=lambda name: self._seen[name].issued_at)[:surplus]:
                self._floor = max(self._floor, self._seen.pop(identity).issued_at)

    def _recall(self) -> None:
        try:
            body = json.loads(self._memory.read_bytes())
            self._seen = {str(name): _Seen(**seen) for name, seen in body["seen"].items()}
            self._floor = str(body["floor"])
        except FileNotFoundError:
            return
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            # To refuse every grant from now on would strand the drone; their signatures are checked all the same.
            self._seen, self._floor = {}, _iso(_EPOCH)
            log.critical("%s cannot be read, so it is forgotten which grants were replaced: %s", self._memory, error)


def _iso(moment: datetime) -> str:
    """A moment as text that sorts like it."""
    return moment.astimezone(UTC).isoformat(timespec="microseconds")


def _digest(grant: Grant) -> str:
    said = [
        grant.metadata.uid,
        *(grant.metadata.annotations.get(key) for key in (SIGNATURE_ANNOTATION, SIGNER_ANNOTATION)),
    ]
    return hashlib.sha256(json.dumps(said).encode() + canonical(grant)).hexdigest()
