"""Control authority: control state, leases, arming, failsafes, and the journal of missions."""
