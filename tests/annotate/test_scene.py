"""What a viewer finds in the messages of /spatial/scene."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from examples import examples
from spatial_replay import ConvexPart, Footprint, Sample, Trace, TrackedObject, parse_specification
from spatial_replay.annotate.deciding_leaf import leaf_pairs
from spatial_replay.annotate.requirements import requirements_of
from spatial_replay.annotate.scene.scene_update import PERIOD_NS, SceneEncoder
from spatial_replay.annotate.violations import EvaluatedResult
from spatial_replay.logs.source import MemorySource
from spatial_replay.monitor.stream import EvaluationStream, SeriesBlock, find_instances
from spatial_replay.replay.engine import run_replay
from spatial_replay.spec.formula import Atom, Outline, RegionName, SignedDistance, TrackedName, iter_nodes

FRAME_NS = 1_000_000_000 // 30
REGIONS = {
    "goal": Outline(((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))),
    "shelf": Outline(((2.0, 0.0),), 0.5, (1.0, 1.5)),
    "corner": Outline(((0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (1.0, 1.0), (1.0, 2.0), (0.0, 2.0))),
}


def near(first: str, second: str) -> Atom:
    terms = TrackedName(first), RegionName(second) if second in REGIONS else TrackedName(second)
    return Atom(f"{first} closeto[1] {second}", "closeto", 1.0 - SignedDistance(*terms), terms=terms)


def says(formula, trace: Trace, now) -> EvaluatedResult:
    """A formula with the given numbers (N, T) or (T,) of its nodes now."""
    series = np.full((len(list(iter_nodes(formula))), 4, len(trace)), np.nan)
    series[:, 1] = now
    return EvaluatedResult(
        requirements_of(formula), SeriesBlock(trace.times_ns, series, np.empty((1, 0, len(trace))))
    )


def run(*samples: dict, period_ns: int = FRAME_NS) -> Trace:
    return Trace.from_samples(Sample(index * period_ns, objects) for index, objects in enumerate(samples))


def named(requirements) -> frozenset[str]:
    """The objects that some requirements name."""
    return frozenset(name for each in requirements for name in each.objects)


def messages(trace: Trace, *evaluated: EvaluatedResult, regions=None) -> list[SceneUpdate]:
    asked = named(own for each in evaluated for own in each.requirements)
    encoded = SceneEncoder(regions or {}, "", asked).encode(trace, evaluated)
    return [SceneUpdate.FromString(payload) for payload in encoded.payloads]


def entity(message: SceneUpdate, identifier: str):
    [found] = [each for each in message.entities if each.id == identifier]
    return found


def tint(message: SceneUpdate, identifier: str) -> str:
    """The colour of an entity's lines and faces, in words."""
    drawn = entity(message, identifier)
    [(red, _, blue)] = {
        (each.color.r, each.color.g, each.color.b) for each in [*drawn.lines, *drawn.triangles]
    }
    return "grey" if red == blue else "blue" if blue > red else "red"


def points(primitive) -> list[tuple[float, float]]:
    return [(point.x, point.y) for point in primitive.points]


BOX = Footprint.box(0.0, 0.0, 2.0, 1.0)
DISC = Footprint.disc(3.0, 0.0, 0.5)

# ------------------------------------------------------------------------------------------------ laws

COORDINATES = st.integers(-50, 50).map(lambda number: number / 8)


@st.composite
def tracked(draw: st.DrawFn):
    x, y = draw(COORDINATES), draw(COORDINATES)
    footprint = draw(
        st.sampled_from(
            [
                Footprint.box(x, y, x + 1.0, y + 2.0),
                Footprint.disc(x, y, 0.5),
                Footprint.disc(x, y, 0.0),
                Footprint.capsule((x, y), (x + 1.0, y), 0.25),
                Footprint.union([Footprint.box(x, y, x + 1.0, y + 1.0), Footprint.disc(x, y, 1.0)]),
            ]
        )
    )
    return TrackedObject(
        footprint, draw(st.sampled_from([None, "cup"])), height=draw(st.none() | st.just((0.0, y * y)))
    )


