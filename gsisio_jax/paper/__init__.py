"""The paper (Khajenejad and Yong, simultaneous input and state interval observers) by its own names.

    Prop. 1                 paper.affine_abstraction
    Prop. 2, Lemma 1        paper.linear_image
    Def. 3, Prop. 3         paper.decomposition_function, paper.decomposition
    Corollary 1             paper.bound, and ``bounds=`` of `gsisio_jax.design_observer`
    Lemma 2                 paper.lipschitz_constants
    Lemma 3                 paper.framer_gains (N_ij); exact boxes of the input are in the observer of the current form
    Theorem 1               paper.framer_gains, ``gsisio_jax.design_observer(..., form="prediction")``
    Lemma 4                 ``Estimate.current_input``
    Theorem 2               paper.stability
    Lemma 5                 paper.width_bounds
    Algorithm 1             paper.gsisio
    Illustrative Example    paper.example: every printed number beside the computed one
    Figures 2 and 3         paper.figures

Everything as printed and as corrected. What is wrong in print is in `paper.example.FINDINGS` (P1 to P13), and with
numbers and pictures in the output of ``gsisio reproduce``.
"""

from gsisio_jax.design.abstraction import affine_abstraction
from gsisio_jax.design.framer import FramerGains, framer_gains
from gsisio_jax.inclusion.intersection import bound
from gsisio_jax.inclusion.mixed_monotone import decomposition, decomposition_function
from gsisio_jax.interval.image import linear_image
from gsisio_jax.paper import example, figures
from gsisio_jax.paper.algorithm import Gsisio, gsisio
from gsisio_jax.paper.lipschitz import PRINTED, LipschitzConstants, lipschitz_constants
from gsisio_jax.paper.stability import Stability, stability
from gsisio_jax.paper.widths import WidthBounds, width_bounds

__all__ = [
    "PRINTED",
    "FramerGains",
    "Gsisio",
    "LipschitzConstants",
    "Stability",
    "WidthBounds",
    "affine_abstraction",
    "bound",
    "decomposition",
    "decomposition_function",
    "example",
    "figures",
    "framer_gains",
    "gsisio",
    "linear_image",
    "lipschitz_constants",
    "stability",
    "width_bounds",
]
