"""What ``--help`` says below the options."""

from __future__ import annotations

EXAMPLES = """\
examples:
  gsisio estimate flight                     a built-in example; files go to results/flight
  gsisio examples                            what there is besides, and what it teaches
  gsisio examples battery --out mine         its configuration and record, to start from
  gsisio init pump.csv                       a configuration and a plant to fill in, for a log
  gsisio estimate pump.toml --out today      your own system and table
  gsisio estimate pump.toml friday.csv       the same with another table
  gsisio estimate pump.toml --resume         go on where a long run was interrupted or killed
  logger | gsisio estimate pump.toml - --follow
                                             a line of JSON per row, as it comes
  gsisio design pump.toml                    what the observer promises, without any data
  gsisio sweep paper                         widths over noise bounds and initial boxes
  gsisio monte-carlo paper                   a thousand simulated runs, each box checked against the truth
  gsisio reproduce                           the paper's example; files go to results/paper

CONFIG is a TOML file. It names the system ("module:attribute", also a module beside the file), the
noise bounds, the region, the initial box, the table of measurements (CSV or Parquet) and the outputs.
The built-in examples are commented and meant to be copied. All keys (those of sweep and monte_carlo are
in their own --help):

  title = "Pump"
  [system]
  use = "plant:pump"                 # a System, or a function that returns one, called with
  arguments = {length = 3.0}         # these
  periodic = {heading = 360.0}       # outputs that are logged modulo a period, and
  periodic_states = {heading = 360.0}  # states that mean the same after one
  input_rate = {leak = 0.1}          # an unknown input moves by no more than that in a step
  input_constant = 10                # unknown inputs change at steps 0, 10, 20, ... only
  [signals]                          # names and units, in order; left out: x1, d1, y1, u1, ...
  state = [{name = "position", unit = "m"}]
  input = [{name = "leak", unit = "l/s"}]  # likewise output, known_input
  [noise]                            # bounds of the process noise w and of the measurement noise v
  w = {radius = [0.01]}              # every box is {radius = [...]} or {lower = [...], upper = [...]},
  v = {radius = [0.1]}               # one number for each component, inf where nothing is known; or
                                     # {use = "module:attribute"}, a gx.Interval: the error of gx.discretize
  [region]                           # of states, for which gains are chosen and widths promised:
  lower = [-1.0]                     # lower and upper, or
  upper = [1.0]                      # auto = true and around = a state [...], a box, or "initial"
  [u_region]                         # box of known inputs; needed where f or g takes u
  [initial]                          # box of the first state
  [design]                           # options of gx.design_observer, which explains them
  gains = 1                          # also sweeps, window, delay, split, cells, missing, certify,
                                     # bounds, form = "prediction", left_inverse, allow_uncertified
  rates = [1, 20]                    # every how many rows each output comes, where they differ
  [estimate]
  on_conflict = "restart"            # or "hold": what is believed after a contradiction
  [outputs]                          # file names: netcdf, csv, picture, report; draw = "module:function"
                                     # draws the picture, called with a Dataset and a path

The table [table] says how the log is written; docs/logs.md explains every key:

  [table]
  file = "log.csv"                   # also .gz .zip .bz2 .xz .zst, or Parquet; separator, header, decimal
                                     # comma, encoding are found, or set in [table.dialect]
  time = "t"                         # seconds or ISO dates; {column = "t", unit = "ms", tolerance = 0.01},
                                     # {column = "t", format = "%d.%m.%Y %H:%M", zone = "Europe/Berlin"};
                                     # left out: rows one sample apart
  sample_time = "auto"               # or seconds; dt = "as_input" in its place: rows on no grid, the time
                                     # step is the last known input
  y = ["position", "speed"]          # columns of the outputs; u = [...] of the known inputs
  missing = ["---", -9999]           # what means missing, besides empty cells, NaN, NA, null and their like
  columns = {speed = {unit = "km/h"}}  # to SI; also to = "m/s", scale = 0.1, offset = -40
  on_duplicate = "mean"              # or first, last; on_unsorted = "sort", on_blank_time = "drop";
                                     # left out: such rows are errors
  on_gap_u = "hold"                  # known inputs keep their last value where a step or a cell has none
  sparse = true                      # most steps have no row, and that is meant
  transform = "plant:clean"          # a function of the pandas.DataFrame, before all else
  [table.dialect]                    # what is not found by looking: separator, decimal, thousands, comment,
                                     # quote, header, encoding, skip, skip_after, compression

estimate writes four files: a labelled NetCDF, a CSV with the columns
time,<signal>_lower,<signal>_upper,...,status  a PNG, and a report: one HTML file. status is a sum of
1 conflict (a certified alarm), 2 missing data, 4 unbounded, 8 outside the region, 16 crossed,
32 ambiguous (several multiples of the period of an angle fit).

exit codes: 0 done, 1 a simulated run was not held by its boxes (monte-carlo), 2 something in the
command, the configuration, the table or the folder is wrong (one line says what, and no file is
written), 3 the files are written, but nearly every step contradicts the stated bounds (estimate: wrong
units?), 130 interrupted (143: by SIGTERM). Conflicts now and then are results, and exit code 0.

docs/command-line.md explains init, long tables, --follow, the report and --format json.
"""

