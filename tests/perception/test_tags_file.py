"""Tags files: what they say, and what is said about mistakes in them."""

from __future__ import annotations

import json
import math
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from perception.filmed import BLOCKS, CAMERA, REFERENCES, TABLE
from spatial_replay import Footprint, UsageError
from spatial_replay.perception import parse_tags

pytest.importorskip("cv2")


def test_a_tags_file_says_which_tag_is_on_which_object() -> None:
    tags = parse_tags(
        f"""
size: 4cm
objects:
  plate: {{tags: [7, {{id: 8, at: [10cm, 0], yaw: 90deg, z: 12mm}}], disc: 80mm, class: plate}}
  cup: {{tag: 3, polygon: [[0, 0], [0.1, 0], [0, 0.1]], height: [0, 70mm], lifted: true}}
{REFERENCES}
{CAMERA}
"""
    )
    plate, cup = tags.objects
    assert (plate.name, plate.class_name, plate.footprint) == ("plate", "plate", Footprint.disc(0, 0, 0.08))
    on_plate = plate.tags[1]
    assert (on_plate.id, on_plate.x, on_plate.z, on_plate.size) == (8, 0.1, 0.012, 0.04)
    assert on_plate.yaw == pytest.approx(math.pi / 2)
    # a tag is on the top of its object unless it says otherwise
    assert (cup.tags[0].z, cup.is_lifted) == (0.07, True)
    assert tags.ids == {3, 7, 8, 10, 11, 12, 13}


MISTAKES = {
    "a tag on two objects": (TABLE.replace("tag: 1", "tag: 0"), "tag 0 is on red already"),
    "a reference tag on an object": (TABLE.replace("10:", "1:"), "tag 1 is on blue already"),
    "two shapes": (
        TABLE.replace("box: [50mm, 50mm]", "box: [1, 1], disc: 1", 1),
        "one of box, disc and polygon",
    ),
    "no tag": (TABLE.replace("tag: 0, ", ""), "give either tag, a number, or tags, a list"),
    "three references": (TABLE.replace("10: [0.3, -0.17], ", ""), "give 4 or more tags with known places"),
    "no plane": (BLOCKS, "or write plane: image for pixels"),
    "an unknown key": (TABLE.replace("class:", "clas:", 1), "unknown key; did you mean 'class'?"),
    "an unknown family": (TABLE + "family: 36h12", "36h11 (the default)"),
    "a length in inches": (TABLE.replace("48mm", "2in"), "a text such as 40mm"),
    "lifted without a camera": (
        f"{BLOCKS}\n{REFERENCES}".replace("tag: 0,", "tag: 0, lifted: true,"),
        "lifted needs a calibrated camera",
    ),
    "a tag that the family lacks": (
        TABLE.replace("tag: 1,", "tag: 700,"),
        "objects.blue.tag: family 36h11 has no tag 700; its tags are 0 to 586",
    ),
    "an outline that crosses itself": (
        TABLE.replace("box: [50mm, 50mm]", "polygon: [[0, 0], [1, 1], [1, 0], [0, 1]]", 1),
        "objects.red.polygon: the polygon's boundary crosses or touches itself at (0.5, 0.5); list its"
        " corners in order around it, or split it",
    ),
    "the size of tags without a unit": (
        TABLE.replace("size: 48mm", "size: 48", 1),
        "size: 48 is 48 m, and the table that the camera sees is within 0.488 m; write 48mm, or",
    ),
    "millimetres without a unit": (
        TABLE.replace("box: [50mm, 50mm]", "box: [50, 50]", 1),
        "objects.red.box: 50 is 50 m, and the table that the camera sees is within 0.488 m; write 50mm, or",
    ),
    "a height in millimetres without a unit": (
        TABLE.replace("height: [0, 40mm]", "height: [0, 40]", 1),
        "objects.red.height: 40 is 40 m, and",
    ),
    "a plane's height without a unit": (TABLE.replace("plane: {", "plane: {height: 40, "), "write 40mm"),
    "millimetres without a unit or reference tags": (
        BLOCKS.replace("[50mm, 50mm]", "[50, 50]", 1)
        + CAMERA.replace("}", ", pose: {position: [1, 0, 0.75], look_at: [0.6, 0, 0]}}"),
        "objects.red.box: 50 is 50 m, and the table that the camera sees is within 0.85 m; write 50mm, or",
    ),
    "a height in an image": (
        "size: 40\nobjects: {red: {tags: [{id: 0, z: 3}], box: [40, 30]}}\nplane: image",
        "an image has no heights",
    ),
    "millimetres in an image": (f"{BLOCKS}\nplane: image", "lengths are pixels; write a number; got '48mm'"),
    "a size of nothing": (TABLE.replace("48mm", "0mm"), "above 0"),
}


@pytest.mark.parametrize("what", MISTAKES)
def test_a_mistake_is_named_with_its_line_and_its_remedy(what: str) -> None:
    text, said = MISTAKES[what]
    with pytest.raises(UsageError) as caught:
        parse_tags(text, "tags.yaml")
    assert said in str(caught.value)
    assert str(caught.value).startswith("tags.yaml:")


def test_a_camera_that_looks_straight_down_needs_to_know_what_is_up() -> None:
    pose = "pose: {position: [0, 0, 1], look_at: [0, 0, 0]%s}"
    text = BLOCKS + CAMERA.replace("}", f", {pose}}}")
    with pytest.raises(UsageError, match=r"up: \[0, 1, 0\]"):
        parse_tags(text % "")
    # a metre above the origin, which is then a metre in front of it
    assert np.allclose(parse_tags(text % ", up: [0, 1, 0]").pose[3:], [0, 0, 1])


def test_every_key_is_documented_and_the_published_schema_is_that_of_the_package() -> None:
    root = Path(__file__).parents[2]
    schema = json.loads((root / "schemas/tags.schema.json").read_text())
    packaged = files("spatial_replay.perception").joinpath("tags.schema.json").read_text()
    assert json.loads(packaged) == schema
    page = (root / "docs/perception.md").read_text()
    parts = [schema, schema["$defs"]["object"], schema["$defs"]["camera"]]
    keys = {key for part in parts for key in part["properties"]}
    assert sorted(key for key in keys if f"`{key}`" not in page) == []
