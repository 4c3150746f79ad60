"""The evidence of a log depends on its messages, and not on how a reader divides them."""

from __future__ import annotations

from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from mapping.feeding import SECOND, Feed, Made, make

MAPPING = """
sample: {every: 1s}
topics:
  /list: {objects: 'of[*]', name: 't{id}', class: {field: kind}, position: at, yaw: yaw, shape: {disc: size}}
  /bot: {name: bot, clock: header, position: at, orientation: q, order: wxyz, signals: {v: v}}
"""
# values that contradict assumptions, and many that do not
lengths = st.sampled_from([0.0, 0.1, 1.0, 30.0, 31.0, -400.0, 5_334_567.25, float("nan")])
things = st.fixed_dictionaries(
    {
        "id": st.integers(0, 2),
        "kind": st.sampled_from(["car", "car", "bus"]),
        "at": st.fixed_dictionaries({"x": lengths, "y": lengths}),
        "yaw": st.sampled_from([0.0, 1.0, 7.0, 90.0]),
        "size": st.sampled_from([0.0, 0.3, 300.0]),
    }
)
lists = st.lists(things, max_size=3, unique_by=lambda thing: thing["id"])
poses = st.fixed_dictionaries(
    {
        "at": st.fixed_dictionaries({"x": lengths, "y": lengths}),
        "v": lengths,
        "q": st.sampled_from(
            [(1.0, 0.0, 0.0, 0.0), (0.6, 0.0, 0.0, 0.8), (0.6, 0.8, 0.0, 0.0), (0, 0, 0, 0.5)]
        ),
    }
)
messages = st.one_of(
    st.tuples(st.just("/list"), lists.map(lambda listed: {"of": listed})), st.tuples(st.just("/bot"), poses)
)


def read(log: list[tuple[str, Any]], batch: int) -> Made:
    feed = Feed(types={"/list": "List", "/bot": "Bot"})
    for number, (topic, content) in enumerate(log):
        time_ns, stamp_ns = (SECOND + place * SECOND // 20 for place in (number, number // 8 * 8))
        header = {"stamp": {"sec": stamp_ns // SECOND, "nanosec": stamp_ns % SECOND}}
        feed.add(topic, time_ns, {**content, "header": header})
    return make(MAPPING, feed, batch=batch)


def said(made: Made) -> tuple[list[str], list[str]]:
    return [str(doubt) for doubt in made.doubts], [str(remark) for remark in made.remarks]


@given(st.lists(messages, min_size=1, max_size=40), st.integers(1, 12))
def test_evidence_does_not_depend_on_batches(log: list[tuple[str, Any]], batch: int) -> None:
    assert said(read(log, batch)) == said(read(log, 1000))


def test_evidence_of_many_messages_does_not_depend_on_batches() -> None:
    def pose(number: int) -> dict[str, Any]:
        x = 0.01 * number + 30.0 * (number % 7 in (3, 5))
        return {"at": {"x": x, "y": 0.0}, "q": (0.6, 0.0, 0.0, 0.8), "v": float(number % 3)}

    log = [("/bot", pose(number)) for number in range(9_000)]
    few, many = (said(read(log, batch)) for batch in (97, 5_000))
    assert few == many
    assert [name in "".join(few[0]) for name in ("stamps_advance", "one_object")] == [True, True]
