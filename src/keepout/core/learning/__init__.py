"""How a field is learned from a mesh."""
