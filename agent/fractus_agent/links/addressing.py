"""IPv4 addresses on direct links: link-local ones that follow from the node's name, so that none has to be agreed on.

The kernel's address translation needs IPv4, and IPv6 link-local addresses cannot be its targets. Two names that fall on one
address are noticed when they pair: the certificate that answers there is another node's.
"""

from __future__ import annotations

import hashlib
from ipaddress import IPv4Address

_FIRST = int(IPv4Address("169.254.1.0"))
_COUNT = 254 * 256
"""RFC 3927 reserves the first and last 256 addresses of 169.254.0.0/16."""


def link_address(node: str) -> IPv4Address:
    """The address of a node on its direct links."""
    number = int.from_bytes(hashlib.sha256(node.encode()).digest()[:4], "big")
    return IPv4Address(_FIRST + number % _COUNT)
