#!/bin/sh
# commonroad-io 2026.1: `write_to_file` of a writer with default arguments writes no file; 2024.3 writes one.
#
# Guess before the run: the default format became protobuf, so the newer version writes a `.pb` file, or raises.
# Seen: the same three lines write `run.xml` with 2024.3. With 2026.1 they end without a file, a warning or an error.
# With `file_format=FileFormat.XML`, 2026.1 writes the file.
# Source: class CommonRoadFileWriter of commonroad/common/file_writer.py, whose default format is PROTOBUF in 2026.1;
# the body of `write_to_file` in commonroad/common/writer/file_writer_protobuf.py is `pass` there. Protobuf of format 2023
# is written by `write_map_to_file`, `write_scenario_to_file` and `write_dynamic_to_file`.
# For whom: exporters that were written for 2024.3; an update ends their data set without a message.
set -eu

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT

cat >"$folder/run.py" <<'PY'
import os
import sys
import warnings
from importlib.metadata import version

from commonroad.common.file_writer import CommonRoadFileWriter, OverwriteExistingFile
from commonroad.common.util import FileFormat
from commonroad.planning.planning_problem import PlanningProblemSet
from commonroad.scenario.scenario import Scenario

os.chdir(sys.argv[1])
warnings.simplefilter("error")
for options in ({}, {"file_format": FileFormat.XML}):
    writer = CommonRoadFileWriter(Scenario(0.1), PlanningProblemSet(), "author", "place", "source", set(), **options)
    writer.write_to_file("run.xml", OverwriteExistingFile.ALWAYS)
    print("commonroad-io", version("commonroad-io"), "XML asked for:", bool(options), "files:", os.listdir())
    if os.path.exists("run.xml"):
        os.remove("run.xml")
PY

for version in 2024.3 2026.1; do
    python3 -m venv "$folder/$version"
    mkdir "$folder/written-$version"
    "$folder/$version/bin/pip" install --quiet "commonroad-io==$version"
    "$folder/$version/bin/python" "$folder/run.py" "$folder/written-$version" 2>"$folder/errors" | tee -a "$folder/output"
done
diff "$folder/output" - <<'EXPECTED'
commonroad-io 2024.3 XML asked for: False files: ['run.xml']
commonroad-io 2024.3 XML asked for: True files: ['run.xml']
commonroad-io 2026.1 XML asked for: False files: []
commonroad-io 2026.1 XML asked for: True files: ['run.xml']
EXPECTED
echo "commonroad-io 2024.3 and 2026.1: as described"
