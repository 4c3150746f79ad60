#!/bin/sh
# rtamt 0.4.10: a handover satisfies `until` in discrete time and violates it in dense time.
#
# Guess before the run: on one recording with a sample a second, both offline monitors give `hold until
# arrived` the same sign at the beginning.
# Seen: the discrete monitor asks for the left operand before the right one comes true, not at that sample. The dense
# monitor asks for it at that moment, too. A grip that ends just as the part arrives is satisfied by 1 in discrete
# time and violated by 1 in dense time. With half a second of overlap, both are satisfied.
# Source: rtamt/semantics/stl/discrete_time/offline/ast_visitor.py (visitUntil) and
# dense_time/offline/ast_visitor.py (visitTimedUntil) of the wheel.
# For whom: modes and flags that change in one sample ("holding until placed") are such handovers.
set -eu

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet rtamt==0.4.10 antlr4-python3-runtime==4.7

cat >"$folder/run.py" <<'PY'
import rtamt

FORMULA = "(hold >= 0) until[0:4] (arrived >= 0)"
ARRIVED = [[0, -1.0], [1, -1.0], [2, 1.0], [3, 1.0], [4, 1.0]]


def specification(kind):
    written = kind()
    for name in ("hold", "arrived"):
        written.declare_var(name, "float")
    written.spec = FORMULA
    written.parse()
    return written


def discrete(hold):
    columns = {"time": [t for t, _ in hold], "hold": [v for _, v in hold], "arrived": [v for _, v in ARRIVED]}
    return specification(rtamt.StlDiscreteTimeOfflineSpecification).evaluate(columns)[0]


def dense(hold):
    monitor = specification(rtamt.StlDenseTimeOfflineSpecification)
    return monitor.evaluate(["hold", hold], ["arrived", ARRIVED])[0]


handover = [[0, 1.0], [1, 1.0], [2, -1.0], [3, -1.0], [4, -1.0]]
overlap = [[0, 1.0], [1, 1.0], [2, 1.0], [2.5, -1.0], [3, -1.0], [4, -1.0]]
print("handover, discrete:", discrete(handover))
print("handover, dense:   ", dense(handover))
print("overlap, dense:    ", dense(overlap))
PY

"$folder/venv/bin/python" "$folder/run.py" | tee "$folder/output"
diff "$folder/output" - <<'EXPECTED'
handover, discrete: [0, 1.0]
handover, dense:    [0, -1.0]
overlap, dense:     [0, 1.0]
EXPECTED
echo "rtamt 0.4.10: as described"
