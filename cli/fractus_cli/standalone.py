"""Keys, certificates and signed Grants in a directory, for services that run without Kubernetes.

DIR/authority/                  tls.crt, tls.key    keep the key off the drone
DIR/nodes/NODE/                 tls.crt, tls.key, ca.crt    --tls of the node's services
DIR/components/INSTANCE/        tls.crt, tls.key, ca.crt    FRACTUS_TLS_DIR of the component
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Self

from fractus_core.api import Grant, InvalidObject
from fractus_core.api.names import ComponentIdentity, is_subdomain
from fractus_core.identity.authority import Authority, BrokenAuthority, Data
from fractus_core.identity.grant_signer import GrantSigner
from fractus_runtime.files import write_file

LIFE = timedelta(days=365)


def _now() -> datetime:
    return datetime.now(UTC)


class StandalonePki:
    """A certificate authority in a directory, and what it issues.

    Args:
        directory: The directory, as above.
        authority: Its authority.
        clock: The present time.
        life: How long the certificates of nodes and components are valid.
    """

    def __init__(
        self, directory: Path, authority: Authority, clock: Callable[[], datetime] = _now, life: timedelta = LIFE
    ) -> None:
        self._directory = directory
        self._authority = authority
        self._clock = clock
        self._life = life
        self._signer = GrantSigner(authority, clock)

    @classmethod
    def create(cls, directory: Path, clock: Callable[[], datetime] = _now, life: timedelta = LIFE) -> Self:
        """Make the authority of a directory, once; later calls open it.

        Raises:
            BrokenAuthority: its files are damaged.
        """
        if not (directory / "authority").is_dir():
            _write(directory / "authority", Authority.generate(clock()).to_data())
        return cls.open(directory, clock, life)

    @classmethod
    def open(cls, directory: Path, clock: Callable[[], datetime] = _now, life: timedelta = LIFE) -> Self:
        """Open the directory.

        Raises:
            BrokenAuthority: it has no authority, or a damaged one.
        """
        folder = directory / "authority"
        data = _read(folder)
        if not data:
            raise BrokenAuthority(f"{folder}: there is no authority; make one with: fractus grants init {directory}")
        try:
            return cls(directory, Authority.from_data(data), clock, life)
        except BrokenAuthority:
            raise BrokenAuthority(f"{folder}: tls.key and tls.crt are damaged or do not belong together") from None

    def node(self, name: str) -> Path:
        """The directory with the certificate of a node's services, made again.

        Raises:
            InvalidObject: the name is none that a node can have.
        """
        if not is_subdomain(name):
            raise InvalidObject("node", f"{name!r} is no name of a node; use lower-case letters, digits, - and .")
        return _write(self._directory / "nodes" / name, self._authority.issue_node(name, self._clock(), self._life))

    def component(self, identity: str) -> Path:
        """The directory with the certificate of a component instance; made again when it is due for renewal.

        Args:
            identity: Its SPIFFE id; `GrantSpec.identity` of its grant.

        Raises:
            InvalidObject: its parts are no names.
        """
        found = ComponentIdentity.parse(identity)
        if found is None or not is_subdomain(found.namespace) or not is_subdomain(found.instance):
            raise InvalidObject("spec.instance", f"{identity} does not name an instance of a component")
        folder = self._directory / "components" / f"{found.namespace}.{found.instance}"
        now = self._clock()
        if self._authority.is_current(_read(folder), identity, now):
            return folder
        return _write(folder, self._authority.issue_component(identity, now, self._life))

    def sign(self, manifest: dict[str, Any], replaces: Grant | None = None) -> dict[str, Any]:
        """The manifest of a Grant, signed.

        Args:
            manifest: The Grant.
            replaces: One that this one is to count before.

        Raises:
            InvalidObject: the manifest is no Grant.
        """
        return self._signer.sign(manifest, replaces or Grant.from_body(manifest))

    def grant(self, manifest: dict[str, Any], grants: Path) -> Path:
        """Sign a Grant and put it, in one step, where the services of its node look for it.

        Args:
            manifest: The Grant.
            grants: The services' --grants.

        Raises:
            InvalidObject: the manifest is no Grant, bounds no drone, or is for a node without a certificate.
        """
        wanted = Grant.from_body(manifest)
        name = wanted.name
        if not (self._directory / "nodes" / wanted.spec.node / "tls.crt").is_file():
            raise InvalidObject(
                "spec.node", f"{wanted.spec.node} has no certificate here; make one with: fractus grants init --node"
            )
        if "/" in name or name.startswith("."):
            raise InvalidObject("metadata.name", f"{name!r} is no name of a file")
        path = grants / f"{name}.json"
        signed = self.sign(manifest, _present(path))
        grants.mkdir(parents=True, exist_ok=True)
        write_file(path, json.dumps(signed, indent=1).encode() + b"\n", 0o640)
        return path


def _present(path: Path) -> Grant | None:
    try:
        return Grant.from_body(json.loads(path.read_bytes()))
    except (OSError, ValueError):
        return None


def _read(folder: Path) -> Data:
    return {path.name: base64.b64encode(path.read_bytes()).decode() for path in folder.glob("[!.]*")}


def _write(folder: Path, data: Data) -> Path:
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    for name, content in data.items():
        write_file(folder / name, base64.b64decode(content), 0o600 if name == "tls.key" else 0o644)
    return folder
