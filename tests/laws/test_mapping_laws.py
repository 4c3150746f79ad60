"""Laws of rotations, transforms, outlines and field paths, for every input."""

from __future__ import annotations

from math import pi

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from spatial_replay import Footprint
from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.outline import convex_hull
from spatial_replay.mapping.detections import BOX, Solids, footprints_from_solids
from spatial_replay.mapping.field_paths import FieldError, FieldPath, getter, style_of, walk
from spatial_replay.mapping.transforms import FrameTree, Transforms, matrices_from_quaternions, slerp

coordinates = st.floats(-100, 100, allow_subnormal=False)
quaternions = (
    st.lists(st.floats(-1, 1, allow_subnormal=False), min_size=4, max_size=4)
    .map(np.array)
    .filter(lambda q: np.linalg.norm(q) > 0.1)
)
points = st.lists(coordinates, min_size=3, max_size=3).map(np.array)


@st.composite
def transforms(draw: st.DrawFn) -> Transforms:
    rotation, _ = matrices_from_quaternions(draw(quaternions)[None])
    return Transforms(rotation, draw(points)[None], np.ones(1, np.bool_))


def applied(transform: Transforms, point: Floats) -> Floats:
    return np.asarray(transform.rotation[0] @ point + transform.translation[0])


@given(quaternions)
def test_quaternions_make_rotations(quaternion: Floats) -> None:
    (matrix,), _ = matrices_from_quaternions(quaternion[None])
    assert np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
    assert np.isclose(np.linalg.det(matrix), 1.0)
    (same,), _ = matrices_from_quaternions(-3.0 * quaternion[None])
    assert np.allclose(matrix, same, atol=1e-12)


@given(transforms(), transforms(), points)
def test_one_transform_after_another_is_both(first: Transforms, second: Transforms, point: Floats) -> None:
    both = second.after(first)
    assert np.allclose(applied(both, point), applied(second, applied(first, point)))


@given(transforms(), points)
def test_a_transform_and_its_inverse_cancel(transform: Transforms, point: Floats) -> None:
    assert np.allclose(applied(transform.inverse(), applied(transform, point)), point)
    assert np.allclose(applied(transform.inverse().inverse(), point), applied(transform, point))


@given(quaternions, quaternions, st.floats(0, 1))
def test_interpolation_turns_at_one_speed_from_one_to_the_other(
    first: Floats, second: Floats, share: float
) -> None:
    def angle(a: Floats, b: Floats) -> float:
        cosine = abs(a @ b) / np.linalg.norm(a) / np.linalg.norm(b)
        return float(2 * np.arccos(np.clip(cosine, 0, 1)))

    whole = angle(first, second)
    assume(whole < pi - 1e-3)
    (between,) = slerp(first[None], second[None], np.array([share]))
    assert np.isclose(angle(first, between), share * whole, atol=1e-6)
    assert np.isclose(angle(between, second), (1 - share) * whole, atol=1e-6)


@given(st.lists(st.tuples(points, quaternions), min_size=1, max_size=5), st.integers(0, 4), st.integers(0, 4))
def test_the_way_back_through_a_tree_undoes_the_way_there(
    steps: list[tuple[Floats, Floats]], one: int, other: int
) -> None:
    tree = FrameTree()
    for number, (translation, rotation) in enumerate(steps):
        # each frame hangs below an earlier one, not always the one before
        parent = f"f{number // 2}"
        pose = (*translation.tolist(), *(rotation / np.linalg.norm(rotation)).tolist())
        tree.add(f"f{number + 1}", parent, pose, stamp_ns=0, clock_ns=0, log_ns=0, is_static=True)
    a, b = f"f{min(one, len(steps))}", f"f{min(other, len(steps))}"
    times = np.zeros(1, np.int64)
    there, back = (tree.between(x, y, times, by_stamp=True) for x, y in ((a, b), (b, a)))
    assert there.known.all()
    total = there.after(back)
    assert np.allclose(total.rotation[0], np.eye(3), atol=1e-9)
    assert np.allclose(total.translation[0], 0.0, atol=1e-7)


@given(quaternions, points, st.lists(st.floats(0.1, 10), min_size=3, max_size=3))
def test_the_footprint_of_a_box_is_the_hull_of_its_corners(
    quaternion: Floats, position: Floats, sizes: list[float]
) -> None:
    (rotation,), _ = matrices_from_quaternions(quaternion[None])
    box = Solids(
        owner=np.zeros(1, np.int64),
        kind=np.array([BOX], np.int8),
        position=position[None],
        rotation=rotation[None],
        size=np.array([sizes]),
        point_start=np.zeros(2, np.int64),
        points=np.empty((0, 3)),
    )
    found = footprints_from_solids(box, 1)
    signs = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T
    corners = (signs * sizes) @ rotation.T + position
    hull = Footprint.polygon(convex_hull(corners[:, :2]))
    assert np.isclose(area(Footprint.polygon(found.vertices)), area(hull), rtol=1e-6, atol=1e-9)
    assert np.allclose(np.sort(found.vertices, axis=0)[[0, -1]], np.sort(corners[:, :2], axis=0)[[0, -1]])
    assert np.isclose(found.bottom[0], corners[:, 2].min())
    assert np.isclose(found.top[0], corners[:, 2].max())


def area(footprint: Footprint) -> float:
    total = 0.0
    for part in footprint.parts:
        x, y = part.vertices.T
        total += 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))
    return total


names = st.from_regex(r"[a-z_][a-z0-9_]{0,5}", fullmatch=True)
trees = st.recursive(
    st.integers(), lambda inner: st.dictionaries(names, inner, max_size=3) | st.lists(inner, max_size=3)
)


@given(trees, st.lists(names | st.integers(0, 3), min_size=1, max_size=4))
def test_a_compiled_path_finds_what_a_step_by_step_walk_finds(tree: object, steps: list[str | int]) -> None:
    first, *rest = steps
    text = f"{first if isinstance(first, str) else 'x'}" + "".join(
        f".{step}" if isinstance(step, str) else f"[{step}]" for step in rest
    )
    path = FieldPath.of(text)
    get = getter(path, style_of(tree))
    try:
        expected = walk(path, tree)
    except FieldError:
        return
    assert get(tree) == expected