@st.composite
def runs(draw: st.DrawFn) -> Trace:
    names = ["a", "b", "ccc"]
    gaps = draw(st.lists(st.integers(1, 3 * PERIOD_NS), min_size=1, max_size=8))
    samples = [
        Sample(time, {name: draw(tracked()) for name in names if draw(st.booleans())})
        for time in np.cumsum(gaps).tolist()
    ]
    return Trace.from_samples(samples)


@examples(60)
@given(runs(), st.data())
def test_cutting_a_run_into_blocks_changes_no_byte(trace, data):
    said = says(near("a", "goal"), trace, np.linspace(-1.0, 1.0, len(trace)))
    encoder = SceneEncoder(REGIONS, "", frozenset({"a", "ccc"}))
    whole = encoder.encode(trace, [said])
    cuts = sorted(data.draw(st.sets(st.integers(0, len(trace)))) | {0, len(trace)})
    times, payloads, state = [], [], None
    for begin, end in pairwise(cuts):
        # blocks read from a log know only the names that are in them
        block = trace.slice(begin, end).compact()
        part = encoder.encode(block, [said], state)
        times += part.times_ns.tolist()
        payloads += part.payloads
        state = part.state
    assert times == whole.times_ns.tolist()
    assert payloads == list(whole.payloads)


@examples(60)
@given(runs())
def test_a_viewer_shows_exactly_the_objects_of_the_sample(trace):
    encoded = SceneEncoder({}).encode(trace)
    shown: set[str] = set()
    samples = {sample.time_ns: sample for sample in trace.samples()}
    for time_ns, payload in zip(encoded.times_ns.tolist(), encoded.payloads, strict=True):
        message = SceneUpdate.FromString(payload)
        for deletion in message.deletions:
            assert deletion.type == SceneEntityDeletion.MATCHING_ID
            assert deletion.timestamp.ToNanoseconds() == time_ns
            shown.remove(deletion.id)
        shown |= {each.id for each in message.entities}
        assert shown == {f"object/{name}" for name in samples[time_ns].objects}
        for each in message.entities:
            assert each.timestamp.ToNanoseconds() == time_ns
            assert (each.frame_id, each.HasField("lifetime")) == ("world", False)


@examples(60)
@given(runs())
def test_messages_keep_their_distance_in_time(trace):
    times = SceneEncoder({}).encode(trace).times_ns
    assert times[0] == trace.times_ns[0]
    assert (np.diff(times) >= PERIOD_NS).all()
    for time_ns in set(trace.times_ns.tolist()) - set(times.tolist()):
        before = times[np.searchsorted(times, time_ns) - 1]
        assert time_ns - before < PERIOD_NS


@given(st.integers(0, 2**63 - 1))
def test_every_time_is_written_exactly(time_ns):
    trace = Trace.from_samples([Sample(time_ns, {"a": BOX})])
    [message] = messages(trace)
    assert message.entities[0].timestamp.ToNanoseconds() == time_ns


# --------------------------------------------------------------------------------------------- shapes


