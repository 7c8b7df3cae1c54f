"""An environment for learning: episodes of a mission, steered by an agent, one or many at once (docs/own-parts.md)."""
