"""Flight code: the on-board step of law and guard as C99, with the tables of one mission (docs/on-board.md).

The sources in `sources` are the same for every mission and are reviewed as they stand; `missions` says what of a
mission goes into their tables, `spline_tables` packs the guard's field, `folder` writes all of it.
"""
