"""Identities: the certificate authority, and the signing of Grants."""
