"""The replay: flights around one target as a page of its own that needs no network and no installation to open."""
