"""A scalar program as C++ with vectors of eight boxes (AVX-512), compiled by g++: what the same arithmetic can do."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np

from gsisio_jax.scalar import ScalarProgram
from gsisio_jax.scalar.graph import Number

_INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/"}
_COMPARED = {"lt": "LT_OQ", "le": "LE_OQ", "gt": "GT_OQ", "ge": "GE_OQ", "eq": "EQ_OQ", "ne": "NEQ_UQ"}
_ROUNDED = ("round", "floor", "ceil")  # in the order of the instruction's modes
_MASKS = {"and": "{} & {}", "or": "{} | {}", "not": "~{}", "eq": "~({} ^ {})", "ne": "{} ^ {}", "xor": "{} ^ {}"}
_NUMBERS = {
    "abs": "_mm512_abs_pd({})", "neg": "-({})", "sqrt": "_mm512_sqrt_pd({})", "square": "{0} * {0}",
    "raised": "_mm512_max_pd({1}, {0})", "cut": "_mm512_min_pd({1}, {0})",  # the second operand where one is NaN
    "scale": "_mm512_maskz_mul_pd(_mm512_cmp_pd_mask({0}, K(0), _CMP_NEQ_UQ), {0}, {1})", "times": "T({0} * {1})",
    **dict.fromkeys(("max", "larger"), "MAX({}, {})"), **dict.fromkeys(("min", "smaller"), "MIN({}, {})"),
    **dict.fromkeys(("stop_gradient", "wave", "falling_wave", "fusion_barrier", "copy"), "{}"),
}  # fmt: skip
_HEAD = """#include <immintrin.h>
#include <math.h>
typedef __m512d v8; typedef __mmask8 m8;
static inline v8 K(double x) { return _mm512_set1_pd(x); }
static inline m8 B(v8 x) { return _mm512_cmp_pd_mask(x, K(0), _CMP_NEQ_UQ); }
static inline v8 D(v8 x) { return x; }
static inline v8 D(m8 x) { return _mm512_maskz_mov_pd(x, K(1)); }
static inline v8 T(v8 x) { return _mm512_maskz_mov_pd(_mm512_cmp_pd_mask(x, x, _CMP_ORD_Q), x); }
static inline v8 N(v8 a, v8 x) { return _mm512_mask_mov_pd(x, _mm512_cmp_pd_mask(a, a, _CMP_UNORD_Q), a); }
static inline v8 MAX(v8 a, v8 b) { return N(a, _mm512_max_pd(a, b)); }
static inline v8 MIN(v8 a, v8 b) { return N(a, _mm512_min_pd(a, b)); }
"""


def missing() -> str:
    """Why there is no such program on this machine; empty where there is one."""
    info = Path("/proc/cpuinfo")
    if shutil.which("g++") is None:
        return "no g++"
    return "" if info.exists() and "avx512dq" in info.read_text() else "no AVX-512"


class CProgram:
    """Runs a step ``(carry, y) -> (carry, kept)`` over all rows of one record, for boxes of one tile.

    What depends on no box (the record, the noise) is computed once for a row, as in the compiled scan.

    Attributes:
        seconds: that g++ took.
    """

    def __init__(self, program: ScalarProgram, carry: int, kept: int, varying: set[int], folder: Path):
        """`carry` and `kept` numbers are returned; of the carry those in `varying` are other ones in every box."""
        inputs, outputs = program.inputs, program.outputs
        depends: dict[int, bool] = {}
        while True:
            depends = {id(number): i in varying for i, number in enumerate(inputs)}
            for number in program.operations:
                depends[id(number)] = any(depends.get(id(v), False) for v in number.operands)
            more = varying | {i for i in range(carry) if depends.get(id(outputs[i]), False)}
            if more == varying:
                break
            varying = more
        self._varying, self._shared = sorted(varying), [i for i in range(carry) if i not in varying]
        self._kept = kept
        self._folder = folder
        self._write(program, carry, depends)
        self.seconds = self._compile()

    def _write(self, program: ScalarProgram, carry: int, depends: dict[int, bool]) -> None:
        names = {id(number): f"x{i}" for i, number in enumerate(program.inputs)}
        kind = {id(number): "m8" if number.dtype == bool else "v8" for number in program.inputs}
        once, every = [], []
        for place, i in enumerate(self._shared):
            once.append(_load(program.inputs[i], f"x{i}", f"K(shared[{place}])"))
        for row, i in enumerate(range(carry, len(program.inputs))):
            once.append(_load(program.inputs[i], f"x{i}", f"K(y[t * {len(program.inputs) - carry} + {row}])"))
        for place, i in enumerate(self._varying):
            every.append(_load(program.inputs[i], f"x{i}", f"_mm512_loadu_pd(own + {place} * count + b)"))
        for place, number in enumerate(program.operations):
            name = f"t{place}"
            kind[id(number)] = "m8" if number.dtype == bool else "v8"
            line = f"const {kind[id(number)]} {name} = {_expression(number, names)};"
            (every if depends[id(number)] else once).append(line)
            names[id(number)] = name
        results = [f"D({_name(value, names)})" for value in program.outputs]
        for place, i in enumerate(self._shared):
            once.append(f"shared[{place}] = _mm512_cvtsd_f64({results[i]});")
        for place, i in enumerate(self._varying):
            every.append(f"_mm512_storeu_pd(own + {place} * count + b, {results[i]});")
        for place, result in enumerate(results[carry:]):
            every.append(f"_mm512_storeu_pd(kept + (t * {self._kept} + {place}) * count + b, {result});")
        loop = "\n".join(["for (long b = 0; b < count; b += 8) {", *every, "}"])
        arguments = "double* own, double* shared, const double* y, double* kept, long steps, long count"
        body = "\n".join(["for (long t = 0; t < steps; t++) {", *once, loop, "}"])
        text = f'{_HEAD}extern "C" void run({arguments}) {{\n{body}\n}}\n'
        (self._folder / "step.cc").write_text(text)

    def _compile(self) -> float:
        source, library = str(self._folder / "step.cc"), str(self._folder / "step.so")
        options = ["-O2", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-shared", "-fPIC"]
        started = time.perf_counter()
        subprocess.run(["g++", *options, source, "-o", library], check=True)
        self._run = ctypes.CDLL(library).run
        return time.perf_counter() - started

    def __call__(self, carry: list[np.ndarray], rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Entries of the last carry that differ from box to box (numbers, boxes), and what was kept of every step,
        (steps, numbers, boxes); `carry` has one array of boxes, or one number, for each of its entries."""
        count = max(np.size(entry) for entry in carry)
        own = np.stack([np.broadcast_to(np.asarray(carry[i], float), (count,)) for i in self._varying])
        shared = np.array([float(carry[i]) for i in self._shared])
        rows, kept = np.ascontiguousarray(rows, float), np.empty((len(rows), self._kept, count))
        arrays = [array.ctypes.data_as(ctypes.c_void_p) for array in (own, shared, rows, kept)]
        self._run(*arrays, ctypes.c_long(len(rows)), ctypes.c_long(count))
        return own, kept


