"""The cells that a grid field is made of, by plain enumeration."""

import numpy as np

from keepout.fields.grid import BLOCK


def used_cells(field):
    """Lower corners (n, 3) and sides (n,) in metres, and (level, node) rows, of every cell that no finer one is in."""
    origin, spacing = np.asarray(field.origin), float(field.spacing)
    tables = [np.asarray(table) for table in field.tables]
    steps = np.argwhere(np.ones((BLOCK, BLOCK, BLOCK), bool))
    rows = []
    for level, table in enumerate(tables):
        node = (BLOCK * np.argwhere(table >= 0)[:, None, :] + steps).reshape(-1, 3)
        if level > 0:
            node = node[tables[level - 1][tuple((2 * node // BLOCK).T)] < 0]
        rows.append(np.column_stack([np.full(len(node), level), node]))
    key = np.concatenate(rows)
    side = spacing * 2.0 ** key[:, 0]
    return origin + side[:, None] * key[:, 1:], side, key
