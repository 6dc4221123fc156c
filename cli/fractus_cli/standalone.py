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
from fractus_runtime.files import read_file, read_json, write_file

DEFAULT_LIFE = timedelta(days=365)
"""Default validity of the certificates of nodes and components."""


def _now() -> datetime:
    return datetime.now(UTC)


class StandalonePki:
    """Certificate authority in a directory. Issues certificates of nodes and components, and signs Grants.

    Args:
        directory: Directory with the layout above.
        authority: Certificate authority of the directory.
        clock: Returns the current time.
        life: Validity of the certificates of nodes and components.
    """

    def __init__(
        self,
        directory: Path,
        authority: Authority,
        clock: Callable[[], datetime] = _now,
        life: timedelta = DEFAULT_LIFE,
    ) -> None:
        self._directory = directory
        self._authority = authority
        self._clock = clock
        self._life = life
        self._signer = GrantSigner(authority, clock)

    @classmethod
    def create(cls, directory: Path, clock: Callable[[], datetime] = _now, life: timedelta = DEFAULT_LIFE) -> Self:
        """Open a directory. Create the certificate authority if the directory has none.

        Raises:
            BrokenAuthority: The files of the authority are damaged.
        """
        if not (directory / "authority").is_dir():
            _write(directory / "authority", Authority.generate(clock()).to_data())
        return cls.open(directory, clock, life)

    @classmethod
    def open(cls, directory: Path, clock: Callable[[], datetime] = _now, life: timedelta = DEFAULT_LIFE) -> Self:
        """Open a directory.

        Raises:
            BrokenAuthority: The authority is missing or damaged.
        """
        folder = directory / "authority"
        data = _read(folder)
        if not data:
            raise BrokenAuthority(
                f"{folder}: certificate authority not found; create it with: fractus grants init {directory}"
            )
        try:
            return cls(directory, Authority.from_data(data), clock, life)
        except BrokenAuthority:
            raise BrokenAuthority(f"{folder}: tls.key and tls.crt are damaged or do not belong together") from None

    def node(self, name: str) -> Path:
        """Issue a new certificate for the services of a node. Return its directory.

        Raises:
            InvalidObject: The name is not a valid node name.
        """
        if not is_subdomain(name):
            raise InvalidObject("node", f"{name!r} is not a valid node name; use lower-case letters, digits, - and .")
        return _write(self._directory / "nodes" / name, self._authority.issue_node(name, self._clock(), self._life))

    def component(self, identity: str) -> Path:
        """Return the directory with the certificate of a component instance.

        Renew the certificate if its renewal is due.

        Args:
            identity: SPIFFE id of the instance: `GrantSpec.identity` of its Grant.

        Raises:
            InvalidObject: The identity is invalid.
        """
        parsed = ComponentIdentity.parse(identity)
        if parsed is None or not is_subdomain(parsed.namespace) or not is_subdomain(parsed.instance):
            raise InvalidObject("spec.instance", f"{identity} is not the identity of a component instance")
        folder = self._directory / "components" / f"{parsed.namespace}.{parsed.instance}"
        now = self._clock()
        if self._authority.is_current(_read(folder), identity, now):
            return folder
        return _write(folder, self._authority.issue_component(identity, now, self._life))

    def sign(self, manifest: dict[str, Any], replaces: Grant | None = None) -> dict[str, Any]:
        """Return the signed manifest of a Grant.

        Args:
            manifest: Manifest of the Grant.
            replaces: Earlier Grant that the signed Grant replaces.

        Raises:
            InvalidObject: The manifest is not a Grant.
        """
        return self._signer.sign(manifest, replaces or Grant.from_body(manifest))

    def grant(self, manifest: dict[str, Any], grants: Path) -> Path:
        """Sign a Grant and store it atomically in the directory that the services of its node read.

        Args:
            manifest: Manifest of the Grant.
            grants: Directory that the services read (their option --grants).

        Raises:
            InvalidObject: The manifest is not a Grant, does not limit the drone, or its node has no certificate.
        """
        parsed = Grant.from_body(manifest)
        name = parsed.name
        if not (self._directory / "nodes" / parsed.spec.node / "tls.crt").is_file():
            raise InvalidObject(
                "spec.node",
                f"{parsed.spec.node} has no certificate in this directory; issue it with: fractus grants init --node",
            )
        if "/" in name or name.startswith("."):
            raise InvalidObject("metadata.name", f"{name!r} is not a valid file name")
        path = grants / f"{name}.json"
        signed = self.sign(manifest, _stored(path))
        grants.mkdir(parents=True, exist_ok=True)
        write_file(path, json.dumps(signed, indent=1).encode() + b"\n", 0o640)
        return path


def _stored(path: Path) -> Grant | None:
    try:
        return Grant.from_body(read_json(path))
    except (OSError, ValueError):
        return None


def _read(folder: Path) -> Data:
    return {path.name: base64.b64encode(read_file(path)).decode() for path in folder.glob("[!.]*")}


def _write(folder: Path, data: Data) -> Path:
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    for name, content in data.items():
        write_file(folder / name, base64.b64decode(content), 0o600 if name == "tls.key" else 0o644)
    return folder
