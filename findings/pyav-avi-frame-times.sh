#!/bin/sh
# PyAV 18.1.0: frames of an .avi film with B frames come in the right order, with the times of other frames.
#
# Guess before the run: the same H.264 stream gives the same increasing times from .mp4, .ts and .avi, or no
# times at all from .avi, which has none.
# Seen: all containers give all frames, and their pictures in the order of showing. The times of the .avi are those of
# decoding: in units of a frame 1, 3, 4, 2, 6, 7, 5. They step back at every group of B frames, none is None, and
# sorting frames by time shuffles the pictures.
# Source: frame.pts of PyAV, from FFmpeg's AVI demuxer, which numbers packets as they lie in the file.
# For whom: a camera recorder that writes .avi with libx264's defaults, whose frames are matched with a log by time.
set -eu

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet av==18.1.0 numpy==2.4.6

cat >"$folder/run.py" <<'PY'
import sys

import av
import numpy as np

RATE = 30


def write(path):
    """Write 60 frames, each a little brighter than the one before, with two B frames between others."""
    with av.open(path, "w") as container:
        stream = container.add_stream("libx264", rate=RATE)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.options = {"bf": "2", "x264-params": "keyint=30:scenecut=0:threads=1"}
        for number in range(60):
            picture = np.full((48, 64, 3), 4 * number, np.uint8)
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts = number
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


for ending in ("mp4", "ts", "avi"):
    path = f"{sys.argv[1]}/film.{ending}"
    write(path)
    with av.open(path) as container:
        frames = list(container.decode(video=0))
    brightness = [frame.to_ndarray(format="gray").mean() for frame in frames]
    places = [round(frame.time * RATE) for frame in frames]
    is_shown_in_order = all(a < b for a, b in zip(brightness, brightness[1:]))
    is_timed_in_order = all(a < b for a, b in zip(places, places[1:]))
    print(ending, len(frames), "pictures in order:", is_shown_in_order, "times in order:", is_timed_in_order, places[:7])
PY

"$folder/venv/bin/python" "$folder/run.py" "$folder" | tee "$folder/output"
diff "$folder/output" - <<'EXPECTED'
mp4 60 pictures in order: True times in order: True [0, 1, 2, 3, 4, 5, 6]
ts 60 pictures in order: True times in order: True [2, 3, 4, 5, 6, 7, 8]
avi 60 pictures in order: True times in order: False [1, 3, 4, 2, 6, 7, 5]
EXPECTED
echo "PyAV 18.1.0: as described"
