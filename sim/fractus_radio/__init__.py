"""Simulated radio between nodes that are network namespaces: 802.11g ad hoc by airtime and range, and a mobile uplink."""