def test_a_polygon_is_outlined_filled_and_labelled():
    [message] = messages(run({"cup": BOX}))
    drawn = entity(message, "object/cup")
    corners = [(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (0.0, 1.0)]
    [line], [face], [label] = drawn.lines, drawn.triangles, drawn.texts
    assert line.type == line.LINE_LOOP
    assert points(line) == corners
    assert points(face) == corners
    assert list(face.indices) == [0, 1, 2, 0, 2, 3]
    assert label.text == "cup"
    assert (label.pose.position.x, label.pose.position.y) == (1.0, 0.5)
    assert line.pose.orientation.w == face.pose.orientation.w == label.pose.orientation.w == 1.0


@pytest.mark.parametrize(
    ("footprint", "distance"),
    [
        (Footprint.disc(3.0, 1.0, 0.5), lambda x, y: np.hypot(x - 3.0, y - 1.0)),
        (
            Footprint.capsule((0.0, 0.0), (2.0, 0.0), 0.5),
            lambda x, y: np.hypot(x - np.clip(x, 0.0, 2.0), y),
        ),
    ],
)
def test_the_ring_of_a_rounded_part_lies_on_its_border(footprint, distance):
    [message] = messages(run({"a": footprint}))
    for primitive in (*entity(message, "object/a").lines, *entity(message, "object/a").triangles):
        ring = np.array(points(primitive))
        assert len(ring) == 32
        assert np.allclose(distance(*ring.T), 0.5)


def test_every_part_of_a_union_is_drawn():
    parts = Footprint(
        (ConvexPart(np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)])), ConvexPart(np.array([(5.0, 5.0)]), 1.0))
    )
    [message] = messages(run({"a": parts}))
    assert [len(line.points) for line in entity(message, "object/a").lines] == [3, 32]


def test_a_point_is_a_small_disc_and_a_segment_a_line():
    shapes = {
        "point": Footprint.disc(1.0, 1.0, 0.0),
        "segment": Footprint.capsule((0.0, 0.0), (1.0, 0.0), 0.0),
    }
    [message] = messages(run(shapes | {"box": BOX}))
    x, y = np.array(points(entity(message, "object/point").lines[0])).T
    assert 0.0 < np.hypot(x - 1.0, y - 1.0).max() < 0.1
    assert not entity(message, "object/segment").triangles


def test_an_object_with_height_is_a_prism():
    [message] = messages(run({"cup": TrackedObject(BOX, height=(0.5, 2.0))}))
    drawn = entity(message, "object/cup")
    face, sides = drawn.triangles
    assert drawn.lines[0].pose.position.z == face.pose.position.z == 2.0
    assert sides.pose.position.z == 0.5
    assert [point.z for point in sides.points] == [0.0] * 4 + [1.5] * 4
    assert points(sides) == points(face) * 2
    triangles = np.array(sides.indices).reshape(-1, 3)
    # two triangles for each side, upright: the corners of a side are neighbours
    assert len({frozenset(corners) for corners in triangles.tolist()}) == 2 * 4
    for corners in triangles % 4:
        assert len(set(corners.tolist())) == 2
        assert (corners.max() - corners.min()) in (1, 3)


def test_regions_are_in_every_message():
    for message in messages(run({"a": BOX}, {}), regions=REGIONS):
        goal, shelf, corner = (entity(message, f"region/{name}") for name in ("goal", "shelf", "corner"))
        assert points(goal.lines[0]) == list(REGIONS["goal"].vertices)
        assert len(shelf.lines[0].points) == 32
        assert [face.pose.position.z for face in shelf.triangles] == [1.0, 1.0]
        assert len(corner.lines) == 1
        assert len(corner.triangles) > 1
        assert [each.texts[0].text for each in (goal, shelf, corner)] == ["goal", "shelf", "corner"]


def test_names_stand_above_what_they_name():
    tall = TrackedObject(DISC, height=(0.5, 2.0))
    shown = messages(run({"a": BOX, "b": tall}), regions=REGIONS)[0]
    for drawn in shown.entities:
        assert drawn.texts[0].pose.position.z > max(face.pose.position.z for face in drawn.triangles)


def test_the_name_of_a_region_stands_at_its_upper_edge():
    [message] = messages(run({}), regions=REGIONS)
    for name, edge in (("goal", (0.5, 1.0)), ("shelf", (2.0, 0.5)), ("corner", (1.0, 2.0))):
        place = entity(message, f"region/{name}").texts[0].pose.position
        assert (place.x, place.y) == pytest.approx(edge, abs=1e-3)


def test_the_number_of_a_violation_stands_above_its_arrow():
    [message] = pointed("spec s = G a closeto[1] b", {"a": box_at(0.0), "b": box_at(5.0)})
    drawn = entity(message, "witness")
    head = drawn.arrows[0].pose.position.z + drawn.arrows[0].head_diameter / 2.0
    assert drawn.texts[0].pose.position.z > head


