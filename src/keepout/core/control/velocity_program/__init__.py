"""The cone program behind the safe velocity, and its solvers."""
