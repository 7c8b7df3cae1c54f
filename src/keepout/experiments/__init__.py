"""Experiments: the source paper's cases and comparisons, each from scenario to result."""