def test_objects_are_more_opaque_than_the_regions_that_they_lie_in():
    [message] = messages(run({"a": BOX}), regions=REGIONS)
    of_object, of_region = (
        entity(message, each).triangles[0].color.a for each in ("object/a", "region/goal")
    )
    assert of_object > of_region > 0.0


def test_flat_objects_lie_above_flat_regions():
    [message] = messages(run({"a": BOX}), regions=REGIONS)
    assert entity(message, "object/a").triangles[0].pose.position.z > 0.0
    assert entity(message, "region/goal").triangles[0].pose.position.z == 0.0


def test_unreadable_coordinates_are_not_drawn():
    seen = run({"a": BOX, "b": DISC}, {"a": BOX, "b": DISC})
    rows = seen.rows.copy()
    rows[1, 0] = -2 - rows[1, 0]
    trace = Trace(
        seen.times_ns,
        seen.names,
        rows,
        seen.footprints,
        seen.yaw,
        seen.uncertainty,
        seen.class_code,
        seen.classes,
    )
    message = messages(trace)[1]
    assert [each.id for each in message.entities] == ["object/b"]
    assert [each.id for each in message.deletions] == ["object/a"]


# -------------------------------------------------------------------------------------------- colours


def test_the_colour_follows_the_sign_of_the_robustness():
    trace = run(*[{"a": BOX, "b": DISC, "c": BOX}] * 3)
    shown = messages(trace, says(near("a", "b"), trace, [0.5, -0.5, np.nan]))
    assert [tint(message, "object/a") for message in shown] == ["blue", "red", "grey"]
    assert [tint(message, "object/b") for message in shown] == ["blue", "red", "grey"]
    assert [tint(message, "object/c") for message in shown] == ["grey"] * 3


def test_the_worst_of_several_specifications_counts():
    trace = run(*[{"a": BOX, "b": DISC}] * 2)
    first = says(near("a", "goal"), trace, [0.5, np.nan])
    second = says(near("a", "b"), trace, [-0.1, 0.2])
    shown = messages(trace, first, second, regions=REGIONS)
    assert [tint(message, "object/a") for message in shown] == ["red", "blue"]
    assert [tint(message, "region/goal") for message in shown] == ["blue", "grey"]


def test_a_stronger_robustness_has_a_fuller_colour():
    trace = run(*[{"a": BOX}] * 4)
    shown = messages(trace, says(near("a", "a"), trace, [0.0, 0.5, 2.0, 50.0]))
    blue = [entity(message, "object/a").lines[0].color.b for message in shown]
    assert blue[0] < blue[1] < blue[2] == blue[3]


def test_samples_without_an_evaluation_are_grey():
    trace = run(*[{"a": BOX}] * 4)
    late = says(near("a", "a"), trace.slice(2, 4), 1.0)
    shown = messages(trace, late)
    assert [tint(message, "object/a") for message in shown] == ["grey", "grey", "blue", "blue"]


def test_a_robustness_of_zero_is_blue():
    trace = run({"a": BOX})
    [message] = messages(trace, says(near("a", "a"), trace, 0.0))
    assert tint(message, "object/a") == "blue"


def test_colours_are_full_at_the_median_size_of_the_first_objects():
    # longer sides: 4, 2 and 1, far from the origin
    sizes = {"a": Footprint.box(100.0, 7.0, 104.0, 8.0), "b": Footprint.disc(-50.0, 0.0, 1.0)}
    sizes["c"] = Footprint.box(0.0, 0.0, 1.0, 1.0)
    trace = run({}, sizes, sizes, sizes, {"a": Footprint.box(0.0, 0.0, 90.0, 90.0)})
    shown = messages(trace, says(near("a", "a"), trace, [1.9, 1.9, 2.0, 3.0, 2.0]))
    first, *rest = [entity(message, "object/a").lines[0].color.b for message in shown[1:]]
    assert first < rest[0]
    assert rest == [rest[0]] * 3


