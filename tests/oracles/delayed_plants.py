"""Linear plants whose unknown input shows one step or more after it acts: (A, C, G, H_whole / 10, w, v, x0), radii."""

import numpy as np

_MASS = np.array([[1, 0.1], [-0.4, 0.96]])
_TWO = np.eye(4) + 0.1 * np.array([[0, 1, 0, 0], [-4, -0.4, 2, 0], [0, 0, 0, 1], [2, 0, -4, -0.4]])
_MIXED = np.array([[0.8, 0.1, 0, 0], [-0.1, 0.7, 0.05, 0], [0, 0, 1, 0.1], [0.05, 0, -0.4, 0.96]])
_SHORT = np.array([[0.8, 0.1, 0], [-0.1, 1, 0.1], [0.05, -0.4, 0.96]])
_FORCE = np.array([[0.0], [0.1], [0.0], [0.0]])
_BOTH = np.array([[1.0, 0.0], [0.3, 0.0], [0.2, 0.0], [0.0, 0.1]])
_SUM = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [1, 1, 0, 0]])
_OUT = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0]])

# name: the plant, and the delay that it needs.
PLANTS = {
    # A force on a mass on a spring, its position measured.
    "spring": ((_MASS, np.eye(1, 2), _FORCE[:2], np.zeros((1, 1)), [1e-3, 1e-2], [0.01], [1.0, 1.0]), 1),
    # Position-only tracking of an unknown acceleration.
    "tracking": (
        (np.array([[1, 0.1], [0, 1]]), np.eye(1, 2), _FORCE[:2], np.zeros((1, 1)), [1e-3, 1e-3], [0.1], [1.0, 1.0]), 1,
    ),
    # Two masses; both positions measured, or that of the mass that the force does not act on.
    "masses": ((_TWO, np.eye(4)[[0, 2]], _FORCE, np.zeros((2, 1)), [1e-3, 1e-2] * 2, [0.01] * 2, [1.0] * 4), 1),
    "far mass": ((_TWO, np.eye(4)[[2]], _FORCE, np.zeros((1, 1)), [1e-4, 1e-3] * 2, [1e-3], [1.0] * 4), 3),
    # Two inputs: the first shows in the next step, in both outputs that the second needs, the second one step later.
    "orders": (
        (_MIXED, _SUM, _BOTH, np.zeros((3, 2)), [0.01] * 4,
         [0.05, 0.02, 0.05], [1.0] * 4), 1,
    ),
    # The same with three states and two outputs.
    "short orders": (
        (_SHORT, np.eye(2, 3), _BOTH[[0, 2, 3]], np.zeros((2, 2)), [0.01] * 3, [0.05, 0.02], [1.0] * 3), 1,
    ),
    # The first shows at once.
    "at once": (
        (_MIXED, _OUT, _BOTH, np.array([[5.0, 0], [1, 0], [0, 0]]), [0.01] * 4, [0.05, 0.02, 0.05], [1.0] * 4), 1,
    ),
}  # fmt: skip