_STUDIES = """\
A study is stored tile by tile in DIR/NAME_{kind}.zarr. Stop it with Ctrl-C, or let it be killed: the
same command goes on where it was, and ends in the same numbers. Beside the store it writes
NAME_{kind}.nc (all numbers, labelled), NAME_{kind}_curves.png (widths beside the certificate) where
something varies, NAME_{kind}_heatmap.png where two things do, and a summary on standard output.
"""

SWEEP = (
    _STUDIES.format(kind="sweep")
    + """
The table [sweep] of CONFIG says what varies; all of it is combined in all ways:

  [sweep]
  reduce = ["final", "max", "mean"]  # what is kept of each case; also rms, settle, first_conflict, status,
                                     # boxes (everything), {quantiles = [0.5, 0.95]}, {settle = 3}
  records = "logs/*.csv"             # left out: the file of [table]; a pattern or a list: axis "record"
  batch = 65536                      # cases per tile; left out: chosen by memory
  picture = "mean"                   # which of the widths is drawn; left out: the last ones

  [sweep.axes.noise]                 # multiples of the stated noise bounds; of = "w", "v" or "both"
  from = 0.1
  to = 10
  count = 20
  spacing = "log"                    # or "linear"

  [sweep.axes.initial]               # multiples of the initial box, about its centre
  scale = [0.5, 1, 2]

gsisio sweep paper --out DIR  runs a small one.
"""
)

MONTE_CARLO = (
    _STUDIES.format(kind="monte_carlo")
    + """
The table [monte_carlo] of CONFIG says what is simulated; no [table] is needed:

  [monte_carlo]
  runs = 1000                        # or their numbers, such as [17]
  steps = 200
  seed = 0
  draw = "vertices"                  # noise on the vertices of its bounds; "uniform"; "module:attribute"
  x0 = {lower = [0, 0], upper = [1, 1]}  # of the true states; left out: the initial box
  d = {amplitude = [2.0]}            # unknown input, uniform in +-amplitude, or "module:attribute",
                                     # a function d(key, k, x) in jax.numpy; left out: zero
  u = [0.1]                          # known inputs, constant, or "module:attribute": an array (steps, m), or
                                     # a function of the number of steps that returns one
  reduce, batch, picture and [monte_carlo.axes...] as in gsisio sweep --help

A box that misses the truth ends the command with exit code 1 and the seed, run and step of it.

gsisio monte-carlo paper --out DIR  runs a small one.
"""
)

INIT = """\
Writes NAME.toml and plant.py for a log NAME.csv: what was found in its first rows (separator, clock and
sample time, columns, what means missing, the resolution of each column as a suggestion for the noise) and
FILL_IN where only you know. It overwrites nothing. `gsisio estimate NAME.toml` lists what is left to fill in.

  gsisio init pump.csv
  gsisio init logs/pump.csv --out pump
"""
