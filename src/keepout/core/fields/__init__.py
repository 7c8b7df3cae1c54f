"""Fields: signed distances that are cheap, twice differentiable, and known to within a bound."""