def test_later_objects_do_not_change_earlier_colours():
    trace = run({}, {"a": Footprint.box(0.0, 0.0, 90.0, 90.0)})
    said = says(near("a", "goal"), trace, 0.5)
    assert messages(trace, said, regions=REGIONS)[0] == messages(trace.slice(0, 1), said, regions=REGIONS)[0]


# ------------------------------------------------------------------------------------- the worst violation


def pointed(text: str, *samples: dict, cuts: tuple[int, ...] = ()) -> list[SceneUpdate]:
    """The messages of a specification over samples, evaluated and drawn in one or more stretches."""
    spec = parse_specification(text)
    trace = run(*samples)
    instances = find_instances(spec, {}, (), 0, 2**63 - 1)
    evaluation = EvaluationStream(instances, spec.regions)
    requirements = [requirements_of(instance.formula) for instance in instances]
    asked = named(each for own in requirements for each in own)
    encoder, state, payloads = SceneEncoder(spec.regions, "", asked), None, []
    for begin, end in pairwise((0, *cuts, len(trace))):
        part = trace.slice(begin, end)
        results = [
            EvaluatedResult(own, block, leaf_pairs(instance, own, spec.regions))
            for instance, own, block in zip(instances, requirements, evaluation.extend(part), strict=True)
        ]
        encoded = encoder.encode(part, results, state)
        state = encoded.state
        payloads += encoded.payloads
    return [SceneUpdate.FromString(payload) for payload in payloads]


def box_at(x: float) -> Footprint:
    return Footprint.box(x, 0.0, x + 1.0, 1.0)


def arrow(message: SceneUpdate) -> tuple[list[float], list[float], str]:
    """Where the arrow at the worst violation begins and ends, and its label."""
    drawn = entity(message, "witness")
    [shape], [*_, label] = drawn.arrows, drawn.texts
    length = shape.shaft_length + shape.head_length
    angle = 2.0 * np.arctan2(shape.pose.orientation.z, shape.pose.orientation.w)
    begin = np.array([shape.pose.position.x, shape.pose.position.y])
    end = begin + length * np.array([np.cos(angle), np.sin(angle)])
    return begin.round(9).tolist(), end.round(9).tolist(), label.text.strip()


def test_an_arrow_with_its_number_points_at_the_worst_violation():
    samples = [{"a": box_at(0.0), "b": box_at(x), "c": box_at(-20.0)} for x in (3.0, 1.5, 1.2, 9.0)]
    shown = pointed("spec s = G (a closeto[1] b) and G (a farfrom[0] c)", *samples)
    identifiers = [{each.id for each in message.entities} for message in shown]
    assert ["witness" in each for each in identifiers] == [True, False, False, True]
    assert [each.id for each in shown[1].deletions] == ["witness"]
    assert not shown[2].deletions
    assert arrow(shown[0])[2] == "a closeto[1] b now: -1"
    begin, end, label = arrow(shown[3])
    assert (begin[0], end[0], label) == (1.0, 9.0, "a closeto[1] b now: -7")
    assert begin[1] == end[1]


def test_names_and_labels_of_an_arrow_cover_no_other_object_where_a_side_is_free():
    objects = {"a": box_at(0.0), "b": box_at(9.0), "c": Footprint.box(-1.0, 1.1, 11.0, 3.0)}
    [message] = pointed("spec s = G (a dist b >= 99)", objects)
    line = 12.0 / 20.0
    for text in entity(message, "witness").texts:
        y = text.pose.position.y
        assert y + line / 2.0 <= 1.1 or y - line / 2.0 >= 3.0, text.text


