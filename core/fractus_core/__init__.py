"""Pure domain of Fractus: kinds, geometry, planning, policy; no I/O, no clock, no Kubernetes client."""
