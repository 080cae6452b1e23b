"""A step does not grow unnoticed: equations of its scalar program, stage by stage, against `budget.json`.

Where growth is meant, or a step has shrunk: ``python -m benchmarks.size --write``.
"""

from functools import cache

import pytest
import sizes

MOST_S1 = 3500
"""Equations of a step of the paper's example, rounded outward."""

SOLVER = 1.005, 4
"""Which entries of a gain are zero or one, and cost nothing, depends on the last digits of its solver: another version
of it, or another processor, may need a few equations more. Relative and absolute."""

step = cache(sizes.Step)


@pytest.mark.parametrize("variant", sizes.VARIANTS)
@pytest.mark.parametrize("name", sizes.SYSTEMS)
def test_no_stage_outgrows_its_budget(name: str, variant: str) -> None:
    budget = sizes.recorded()[sizes.key(name, variant)]
    grown = [
        f"{name} {variant}, stage {stage}: {count} equations, budget {budget.get(stage, 0)}"
        for stage, count in step(name).equations(variant).items()
        if count > SOLVER[0] * budget.get(stage, 0) + SOLVER[1]
    ]
    assert not grown, "; ".join(grown)


def test_a_step_of_the_example_is_small() -> None:
    count = sum(step("s1").equations("outward").values())
    assert count <= MOST_S1, f"s1 outward: {count} equations, at most {MOST_S1} wanted"
