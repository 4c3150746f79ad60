#!/bin/sh
# norfair 2.3.0 marks points as live for three updates in which nothing was detected, and goes on for fifteen.
#
# Guess before the run: an object without a detection has no live point from the first such update on.
# Seen: an object that moves by 10 pixels an update and is not detected after update 29. Updates 30, 31 and 32 return
# it with `live_points` True, 10 to 30 pixels farther; 33 to 44 return it with False; from 45 on it is gone.
# Source: the counters of TrackedObject in norfair/tracker.py; `live_points` compares a counter of each point with 0,
# which detections raise up to `pointwise_hit_counter_max` (4) and each update lowers by one.
# For whom: tracks that are recorded for distances. `last_detection` says whether an object was in the newest detections.
set -eu

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet norfair==2.3.0

cat >"$folder/run.py" <<'PY'
from importlib.metadata import version

import numpy as np
from norfair import Detection, Tracker

tracker = Tracker(distance_function="euclidean", distance_threshold=50)
live, returned = [], []
for update in range(60):
    seen = [Detection(points=np.array([[100.0 + 10 * update, 50.0]]))] if update < 30 else []
    for tracked in tracker.update(seen):
        if update >= 30:
            returned.append((update, round(float(tracked.estimate[0, 0]))))
            if tracked.live_points.all():
                live.append(update)
print("norfair", version("norfair"))
print("live without a detection:", live)
print("returned without a detection:", returned[0], "to", returned[-1])
PY

"$folder/venv/bin/python" "$folder/run.py" 2>"$folder/errors" | tee "$folder/output"
diff "$folder/output" - <<'EXPECTED'
norfair 2.3.0
live without a detection: [30, 31, 32]
returned without a detection: (30, 400) to (44, 540)
EXPECTED
echo "norfair 2.3.0: as described"
