"""How good a field is: on the surface, off it, its level sets, its volume."""
