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


def scenes(seed: int, count: int = 125, *, grows: bool = False) -> sr.Trace:
    """Samples of boxes and discs of all sizes, anywhere; the first fills the scene, or the scene grows."""
    draw = np.random.default_rng(seed)

    def outline(room: float) -> sr.Footprint:
        x, y = draw.uniform(0.0, 40.0, 2) * room
        side, other = draw.choice([0.2, 1.0, 4.0, 15.0], 2) * room
        return (
            sr.Footprint.disc(x, y, side)
            if draw.random() < 0.3
            else sr.Footprint.box(x, y, x + side, y + other)
        )

    rooms = np.linspace(0.02, 1.0, count) if grows else np.ones(count)
    first = {name: sr.Footprint.box(0.0, 0.0, *2 * [40.0 * rooms[0]]) for name in NAMES}
    samples = [sr.Sample(0, first)]
    samples += [
        sr.Sample(10**8 * time, {name: outline(room) for name in NAMES})
        for time, room in enumerate(rooms.tolist(), 1)
    ]
    return sr.Trace.from_samples(samples)


def name_box(text: str, x: float, y: float, scene: shapely.Polygon) -> shapely.Polygon:
    """The box of a name, a twentieth of the scene high."""
    line = size_of(scene) / 20.0
    half = len(text) * line / 4.0
    return shapely.box(x - half, y - line / 2.0, x + half, y + line / 2.0)


def size_of(scene: shapely.Polygon) -> float:
    xmin, ymin, xmax, ymax = scene.bounds
    return max(xmax - xmin, ymax - ymin)


def shape_of(entity: SceneEntity) -> shapely.Polygon:
    return shapely.union_all([shapely.Polygon([(p.x, p.y) for p in line.points]) for line in entity.lines])


@pytest.mark.parametrize("grows", [False, True], ids=["whole", "growing"])
@pytest.mark.parametrize("text", TEXTS.values(), ids=list(TEXTS))
def test_names_cover_no_deciding_object_and_no_other_name(text: str, *, grows: bool) -> None:
    source = MemorySource(scenes(seed=len(text), count=60 if grows else 125, grows=grows), "run")
    regions = "" if grows and "dock" not in text else "region dock = box(0, 0, 40, 25)\n"
    file = sr.parse_specification(f"group robots = all\n{regions}{text}")
    with TemporaryDirectory() as folder:
        output = Path(folder) / "annotated.mcap"
        run_replay(source, [file], output=output)
        with output.open("rb") as stream:
            messages = [
                SceneUpdate.FromString(record.data)
                for *_, record in make_reader(stream).iter_messages([SCENE])
            ]
    scene, pointing_count = shapely.Polygon(), 0
    for message in messages:
        entities = {entity.id: entity for entity in message.entities}
        shapes = {name: shape_of(entity) for name, entity in entities.items() if name != "witness"}
        scene = shapely.box(*shapely.union_all([scene, *shapes.values()]).bounds)
        if "witness" not in entities:
            continue
        pointing_count += 1
        assert [name for name, entity in entities.items() if entity.texts] == ["witness"]
        *names, label = entities["witness"].texts
        deciding = [name.text.removesuffix(" ✕") for name in names]
        assert deciding and all(name in label.text for name in deciding)
        moving = [shapes[f"object/{name}"] for name in deciding if name != "dock"]
        boxes = [
            name_box(name.text, name.pose.position.x, name.pose.position.y, scene) for name in (*names, label)
        ]
        assert not any(box.intersects(shape) for box in boxes for shape in moving)
        assert not any(one.intersects(other) for one, other in combinations(boxes, 2))
        view = scene.centroid.buffer(0.75 * size_of(scene) + 1e-9, cap_style="square")
        assert view.contains(boxes[-1])
        assert not any(boxes[-1].intersects(shape) for name, shape in shapes.items() if name != "region/dock")
        if "forall" in text:
            distances = {
                pair: shapes[f"object/{pair[0]}"].distance(shapes[f"object/{pair[1]}"])
                for pair in combinations(NAMES, 2)
            }
            least = min(distances.values())
            assert distances[tuple(sorted(deciding))] == pytest.approx(least, abs=1e-9) or least == 0.0
    assert pointing_count >= len(messages) - 3
