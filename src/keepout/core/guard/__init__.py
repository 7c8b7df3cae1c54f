"""The hard layer: accepts or replaces every commanded force, by a field of its own, under a theorem."""