def test_the_name_of_an_object_that_failed_moves_off_another_object_where_a_side_is_free(tmp_path: Path):
    wall = Footprint.box(-1.0, -3.0, 30.0, -0.1)
    source = MemorySource(run(*({"a": box_at(0.0), "b": box_at(x), "c": wall} for x in (2.0, 9.0))), "run")
    output = tmp_path / "annotated.mcap"
    run_replay(source, [parse_specification("spec s = G (a dist b >= 2)")], output=output)
    with output.open("rb") as stream:
        later = [record.data for *_, record in make_reader(stream).iter_messages(["/spatial/scene"])][1]
    [name] = entity(SceneUpdate.FromString(later), "object/a").texts
    assert name.text == "a ✕"
    assert name.pose.position.y > 1.0


def test_a_name_stands_below_an_object_that_is_too_small_for_it():
    [message] = pointed(
        "spec s = G (a dist big >= 0)",
        {"a": Footprint.box(0, 0, 0.1, 0.1), "big": Footprint.box(3, 0, 12, 9)},
    )
    places = {name: entity(message, f"object/{name}").texts[0].pose.position.y for name in ("a", "big")}
    assert places["a"] < 0.0
    assert places["big"] > 0.0


def test_the_number_of_an_arrow_is_in_the_unit_of_the_log():
    [message] = pointed("scale lengths = 4\nspec s = G a closeto[1] b", {"a": box_at(0.0), "b": box_at(9.0)})
    assert arrow(message)[2] == "a closeto[1] b now: -7"


def test_the_arrow_of_an_enclosure_shows_what_sticks_out():
    text = "region goal = box(0, 0, 2, 2)\nspec s = G a enclosedin goal"
    [message] = pointed(text, {"a": Footprint.box(1.0, 0.5, 3.5, 1.0)})
    begin, end, label = arrow(message)
    assert (begin[0], end[0], label) == (3.5, 2.0, "a enclosedin goal now: -1.5")


def test_the_arrow_of_a_direction_joins_what_is_nearest():
    [message] = pointed("spec s = G a leftof b", {"a": box_at(4.0), "b": box_at(0.0)})
    begin, end, label = arrow(message)
    assert (begin[0], end[0], label) == (4.0, 1.0, "a leftof b now: -5")


def test_a_requirement_not_to_hold_is_pointed_at_too():
    [message] = pointed("spec s = G not a closeto[3] b", {"a": box_at(0.0), "b": box_at(2.0)})
    assert arrow(message)[2] == "a closeto[3] b now: must not hold, holds by 2"


def test_a_constant_has_no_arrow():
    [message] = pointed("spec s = G false and G a closeto[9] a", {"a": BOX})
    assert not {each.id for each in message.entities} - {"object/a"}


def test_a_missing_member_of_a_group_and_a_look_back_have_no_arrow():
    text = "group all_of = all\nspec s = G exists o in all_of: o closeto[1] a\nspec t = G a moved[9] a[-1]"
    for message in pointed(text, *[{"a": box_at(0.0), "b": box_at(9.0)}] * 3):
        assert "witness" not in {each.id for each in message.entities}


@pytest.mark.parametrize(
    "text", ["F a closeto[1] b", "not (G a farfrom[1] b)", "(not a farfrom[9] b) U (a closeto[1] b)"]
)
def test_a_fulfilled_obligation_has_no_requirements(text):
    shown = pointed(f"spec s = {text}", *[{"a": box_at(0.0), "b": box_at(x)} for x in (4.0, 1.5, 12.0)])
    assert [tint(message, "object/a") for message in shown[1:]] == ["grey", "grey"]
    assert not any(each.id == "witness" for message in shown[1:] for each in message.entities)


def test_an_empty_group_hides_no_arrow():
    drink = 'group drinks = class "drink"\nspec s = F (exists o in drinks: o closeto[1] a)\n'
    [message] = pointed(drink + "spec t = G a closeto[1] b", {"a": box_at(0.0), "b": box_at(3.0)})
    assert arrow(message)[2] == "a closeto[1] b now: -1"


