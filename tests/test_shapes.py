"""Shapes that the annotations promise (jaxtyping) are those that come out, checked by beartype.

Only what carries such an annotation is checked, and by itself: hooked into every module of the package, beartype made
the tests a quarter slower, and met wrong arguments before the library's own messages did.
"""

from __future__ import annotations

from typing import get_type_hints

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from beartype import beartype
from beartype.door import is_bearable

import gsisio_jax as gx

BOX = gx.Interval([-1.0, 0.0], [1.0, 2.0])
MODEL = gx.System(lambda x: 0.5 * x, lambda x: x[:1], G=[[1.0], [0.0]], H=[[0.0]])
NOISE = gx.Noise(w=gx.Interval.symmetric([0.1, 0.1]), v=gx.Interval.symmetric([0.1]))


def bent(x):
    return jnp.stack([x[0] * x[1], jnp.sin(x[0]), x[1]])


def shapes_of(value):
    """Every annotated array of an object, with one meaning of n, m, ... for all of them."""
    hints = {name: hint for name, hint in get_type_hints(type(value)).items() if "jaxtyping.Float" in str(hint)}
    hints = dict(sorted(hints.items(), key=lambda item: "+" in str(item[1])))  # sums need their parts to be known
    with jaxtyping.jaxtyped("context"):
        return {name: is_bearable(getattr(value, name), hint) for name, hint in hints.items()}


@pytest.mark.parametrize(
    ("make", "count"),
    [
        (lambda: gx.inclusion.affine(bent)(BOX), 1),
        (lambda: gx.paper.affine_abstraction(bent, BOX), 7),
        (lambda: gx.simulate(MODEL, jax.random.key(0), [0.0, 1.0], np.zeros((4, 1)), NOISE), 4),
    ],
    ids=["affine form", "abstraction", "simulation"],
)
def test_results_have_the_shapes_of_their_annotations(make, count):
    found = shapes_of(make())
    assert found == dict.fromkeys(found, True)
    assert len(found) == count


def test_a_wrong_shape_is_found():
    form = gx.inclusion.affine(bent)(BOX)
    wrong = form.slope[0, 0]
    assert not shapes_of(type(form)(**{**vars(form), "slope": wrong}))["slope"]


def test_arguments_have_the_shapes_of_their_annotations():
    checked = jaxtyping.jaxtyped(gx.linear_image, typechecker=beartype)
    assert checked(jnp.ones((3, 2)), BOX).shape == (3,)
    with pytest.raises(jaxtyping.TypeCheckError):
        checked(jnp.ones(2), BOX)
