"""Places in a frame between the nodes of a lattice, compiled by numba: one pass, no temporary planes."""

from __future__ import annotations

import numpy as np

from engine.runtime.jit import compiled, inlined


@compiled("(f4[:, :, ::1], f4, f4, f4[:, ::1], f4[:, ::1], u1[:, ::1])")
def places_between_nodes(nodes, last_x, last_y, x_px, y_px, inside):
    """Interpolate a lattice at every pixel of a picture, bilinear from corner to corner.

    Args:
        nodes: (n, n, 3) float32 place x and y in the frame, and 1 where the frame can show it, else 0.
        last_x: of the frame's columns.
        last_y: of its rows.
        x_px: (h, w) float32 takes the places.
        y_px: (h, w) float32 likewise.
        inside: (h, w) uint8 takes 1 where the place is in the frame and all nodes around can be shown, else 0.
    """
    height, width = x_px.shape
    across, down = _steps(len(nodes), width), _steps(len(nodes), height)
    line, zero = np.empty((2, len(nodes)), np.float32), np.float32(0)
    ahead = np.empty(len(nodes) - 1, np.bool_)  # between a node and the next
    for row in range(height):
        top, share = down[0][row], down[1][row]
        for k in range(2):
            for n in range(len(nodes)):
                line[k, n] = nodes[top, n, k] + share * (nodes[top + 1, n, k] - nodes[top, n, k])
        for n in range(len(nodes) - 1):
            above = min(nodes[top, n, 2], nodes[top, n + 1, 2])
            ahead[n] = min(above, min(nodes[top + 1, n, 2], nodes[top + 1, n + 1, 2])) > zero
        x, y, shown = x_px[row], y_px[row], inside[row]
        _along(line[0], across, x)
        _along(line[1], across, y)
        for c in range(width):
            in_frame = (x[c] >= zero) & (x[c] <= last_x) & (y[c] >= zero) & (y[c] <= last_y)
            shown[c] = in_frame & ahead[across[0][c]]


@inlined
def _steps(nodes, count):
    """For each of ``count`` pixels from end to end the node before it, and its share of the way to the next."""
    first, share = np.empty(count, np.int64), np.empty(count, np.float32)
    for n in range(count):
        at = n * (nodes - 1) / max(count - 1, 1)
        first[n] = min(int(at), nodes - 2)
        share[n] = at - first[n]
    return first, share


@inlined
def _along(line, steps, out):
    first, share = steps
    for c in range(out.size):
        low = line[first[c]]
        out[c] = low + share[c] * (line[first[c] + 1] - low)
