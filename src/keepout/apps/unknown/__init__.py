"""Explore a target that nobody has a model of: see it, map what is free, fly there, and go on."""
