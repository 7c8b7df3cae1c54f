"""The independent verdict on a flight: imports neither fields, nor control, nor the flight loop."""
