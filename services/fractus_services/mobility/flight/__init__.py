"""Flying: motions, transit, tours, the way home, and the monitor of what is flown."""
