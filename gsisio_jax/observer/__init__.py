"""The online observer. Its modules, in the order in which to read them:

1. `estimation`: the public calls, a whole record or one measurement at a time; `checks` looks at what they are given.
2. `scan`: the step over the rows of a record.
3. `step`: one step, from the box of x[k-1] and a measurement to the box of x[k]. Its parts, in order: `bank` (linear
   bounds that a design hands it), `initial`, `contractors`, `input_boxes`, `certified`; what they share: `domain` (a
   box under contraction), `maps` (bounds of f and g), `measurement` (the box of y - D u - v), `lost` (what stored
   gains do not cancel).
4. `types`: `Observer`, `Carry` and `StepOutput`; `fixed`: an observer as a constant of a compiled program.
5. `certificate`, `status`, `alarms`: the promised widths, the bits and sources of a step, contradictions in words.
6. `prediction_step`: the recursion of the paper, in place of `step`.

Offline, once for each observer: `rounding_constants` completes a design by the constants that rounding asks for, in the
rational arithmetic of `residuals`.
"""
