"""Exploring a target that nobody has a model of: which view next, the flight that takes them, and what was found."""
