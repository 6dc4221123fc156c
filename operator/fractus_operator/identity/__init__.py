"""Who is who: the certificate authority, the certificates of nodes, and signed Grants."""
