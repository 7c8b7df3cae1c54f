"""Many flights of one scenario with whatever varies drawn anew for each: streamed to a folder, resumed, replayed."""
