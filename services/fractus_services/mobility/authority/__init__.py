"""Who may command the vehicle: control, leases, permits, arming, and the journal of missions."""
