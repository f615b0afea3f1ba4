"""Which of two objects hides the other, and an order to paint them in.

Two convex objects that do not meet are parted by a plane, and the one on the camera's side of it
cannot be hidden by the other. Planes of faces are tried (as in Newell, Newell and Sancha, "A
solution to the hidden surface problem", ACM 1972), then the distances of the middles decide.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from systems.drawing.layers import Drawing

_TOUCH = 1e-6  # m that objects may reach through a plane that parts them


def paint_order(drawings: Sequence[Drawing]) -> list[int]:
    """Returns the order in which to paint: what hides comes after what it hides.

    Objects that hide one another in a ring are broken open at the farthest.
    """
    boxes = [drawing.box for drawing in drawings]
    distances = [float(np.linalg.norm(d.points.mean(axis=0))) - d.radius for d in drawings]
    under: list[set[int]] = [set() for _ in drawings]  # what must be painted before each
    for j, b in enumerate(boxes):
        for i, a in enumerate(boxes[:j]):
            if min(a.right, b.right) <= max(a.left, b.left):
                continue
            if min(a.bottom, b.bottom) <= max(a.top, b.top):
                continue
            nearer = _nearer(drawings[i], drawings[j])
            if nearer == 0:
                nearer = 1 if distances[i] < distances[j] else -1
            if nearer > 0:
                under[i].add(j)
            else:
                under[j].add(i)
    left = sorted(range(len(drawings)), key=lambda k: -distances[k])
    order: list[int] = []
    while left:
        free = next((k for k in left if under[k].isdisjoint(left)), left[0])
        left.remove(free)
        order.append(free)
    return order


def _nearer(a: Drawing, b: Drawing) -> int:
    """Returns 1 when `a` may hide `b`, -1 when `b` may hide `a`, 0 when no plane parts them."""
    for one, other, sign in ((a, b, -1), (b, a, 1)):
        lowest = (one.normals @ other.points.T).min(axis=1, initial=np.inf) - other.radius
        parting = lowest >= one.heights - _TOUCH
        # The camera is in the origin: with `other` before a face that it sees, with `one` behind
        # a face that it does not see.
        if (parting & (one.heights < 0)).any():
            return sign
        if (parting & (one.heights >= 0)).any():
            return -sign
    return 0
