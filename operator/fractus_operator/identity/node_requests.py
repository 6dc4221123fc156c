"""Signs the certificates of nodes: a request is granted only to the agent that runs on the node it names."""

from __future__ import annotations

import base64
import logging
from collections.abc import Callable, Collection
from dataclasses import dataclass
from datetime import datetime

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from fractus_core.api import node_identity, node_server_name
from fractus_core.identity.authority import Authority

from fractus_operator.cluster.kinds import SIGNING_REQUEST, Body, Key
from fractus_operator.cluster.store import Conflict, NotFound, Store

logger = logging.getLogger(__name__)

NODE_NAME_CLAIM = "authentication.kubernetes.io/node-name"
"""The API server puts it into the user info of a token that is bound to a pod."""

_USAGES = frozenset({"server auth", "client auth"})
_TOLERATED_USAGES = frozenset({"digital signature"})


@dataclass(frozen=True, slots=True)
class Review:
    """Whether a request may be signed, for which node, and why not.

    Attributes:
        node: set when it may be signed.
        request: the parsed request, when it may be signed.
    """

    reason: str
    message: str
    node: str | None = None
    request: x509.CertificateSigningRequest | None = None


class Refused(Exception):
    """A request is not of the kind that this signer signs."""

    def __init__(self, reason: str, message: str) -> None:
        self.reason = reason
        super().__init__(message)


def review(body: Body, agents: Collection[str]) -> Review:
    """Review a CertificateSigningRequest of the signer fractus.dev/node.

    Args:
        body: The request, with what the API server adds about its requester.
        agents: User names of the agents' service accounts.
    """
    spec = body["spec"]
    if spec.get("username") not in agents:
        return Review("WrongRequester", f"{spec.get('username')} is not the agent ({', '.join(sorted(agents))})")
    nodes = (spec.get("extra") or {}).get(NODE_NAME_CLAIM) or []
    if len(nodes) != 1:
        return Review("NotNodeBound", "the requester's token is not bound to a pod on a node")
    node = nodes[0]
    usages = set(spec.get("usages") or ())
    if not usages >= _USAGES or usages - _USAGES - _TOLERATED_USAGES:
        return Review("WrongUsages", f"usages must be server auth and client auth, not {', '.join(sorted(usages))}")
    try:
        request, asked = _read(spec["request"])
    except Refused as refused:
        return Review(refused.reason, str(refused))
    wanted = {(x509.UniformResourceIdentifier, node_identity(node)), (x509.DNSName, node_server_name(node))}
    if asked != wanted:
        listed = ", ".join(sorted(str(value) for _, value in asked))
        return Review("WrongNames", f"the agent of {node} may ask for the names of {node} only, not for {listed}")
    return Review("NodeAgent", f"the agent on {node} asks for its own certificate", node, request)


def _read(encoded: str) -> tuple[x509.CertificateSigningRequest, frozenset[tuple[type[x509.GeneralName], object]]]:
    """Parse a request that proves possession of a P-256 key and has alternative names; the request and the names.

    Raises:
        Refused: it is not of that kind.
    """
    try:
        request = x509.load_pem_x509_csr(base64.b64decode(encoded, validate=True))
        key = request.public_key()
        names = request.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        asked = frozenset((type(name), name.value) for name in names)
        genuine = request.is_signature_valid
    except x509.ExtensionNotFound:
        raise Refused("WrongNames", "the request has no subject alternative names") from None
    except Exception as error:
        raise Refused("Malformed", f"the request cannot be read: {error or type(error).__name__}") from error
    if not genuine:
        raise Refused("Malformed", "the request is not signed with its own key")
    if not isinstance(key, ec.EllipticCurvePublicKey) or not isinstance(key.curve, ec.SECP256R1):
        raise Refused("WrongKey", "the key must be P-256")
    return request, asked


class NodeSigning:
    """Approves, denies and signs requests of the signer fractus.dev/node."""

    def __init__(
        self,
        store: Store,
        read: Callable[[Key], Body | None],
        authority: Authority,
        agents: Collection[str],
        clock: Callable[[], datetime],
    ) -> None:
        self._store = store
        self._read = read
        self._authority = authority
        self._agents = agents
        self._clock = clock

    async def reconcile(self, key: Key) -> None:
        """Bring one request to its end: denied with the reason, or approved and signed.

        An approved request is reviewed, too: others may approve requests.
        """
        body = self._read(key)
        if body is None:
            return
        status = body.get("status") or {}
        conditions = {c["type"] for c in status.get("conditions") or ()}
        if status.get("certificate") or conditions & {"Denied", "Failed"}:
            return
        reviewed = review(body, self._agents)
        try:
            if "Approved" not in conditions:
                verdict = "Approved" if reviewed.node is not None else "Denied"
                body = await self._conclude(body, verdict, reviewed, "approval")
            if reviewed.node is not None and reviewed.request is not None:
                certificate = self._authority.sign_node(reviewed.request, reviewed.node, self._clock())
                status = {**(body.get("status") or {}), "certificate": base64.b64encode(certificate).decode()}
                await self._store.replace(SIGNING_REQUEST, {**body, "status": status}, subresource="status")
                logger.info("node requests: certificate signed (node=%s request=%s)", reviewed.node, key[1])
            elif "Approved" in conditions:
                # Another approved what this signer does not sign.
                await self._conclude(body, "Failed", reviewed, "status")
        except (Conflict, NotFound):
            # It changed or went meanwhile: the watch brings the newer one.
            return

    async def _conclude(self, body: Body, verdict: str, reviewed: Review, subresource: str) -> Body:
        """Write a condition of the type `verdict`."""
        level = logging.WARNING if verdict == "Failed" else logging.INFO
        name = body["metadata"]["name"]
        logger.log(level, "node requests: %s (request=%s): %s", verdict.lower(), name, reviewed.message)
        stamp = self._clock().strftime("%Y-%m-%dT%H:%M:%SZ")
        condition = {
            "type": verdict,
            "status": "True",
            "reason": reviewed.reason,
            "message": reviewed.message,
            "lastUpdateTime": stamp,
            "lastTransitionTime": stamp,
        }
        status = body.get("status") or {}
        status = {**status, "conditions": [*(status.get("conditions") or ()), condition]}
        return await self._store.replace(SIGNING_REQUEST, {**body, "status": status}, subresource=subresource)
