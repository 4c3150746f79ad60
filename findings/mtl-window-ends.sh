#!/bin/sh
# metric-temporal-logic 0.4.1: windows are open at their end, and a window of one moment is now.
#
# Guess before the run: `G[0,2] a` includes the sample at 2, as in MTL with closed windows, and `F[1,1] a` is `a` one
# second later.
# Seen: `G[0,2] a` leaves the sample at 2 out; a violation exactly there is not seen until the window is longer.
# `F[1,1] a` and `F[2,2] a` are `a` now: neither is an error, and both read a sample outside their window. The next operator
# means a tenth of a second unless dt says else, so `X a` on samples a second apart is `a` now.
# Source: mtl/evaluator.py of the wheel (eval_mtl_g with the shift by dt, pointwise_sat with dt=0.1).
# For whom: deadlines and periods that are whole numbers of samples, in formulas ported from or to other monitors.
set -eu

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet metric-temporal-logic==0.4.1

cat >"$folder/run.py" <<'PY'
import mtl

samples = {"a": [(0, 3.0), (1, 2.0), (2, -1.0), (3, 4.0)]}
for formula in ("G[0,2] a", "G[0,2.1] a", "F[1,1] a", "F[1,1.1] a", "F[2,2] a", "X a"):
    print(formula, mtl.parse(formula)(samples))
PY

"$folder/venv/bin/python" "$folder/run.py" | tee "$folder/output"
diff "$folder/output" - <<'EXPECTED'
G[0,2] a 2.0
G[0,2.1] a -1.0
F[1,1] a 3.0
F[1,1.1] a 2.0
F[2,2] a 3.0
X a 3.0
EXPECTED
echo "metric-temporal-logic 0.4.1: as described"
