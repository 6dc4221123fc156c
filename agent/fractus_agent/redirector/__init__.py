"""Redirects application traffic between the cloud path and a direct link, with one nftables table per node."""
