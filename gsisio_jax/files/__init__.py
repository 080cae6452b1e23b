"""Observers and carries as files: versioned, without pickle, whole or not at all, and refused where they do not fit."""

from __future__ import annotations

from gsisio_jax.files.carries import load_carry, save_carry
from gsisio_jax.files.observers import load_observer, save_observer

__all__ = ["load_carry", "load_observer", "save_carry", "save_observer"]
