"""Direct links of a node: discovery, pairing by node certificates, link and path decisions, and status."""
