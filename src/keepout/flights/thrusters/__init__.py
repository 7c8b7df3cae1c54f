"""Thrusters as they are: where each sits and pushes, which fire for a force, when, and what they can give."""
