"""All functions with oracles for their values and derivatives."""

from __future__ import annotations

from oracles import real_activations, real_arrays, real_library

FUNCTIONS = real_library.FUNCTIONS | real_activations.FUNCTIONS | real_arrays.FUNCTIONS
