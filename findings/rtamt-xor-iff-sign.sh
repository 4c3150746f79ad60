#!/bin/sh
# rtamt 0.4.10: the sign of `xor` and `iff` is not their truth.
#
# Guess before the run: an `iff` of two true statements has a positive robustness, as in every STL monitor
# whose `iff` is a conjunction of two implications.
# Seen: rtamt takes the robustness of `a xor b` as |rho(a) - rho(b)|, and of `a iff b` as its negative. So `iff` is at
# most 0 and `xor` at least 0 in every sample. Two statements that both hold, by 3 and by 1, violate `iff` by 2
# and satisfy `xor` by 2. The written-out conjunction of two implications has the sign that the truth has.
# Source: rtamt/semantics/stl/discrete_time/online/xor_operation.py and offline/ast_visitor.py (visitXor, visitIff)
# of the wheel; the README of the project states both formulas.
# For whom: a requirement "the gripper is closed if and only if the part is held", ported from or to rtamt.
set -eu

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet rtamt==0.4.10 antlr4-python3-runtime==4.7

cat >"$folder/run.py" <<'PY'
import rtamt

# one row a case: a and b hold, only a holds, neither holds
data = {"time": [0, 1, 2], "a": [3.0, 3.0, -3.0], "b": [1.0, -1.0, -1.0]}


def robustness(formula):
    specification = rtamt.StlDiscreteTimeOfflineSpecification()
    for name in ("a", "b"):
        specification.declare_var(name, "float")
    specification.spec = formula
    specification.parse()
    return [value for _, value in specification.evaluate(data)]


for formula in (
    "(a >= 0) iff (b >= 0)",
    "(a >= 0) xor (b >= 0)",
    "((a >= 0) implies (b >= 0)) and ((b >= 0) implies (a >= 0))",
):
    print(f"{formula}: {robustness(formula)}")
PY

"$folder/venv/bin/python" "$folder/run.py" | tee "$folder/output"
diff "$folder/output" - <<'EXPECTED'
(a >= 0) iff (b >= 0): [-2.0, -4.0, -2.0]
(a >= 0) xor (b >= 0): [2.0, 4.0, 2.0]
((a >= 0) implies (b >= 0)) and ((b >= 0) implies (a >= 0)): [1.0, -1.0, 1.0]
EXPECTED
echo "rtamt 0.4.10: as described"
