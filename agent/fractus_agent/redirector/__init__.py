"""Moves application traffic between the cloud path and a direct link: one nftables table of ours on each node."""
