#!/bin/sh
# commonroad-io 2026.1 ignores `<center>` and `<orientation>` of an obstacle's rectangle; 2024.3 applies them.
#
# Guess before the run: both versions place the obstacle of a file of format 2020a alike, or the newer one raises.
# Seen: a parked car at (5, 1) whose rectangle has its centre at (10, 0), turned by a quarter. 2024.3 places it at (15, 1)
# across the road; 2026.1 at (5, 1) along it, without a warning. Verdicts on distances flip with the version.
# Source: class RectangleFactory of commonroad/common/reader/file_reader_xml.py in 2024.3; in 2026.1 the shape class that
# replaces it has neither attribute.
# For whom: data sets converted before 2026 whose vehicles refer to an axle or a bumper, read by newer tools.
set -eu

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT

cat >"$folder/ZAM_Parked-1_1_T-1.xml" <<'XML'
<?xml version="1.0" encoding="UTF-8"?>
<commonRoad commonRoadVersion="2020a" benchmarkID="ZAM_Parked-1_1_T-1" date="2026-01-01" author="none" affiliation="none" source="none" timeStepSize="0.1">
<location><geoNameId>-999</geoNameId><gpsLatitude>999</gpsLatitude><gpsLongitude>999</gpsLongitude></location>
<scenarioTags/>
<lanelet id="1">
<leftBound><point><x>0</x><y>3</y></point><point><x>50</x><y>3</y></point></leftBound>
<rightBound><point><x>0</x><y>0</y></point><point><x>50</x><y>0</y></point></rightBound>
</lanelet>
<staticObstacle id="5">
<type>parkedVehicle</type>
<shape><rectangle><length>4.0</length><width>2.0</width><orientation>1.5707963267948966</orientation><center><x>10.0</x><y>0.0</y></center></rectangle></shape>
<initialState><position><point><x>5.0</x><y>1.0</y></point></position><orientation><exact>0.0</exact></orientation><time><exact>0</exact></time></initialState>
</staticObstacle>
</commonRoad>
XML

cat >"$folder/run.py" <<'PY'
import sys
from importlib.metadata import version

from commonroad.common.file_reader import CommonRoadFileReader

scenario, _ = CommonRoadFileReader(sys.argv[1]).open()
occupancy = scenario.static_obstacles[0].occupancy_at_time(0)
rectangle = getattr(occupancy, "shape", occupancy)
xs, ys = zip(*((float(x), float(y)) for x, y in rectangle.vertices))
extent = [round(number, 3) + 0.0 for number in (min(xs), min(ys), max(xs), max(ys))]
print("commonroad-io", version("commonroad-io"), "xmin, ymin, xmax, ymax:", extent)
PY

for version in 2024.3 2026.1; do
    python3 -m venv "$folder/$version"
    "$folder/$version/bin/pip" install --quiet "commonroad-io==$version"
    "$folder/$version/bin/python" "$folder/run.py" "$folder/ZAM_Parked-1_1_T-1.xml" 2>"$folder/errors" | tee -a "$folder/output"
done
diff "$folder/output" - <<'EXPECTED'
commonroad-io 2024.3 xmin, ymin, xmax, ymax: [14.0, -1.0, 16.0, 3.0]
commonroad-io 2026.1 xmin, ymin, xmax, ymax: [3.0, 0.0, 7.0, 2.0]
EXPECTED
echo "commonroad-io 2024.3 and 2026.1: as described"
