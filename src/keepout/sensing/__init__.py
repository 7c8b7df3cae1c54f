"""What is known of the motion: sensors, an estimate for the law, and a set that surely holds the truth for the guard."""
