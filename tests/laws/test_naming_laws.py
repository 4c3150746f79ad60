"""Laws of names in the annotated scene: whatever the scene, they cover neither objects nor each other."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import shapely
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.reader import make_reader

import spatial_replay as sr
from spatial_replay.logs.source import MemorySource
from spatial_replay.logs.topics import SCENE
from spatial_replay.replay.engine import run_replay

NAMES = tuple(f"robot{number:02d}" for number in range(12))
TEXTS = {
    "many instances": "spec s = G forall p, q in robots: p dist q >= 99",
    "two objects": "spec s = G robot03 dist robot07 >= 99",
    "a region": "spec s = G robot03 dist dock >= 99",
    "moments ago": "spec s = F[0s, 0.2s] robot03 dist robot07 >= 99",
}


def scenes(seed: int, count: int = 125) -> sr.Trace:
    """Samples of boxes and discs of all sizes, anywhere; the first fills the whole scene."""
    draw = np.random.default_rng(seed)

    def outline() -> sr.Footprint:
        x, y = draw.uniform(0.0, 40.0, 2)
        side, other = draw.choice([0.2, 1.0, 4.0, 15.0], 2)
        return (
            sr.Footprint.disc(x, y, side)
            if draw.random() < 0.3
            else sr.Footprint.box(x, y, x + side, y + other)
        )

    first = {name: sr.Footprint.box(0.0, 0.0, 40.0, 40.0) for name in NAMES}
    samples = [sr.Sample(0, first)]
    samples += [sr.Sample(10**8 * time, {name: outline() for name in NAMES}) for time in range(1, count + 1)]
    return sr.Trace.from_samples(samples)


def name_box(text: str, x: float, y: float) -> shapely.Polygon:
    """The box of a name, a twentieth of the scene high."""
    return shapely.box(x - len(text) / 2.0, y - 1.0, x + len(text) / 2.0, y + 1.0)


def shape_of(entity: SceneEntity) -> shapely.Polygon:
    return shapely.union_all([shapely.Polygon([(p.x, p.y) for p in line.points]) for line in entity.lines])


@pytest.mark.parametrize("text", TEXTS.values(), ids=list(TEXTS))
def test_names_cover_no_deciding_object_and_no_other_name(text: str) -> None:
    source = MemorySource(scenes(seed=len(text)), "run")
    file = sr.parse_specification(f"group robots = all\nregion dock = box(0, 0, 40, 25)\n{text}")
    with TemporaryDirectory() as folder:
        output = Path(folder) / "annotated.mcap"
        run_replay(source, [file], output=output)
        with output.open("rb") as stream:
            messages = [
                SceneUpdate.FromString(each.data) for *_, each in make_reader(stream).iter_messages([SCENE])
            ]
    pointing = [{each.id: each for each in message.entities} for message in messages]
    pointing = [entities for entities in pointing if "witness" in entities]
    assert len(pointing) >= 120
    for entities in pointing:
        assert [key for key, each in entities.items() if each.texts] == ["witness"]
        *names, label = entities["witness"].texts
        deciding = [each.text.removesuffix(" ✕") for each in names]
        assert deciding and all(name in label.text for name in deciding)
        shapes = {name: shape_of(entities[f"object/{name}"]) for name in deciding if name != "dock"}
        boxes = [name_box(each.text, each.pose.position.x, each.pose.position.y) for each in (*names, label)]
        for box in boxes[:-1]:
            assert not any(box.intersects(shape) for shape in shapes.values())
        assert not any(one.intersects(other) for one, other in combinations(boxes, 2))
    if "forall" in text:
        shapes = {name: shape_of(entities[f"object/{name}"]) for name in NAMES}
        distances = {pair: shapes[pair[0]].distance(shapes[pair[1]]) for pair in combinations(NAMES, 2)}
        least = min(distances.values())
        assert distances[tuple(sorted(deciding))] == pytest.approx(least, abs=1e-9) or least == 0.0
