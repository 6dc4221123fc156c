"""The field experiment: a driver and a passenger, flown normally, against policies, and without policies."""
