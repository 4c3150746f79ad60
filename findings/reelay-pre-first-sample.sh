#!/bin/sh
# reelay 25.0.0: the robustness of `pre` at the first sample is -1.797e308, a finite number, and not -inf.
#
# Guess before the run: before the first sample there is nothing, so `pre` is -inf there, as `once[2:3]` is where its
# window lies before the first sample.
# Seen: `pre` begins with the least finite double, and windows begin with an infinity. A negation begins with the
# greatest finite double, and `historically (pre p)` keeps the least one for the whole run.
# Source: include/reelay/settings/discrete_timed_robustness/previous.hpp starts from -std::numeric_limits<output_t>::max().
# For whom: "the run has no verdict yet" is tested with isinf and fails; sums, means and axes of such a run overflow.
set -eu

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet reelay==25.0.0

cat >"$folder/run.py" <<'PY'
import reelay

SAMPLES = [{"x": 1.0}, {"x": 2.0}, {"x": 3.0}]
for pattern in (
    "pre {x > 0}",
    "not (pre {x > 0})",
    "historically (pre {x > 0})",
    "once[2:3] {x > 0}",
    "historically[2:3] {x > 0}",
):
    monitor = reelay.discrete_timed_monitor(pattern=pattern, semantics="robustness", condense=False)
    numbers = [monitor.update(sample)["value"] for sample in SAMPLES]
    print(f"{pattern}: {', '.join(f'{number:.4g}' for number in numbers)}")
PY

"$folder/venv/bin/python" "$folder/run.py" | tee "$folder/output"
diff "$folder/output" - <<'EXPECTED'
pre {x > 0}: -1.798e+308, 1, 2
not (pre {x > 0}): 1.798e+308, -1, -2
historically (pre {x > 0}): -1.798e+308, -1.798e+308, -1.798e+308
once[2:3] {x > 0}: -inf, -inf, 1
historically[2:3] {x > 0}: inf, inf, 1
EXPECTED
echo "reelay 25.0.0: as described"