def _load(number: Number, name: str, value: str) -> str:
    return f"const m8 {name} = B({value});" if number.dtype == bool else f"const v8 {name} = {value};"


def _name(value: Any, names: dict[int, str]) -> str:
    if isinstance(value, Number):
        return names[id(value)]
    if value.dtype == bool:
        return f"m8({255 if value else 0})"
    text = repr(float(value))
    return f"K({ {'nan': 'NAN', 'inf': 'INFINITY', '-inf': '-INFINITY'}.get(text, text) })"


def _expression(number: Number, names: dict[int, str]) -> str:
    name, first = number.name, number.operands[0]
    args = [_name(value, names) for value in number.operands]
    if number.dtype == bool and first.dtype == bool and name in _MASKS:
        return f"m8({_MASKS[name].format(*args)})"
    if name in _COMPARED:
        return f"_mm512_cmp_pd_mask({args[0]}, {args[1]}, _CMP_{_COMPARED[name]})"
    if name in _INFIX:
        return f"{args[0]} {_INFIX[name]} {args[1]}"
    if name in _ROUNDED:
        return f"_mm512_roundscale_pd({args[0]}, {_ROUNDED.index(name)})"
    if name == "is_finite":
        return f"_mm512_cmp_pd_mask(_mm512_abs_pd({args[0]}), K(INFINITY), _CMP_LT_OQ)"
    if name == "convert_element_type":
        return f"D({args[0]})" if np.issubdtype(number.dtype, np.floating) else f"B(D({args[0]}))"
    if name == "select_n" and number.dtype == bool:
        return f"m8(({args[0]} & {args[2]}) | (~{args[0]} & {args[1]}))"
    if name == "select_n":
        return f"_mm512_mask_mov_pd({args[1]}, {args[0]}, {args[2]})"
    if name in _NUMBERS:
        return _NUMBERS[name].format(*args)
    raise NotImplementedError(f"benchmarks: `{name}` has no C++ here")
