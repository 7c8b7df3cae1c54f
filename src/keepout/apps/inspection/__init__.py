"""Inspection: see all of a target that can be seen, in light, without touching it."""
