"""What is proved of a field: error bounds where the chaser touches, and bounds of the slope."""
