"""What is known of the motion: sensors, an estimate for the law, and a set around the truth for the guard."""
