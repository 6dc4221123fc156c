"""The mobility service: policy-checked motion of one drone."""
