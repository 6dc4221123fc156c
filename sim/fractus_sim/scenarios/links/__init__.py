"""The links scenario: real pods on real nodes over a simulated radio (thesis 8.9.3, Fig. 8.12 and 8.13)."""
