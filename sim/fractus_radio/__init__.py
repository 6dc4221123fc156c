"""Simulated radio between nodes in network namespaces: an 802.11g ad hoc network and a mobile uplink."""
