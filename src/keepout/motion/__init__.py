"""Motion: orbits, relative dynamics, attitude, disturbances and actuators."""
