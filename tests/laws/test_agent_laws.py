"""Laws of the answers to agents: they are short, and their parts are all of them."""

from __future__ import annotations

import json

from hypothesis import given
from hypothesis import strategies as st

from examples import examples
from spatial_replay.agents.bounds import MOST_BYTES, page_of

texts = st.text(max_size=30) | st.text(max_size=3).map(lambda text: text * 900)
scalars = st.none() | st.booleans() | st.integers(-9, 9) | st.floats(-1.0, 1.0) | texts
values = st.recursive(
    scalars,
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.lists(inner, max_size=1).map(lambda part: part * 200)
        | st.dictionaries(st.text(max_size=8), inner, max_size=6)
    ),
    max_leaves=12,
)
documents = st.dictionaries(st.text(max_size=8), values, max_size=6)


@examples(25)
@given(
    st.lists(texts, max_size=40), st.lists(texts, max_size=40), documents, st.lists(documents, max_size=40)
)
def test_parts_are_short_and_together_are_all_lines_and_rows(lines, warnings, document, rows):
    following, count, shown = "", 0, []
    for _ in range(len(lines) + len(rows) + 1):
        page = page_of(lines, warnings, {**document, "rows": rows}, "rows", following)
        # lines are sent as text and as values
        twice = [page.lines, page.warnings] * 2
        size = len(json.dumps([*twice, page.document, page.left_off], ensure_ascii=False).encode())
        assert size <= MOST_BYTES - 500
        json.dumps(page, allow_nan=False)
        shown += page.lines
        count += len(page.document["rows"])
        following = page.next
        if not following:
            break
    assert following == ""
    assert count == len(rows)
    assert len(shown) == len(lines)
    assert all(line.isprintable() and len(line) <= 1_000 for line in shown)
