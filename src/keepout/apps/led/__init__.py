"""What applications share that fly a chaser from view to view: its camera, and the flight led leg by leg."""
