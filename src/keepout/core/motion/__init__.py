"""Motion of the chaser relative to the target: orbit, attitude, forces."""
