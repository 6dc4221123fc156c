"""Who is who: the certificate authority, and the signatures of Grants."""