def test_cutting_a_run_moves_no_arrow():
    samples = [
        {"a": TrackedObject(box_at(0.0), height=(0.0, 2.0)), "b": box_at(x)} if x else {"b": box_at(1.0)}
        for x in (3.0, 1.5, 0.0, 9.0, 0.0, 0.0, 9.0)
    ]
    whole = pointed("spec s = G (a closeto[1] b)", *samples)
    assert pointed("spec s = G (a closeto[1] b)", *samples, cuts=tuple(range(1, 7))) == whole
    assert entity(whole[0], "witness").arrows[0].pose.position.z > 2.0


# ------------------------------------------------------------------------------------------- crowded scenes


def test_a_crowd_has_labels_only_where_something_is_said_or_wrong():
    many = {
        f"o{index}": TrackedObject(Footprint.box(3.0 * index, 9.0, 3.0 * index + 1.0, 10.0), "crowd")
        for index in range(40)
    }
    text = 'group crowd = class "crowd"\nspec s = G a closeto[2] b\n'
    text += "spec t = G forall o in crowd: o dist a >= 1"
    few = dict(list(many.items())[:18])
    [message] = pointed(text, {**few, "a": box_at(0.0), "b": box_at(1.0)})
    labelled = {each.id for each in message.entities if each.texts and each.id.startswith("object/")}
    assert labelled == {"object/a", "object/b"}
    named = " and ".join(f"o{index} dist a >= 0" for index in range(40))
    [message] = pointed(
        f"spec s = G a closeto[9] z\nspec t = G ({named})", {**many, "a": box_at(0.0), "z": box_at(9.0)}
    )
    labelled = {each.id for each in message.entities if each.texts and each.id.startswith("object/")}
    assert "object/a" in labelled
    assert len(labelled) == 20
    [sparse] = pointed(text, {"a": box_at(0.0), "b": box_at(1.0), "o1": many["o1"]})
    assert all(each.texts for each in sparse.entities)


def test_small_things_lie_above_large_ones():
    small, large = Footprint.box(0.0, 0.0, 0.1, 0.1), Footprint.box(-9.0, -9.0, 9.0, 9.0)
    regions = {"town": (-99.0, 99.0), "room": (-9.0, 9.0)}
    text = "\n".join(f"region {name} = box({a}, {a}, {b}, {b})" for name, (a, b) in regions.items())
    [message] = pointed(f"{text}\nspec s = G (a enclosedin town)", {"a": small, "b": large})
    heights = [
        entity(message, name).triangles[0].pose.position.z
        for name in ("region/town", "region/room", "object/b", "object/a")
    ]
    assert heights == sorted(set(heights))


# ------------------------------------------------------------------------------------- whose fault it is


@pytest.mark.parametrize(
    "text",
    [
        "spec s = G (p dist car >= 1 and q dist car >= 1)",
        'group people = class "person"\nspec s = G (forall each in people: each dist car >= 1)',
        'group people = class "person"\nspec s = G not (exists each in people: each dist car < 1)',
    ],
)
def test_each_object_is_coloured_by_what_is_asked_of_itself(text: str, tmp_path: Path):
    """`p` is too near in the second sample, `q` never: also in the scene of the finished log."""
    samples = [
        Sample(
            index * 10**8,
            {
                "car": TrackedObject(Footprint.box(0, 0, 1, 1)),
                "p": TrackedObject(Footprint.box(x, 0, x + 1, 1), "person"),
                "q": TrackedObject(Footprint.box(9, 0, 10, 1), "person"),
            },
        )
        for index, x in enumerate((4.0, 1.5, 4.0))
    ]
    output = tmp_path / "annotated.mcap"
    run_replay(MemorySource.from_samples(samples), [parse_specification(text)], output=output)
    with output.open("rb") as stream:
        drawn = [
            SceneUpdate.FromString(message.data)
            for *_, message in make_reader(stream).iter_messages(["/spatial/scene"])
        ]
    for message, wrong in zip(drawn, [set(), {"car", "p"}, set(), {"car", "p"}], strict=True):
        red = {
            each.id.removeprefix("object/")
            for each in message.entities
            if each.id.startswith("object/") and each.triangles[0].color.r > each.triangles[0].color.b
        }
        assert red == wrong
