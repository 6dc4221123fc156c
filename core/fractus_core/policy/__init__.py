"""Policies and plan to Grant; call, situation and Grant to Verdict."""
