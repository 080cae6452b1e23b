"""The online observer. Its modules, in the order in which to read them:

1. `estimation`: the public calls, a whole record or one measurement at a time.
2. `step`: one step, from the box of x[k-1] and a measurement to the box of x[k].
3. `contractors`: what a step contracts boxes with, and the linear bounds that a design hands it.
4. `measurement`: the box of y - D u - v, and the current input.
5. `types`: `Observer`, `Carry` and `StepOutput`.
6. `certificate`, `status`, `alarms`: the promised widths, the bits and sources of a step, contradictions in words.
7. `prediction_step`: the recursion of the paper, in place of `step`.

Offline, once for each observer: `rounding_constants` completes a design by the constants that rounding asks for, in the
rational arithmetic of `residuals`.
"""
