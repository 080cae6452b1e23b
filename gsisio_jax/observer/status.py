"""What a step reports besides its boxes: a status bit mask, and which intersection was the tightest."""

from __future__ import annotations

import enum
from collections.abc import Iterable
from typing import Any

import jax.numpy as jnp
import numpy as np


class Status(enum.IntFlag):
    """Bit mask per step and batch element. OK is 0.

    Attributes:
        CONFLICT: 1, an intersection is empty: the data contradict the stated bounds (a certified alarm).
        MISSING: 2, an entry of y is missing.
        UNBOUNDED: 4, some side of the state box is infinite.
        OUTSIDE_REGION: 8, boxes are certain, but the width promise does not apply.
        CROSSED: 16, prediction form only: the printed recursion lost its order.
        AMBIGUOUS: 32, periodic outputs only: several multiples of the period fit, so the entry says less, or nothing.
        PENDING: 64, observers with a delay, online: the step that this one would finish lies before the record.
        OUTVOTED: 128, ``tolerate`` only: not all outputs agree, and one is left out or in doubt.

    Source: theory 8.3.
    """

    OK = 0
    CONFLICT = 1
    MISSING = 2
    UNBOUNDED = 4
    OUTSIDE_REGION = 8
    CROSSED = 16
    AMBIGUOUS = 32
    PENDING = 64
    OUTVOTED = 128


def bit_mask(bits: Iterable[tuple[Any, Status]]) -> Any:
    """Join conditions and the bits they stand for into one integer array."""
    return sum(jnp.where(condition, int(bit), 0).astype(jnp.int32) for condition, bit in bits)


def flag_attributes() -> dict[str, Any]:
    """What the bits mean, as attributes of a dataset's variable (CF conventions)."""
    members = [member for member in Status if member.value]
    return {
        "flag_masks": np.array([member.value for member in members], dtype=np.int32),
        "flag_meanings": " ".join(str(member.name) for member in members),
    }


class Source(enum.IntEnum):
    """Which intersection was the tightest one of a step. The code in a result is ``kind * SOURCE_STRIDE + index``."""

    NONE = 0
    INITIAL = 1  # initial box against state bounds, by state
    OUTPUT = 2  # a row of the unknown-input-free output against the box, by row of T2
    STATE = 3  # box carried from the past (identity (*)) against the box so far, by state
    DYNAMICS = 4  # x = f + B u + G d + w with the bounds of d, by state
    INPUT = 5  # bounds of the unknown input against each other, by input
    CERTIFICATE = 6  # the certified bound, by state
    BALANCE = 7  # a combination of dynamics and outputs that is free of the unknown input, by circuit of [G; H]
    PERIODIC = 8  # no multiple of its period brings a periodic output to where the box is, by output


SOURCE_STRIDE = 1 << 16
