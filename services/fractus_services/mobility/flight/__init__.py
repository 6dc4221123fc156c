"""Flights: motions, transit, return, missions over points of interest, and the monitor."""
