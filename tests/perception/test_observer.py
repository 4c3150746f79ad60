"""Frames to samples: the real detector on rendered pictures, whose truth is known."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from perception.filmed import (
    BLOCKS,
    FROM_THE_SIDE,
    LENS,
    PERIOD_NS,
    REFERENCES,
    TABLE,
    circling,
    compressed,
    film,
    picture,
    plate,
    plates,
)
from spatial_replay import TrackedObject, UsageError
from spatial_replay.perception import Frame, TagObserver, observe_frames, parse_tags
from spatial_replay.perception.opencv import (
    Camera,
    Detection,
    TagDetector,
    corners_from_apriltag,
    pose_looking_at,
    rotations,
)
from spatial_replay.runs.virtual_camera import Plate, render

pytest.importorskip("cv2")

FLAT = f"{BLOCKS}\n{REFERENCES}\n".replace("plane: {", "plane: {height: 40mm, ")


def true_corners(each: Plate) -> np.ndarray:
    """Return where the corners of a tag are in the picture."""
    half = each.size / 2
    square = [each.centre + half * (i * each.axes[0] + j * each.axes[1]) for i, j in SQUARE]
    return LENS.pixels(np.array(square) @ rotations(FROM_THE_SIDE[None, :3])[0].T + FROM_THE_SIDE[3:])


SQUARE = ((-1, -1), (1, -1), (1, 1), (-1, 1))


def place_of(each: TrackedObject) -> np.ndarray:
    return np.concatenate([part.vertices for part in each.footprint.parts]).mean(axis=0)


def test_corners_are_where_they_are_and_another_detector_agrees_but_for_half_a_pixel() -> None:
    pyapriltags = pytest.importorskip("pyapriltags")
    ours, theirs = TagDetector("36h11"), pyapriltags.Detector(families="tag36h11", quad_decimate=1.0)
    off: list[np.ndarray] = []
    between: list[np.ndarray] = []
    drawn = np.random.default_rng(4)
    for seed in range(6):
        scene = [
            plate(n, 0.4 + 0.14 * (n % 2), -0.09 + 0.12 * (n // 2), 0.0, *drawn.uniform(-3, 3, 1), size=0.06)
            for n in range(4)
        ]
        image = picture(scene, seed=seed)
        other = {each.tag_id: each.corners for each in theirs.detect(image)}
        found = ours.detect(image)
        assert [each.id for each in found] == [0, 1, 2, 3]
        for each in found:
            off.append(each.corners - true_corners(scene[each.id]))
            between.append(each.corners - corners_from_apriltag(other[each.id]))
    # in pixels: neither is biased, and no half a pixel is left between the two
    assert np.abs(np.mean(np.concatenate(off), axis=0)).max() < 0.02
    assert np.concatenate(off).std() < 0.1
    assert np.abs(np.mean(np.concatenate(between), axis=0)).max() < 0.03


@pytest.mark.parametrize("text", [TABLE, FLAT], ids=["camera", "homography"])
def test_the_truth_is_within_the_stated_uncertainty(text: str) -> None:
    tags = parse_tags(text)
    top = 0.04 if tags.camera else 0.0
    drawn = np.random.default_rng(7)
    observer = TagObserver(tags)
    stated = []
    for seed in range(12):
        poses = {
            number: (*drawn.uniform([0.37 + 0.13 * number, -0.1], [0.43 + 0.13 * number, 0.1]), yaw)
            for number, yaw in enumerate(drawn.uniform(-3, 3, 2))
        }
        scene = plates(tags, poses, top)
        image = picture(scene, seed=seed, noise=3.0, blur_px=0.7)
        sample = observer.observe(Frame(seed, image)).sample
        assert set(sample.objects) == {"red", "blue"}
        for number, name in enumerate(("red", "blue")):
            each, (x, y, yaw) = sample.objects[name], poses[number]
            assert isinstance(each, TrackedObject)
            # the corner of a block is as far off as its centre, and as it has swung
            swing = 0.036 * abs(math.remainder(each.yaw - yaw, 2 * math.pi))
            assert np.hypot(*(place_of(each) - [x, y])) + swing <= each.uncertainty
            stated.append(each.uncertainty)
    # and it says something: millimetres, where a pixel is 1.6 mm
    assert np.median(stated) < 0.004


@pytest.fixture(scope="module", params=[0.0, 0.5], ids=["sharp", "blurred"])
def moving(request: pytest.FixtureRequest) -> list[Frame]:
    """A film of two moving blocks, each frame exposed for a share of its period."""
    instants = request.param * (np.arange(6) / 5 - 0.5) if request.param else [0.0]
    tags = parse_tags(TABLE)
    return [
        Frame(
            PERIOD_NS * index,
            render(
                "36h11",
                [plates(tags, circling(index + instant)) for instant in instants],
                LENS,
                FROM_THE_SIDE,
                seed=(index,),
            ),
        )
        for index in range(30)
    ]


@pytest.mark.parametrize("crf", [28, 36])
def test_moving_tags_are_within_the_stated_uncertainty_in_compressed_and_blurred_films(
    crf: int, moving: list[Frame], tmp_path: Path
) -> None:
    outside = outlines = 0
    observer = TagObserver(parse_tags(TABLE))
    for frame in compressed(moving, crf, tmp_path / "film.mp4"):
        seen = observer.observe(frame)
        for number, pose in circling(seen.sample.time_ns / PERIOD_NS).items():
            tracked = seen.sample.objects.get(("red", "blue")[number])
            if tracked is None:
                continue
            outlines += 1
            outside += farthest_corner(tracked, *pose) > tracked.uncertainty
    # strong compression makes some tags unreadable
    assert outlines >= 45
    assert outside <= 1
    is_remarked = any("blurred or strongly compressed" in remark for remark in observer.remarks())
    assert is_remarked == (crf == 36)


def test_moving_tags_of_a_clean_film_are_at_most_a_fifth_less_certain_than_resting_ones(
    moving: list[Frame],
) -> None:
    def stated(text: str) -> float:
        observed = observe_frames(moving, parse_tags(text))
        return float(
            np.median([each.uncertainty for seen in observed for each in seen.sample.objects.values()])
        )

    assert stated(TABLE) <= 1.2 * stated(TABLE + "corner_error: 0.1\n")


def farthest_corner(tracked: TrackedObject, x: float, y: float, yaw: float) -> float:
    """Return how far a corner of a block of 50 mm is from the nearest of its outline."""
    cosine, sine = math.cos(yaw), math.sin(yaw)
    square = 0.025 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    corners = square @ np.array([[cosine, sine], [-sine, cosine]]) + [x, y]
    (part,) = tracked.footprint.parts
    return float(np.linalg.norm(corners[:, None] - part.vertices, axis=2).min(axis=1).max())


@pytest.mark.parametrize("top", [0.01, 0.04, -0.02])
def test_tags_above_a_plane_that_no_camera_was_calibrated_for_are_as_uncertain_as_their_parallax(
    top: float,
) -> None:
    heights = f"height: [{min(top, 0.0)}, {top}]"
    tags = parse_tags(f"{BLOCKS}\n{REFERENCES}\n".replace("height: [0, 40mm]", heights))
    drawn = np.random.default_rng(11)
    off, stated = [], []
    for seed in range(12):
        # from all sides, and from steep to flat
        around, slant = drawn.uniform(-math.pi, math.pi), drawn.uniform(0.6, 1.5)
        level, table = math.cos(slant), np.array([0.48, 0.0, 0.0])
        eye = table + 1.3 * np.array([level * math.cos(around), level * math.sin(around), math.sin(slant)])
        pose = pose_looking_at(eye, table, np.array([0.0, 0.0, 1.0]))
        places = {0: (*drawn.uniform([0.38, -0.08], [0.56, 0.08]), 0.3)}
        observer = TagObserver(tags)
        sample = observer.observe(Frame(0, picture(plates(tags, places, top), seed=seed, pose=pose))).sample
        red = sample.objects["red"]
        assert isinstance(red, TrackedObject)
        off.append(np.hypot(*(place_of(red) - places[0][:2])))
        stated.append(red.uncertainty)
        (remark,) = [line for line in observer.remarks() if "calibrated" in line]
        side = "above" if top > 0 else "below"
        assert f"tags on objects are up to {1e3 * abs(top):.3g} mm {side} the reference tags" in remark
    assert (np.array(off) <= stated).all()
    # the bound says something, and would not hold without the parallax
    assert (np.array(off) > 0.004).any()
    assert np.median(np.array(stated) / off) < 6


def test_reference_tags_that_are_as_high_as_those_on_objects_leave_no_parallax() -> None:
    scene = plates(parse_tags(FLAT), {0: (0.45, 0.05, 0.0)}, 0.0)
    observer = TagObserver(parse_tags(FLAT))
    assert observer.observe(Frame(0, picture(scene))).sample.objects["red"].uncertainty < 0.004
    assert not any("calibrated" in line for line in observer.remarks())


@pytest.mark.parametrize("text", [TABLE, FLAT], ids=["camera", "homography"])
def test_reference_tags_that_fit_if_all_are_turned_name_the_line_to_write(text: str) -> None:
    tags = parse_tags(text, "tags.yaml")
    turned = [plate(each.id, each.x, each.y, 0.0, math.pi) for each in tags.references]
    with pytest.raises(UsageError, match=r"turned by 180 degrees.*10: \{at: \[0\.3, -0\.17\], yaw: 180deg\}"):
        TagObserver(tags).observe(Frame(0, picture(turned)))


def test_more_noise_and_smaller_tags_are_stated_as_more_uncertainty() -> None:
    def stated(text: str, number: int) -> float:
        frames = [Frame(0, picture(plates(parse_tags(text), {0: (0.4, 0, 0), 1: (0.6, 0, 0)})))]
        (seen,) = observe_frames(frames, parse_tags(text))
        return [each.uncertainty for each in seen.sample.objects.values()][number]

    exact = TABLE + "corner_error: 0.1\n"
    assert stated(exact.replace("0.1\n", "0.4\n"), 0) == pytest.approx(4 * stated(exact, 0), rel=0.01)
    # a pixel is larger further away: the camera is at x = 0.9
    assert stated(exact, 0) > stated(exact, 1)
    assert stated(exact + "sigmas: 2\n", 0) == pytest.approx(stated(exact, 0) / 2)
    loose = exact.replace("0.17]}}", "0.17]}, error: 5mm}")
    assert stated(loose, 0) > 1.5 * stated(exact, 0)


def test_in_the_image_plane_footprints_are_in_pixels_with_y_up() -> None:
    tags = parse_tags("objects:\n  red: {tag: 0, box: [40, 30]}\nplane: image\n")
    (seen,) = observe_frames([Frame(0, picture([plate(0, 0.5, 0.05, 0, 0)]))], tags)
    x, y = true_corners(plate(0, 0.5, 0.05, 0, 0)).mean(axis=0)
    assert place_of(seen.sample.objects["red"]) == pytest.approx([x + 0.5, 360 - 0.5 - y], abs=0.2)


def test_a_lifted_object_is_found_in_space_and_one_that_should_not_be_is_unknown() -> None:
    lifted = TABLE.replace("tag: 0,", "tag: 0, lifted: true,")
    scene = [*plates(parse_tags(TABLE), {}), plate(0, 0.45, -0.05, 0.16, 0.5), plate(1, 0.56, 0.05, 0.1, 0)]
    observer = TagObserver(parse_tags(lifted))
    red = observer.observe(Frame(0, picture(scene))).sample
    each = red.objects["red"]
    assert isinstance(each, TrackedObject)
    # its tag is 4 cm above its bottom
    assert np.hypot(*(place_of(each) - [0.45, -0.05])) < each.uncertainty < 0.03
    assert abs(each.height[0] - 0.12) < each.uncertainty
    assert "blue" not in red.objects
    assert any("blue is unknown in 1 frame: tag 1 appears" in line for line in observer.remarks())


def test_a_second_tag_makes_an_object_more_certain_and_one_is_enough() -> None:
    text = TABLE.replace(
        "red: {tag: 0, class: block, box: [50mm, 50mm]",
        "red: {tags: [{id: 0, at: [-3cm, 0]}, {id: 2, at: [3cm, 0], yaw: 90deg}], box: [120mm, 60mm]",
    )
    tags = parse_tags(text + "corner_error: 0.2\n")
    both = [plate(0, 0.42, 0.0, 0.04, 0.0), plate(2, 0.48, 0.0, 0.04, math.pi / 2)]
    stated = []
    for shown in (both, both[:1], both[1:]):
        (seen,) = observe_frames([Frame(0, picture(plates(tags, {}) + shown))], tags)
        red = seen.sample.objects["red"]
        assert np.hypot(*(place_of(red) - [0.45, 0.0])) <= red.uncertainty
        stated.append(red.uncertainty)
    assert stated[0] < 0.9 * min(stated[1:])


def test_a_hidden_object_is_unknown_and_a_held_one_ever_less_certain() -> None:
    def poses_at(index: int) -> dict[int, tuple[float, float, float]]:
        return {1: (0.6, 0.0, 0.0)} | ({0: (0.4, 0.0, 0.0)} if index < 2 else {})

    tags = parse_tags(TABLE + "fastest: 0.5\n")
    plain = [seen.sample for seen in observe_frames(film(poses_at, 5), tags)]
    assert ["red" in each.objects for each in plain] == [True, True, False, False, False]
    # it is somewhere: open groups keep it as a member that makes them unknown
    assert dict(plain[-1].unknown) == {"red": "block"}
    held = [seen.sample for seen in observe_frames(film(poses_at, 5), tags, hold_ns=2 * PERIOD_NS)]
    assert ["red" in each.objects for each in held] == [True, True, True, True, False]
    stated = [each.objects["red"].uncertainty for each in held[1:4]]
    grown = 0.5 * PERIOD_NS / 1e9
    assert np.diff(stated) == pytest.approx([grown, grown])
    # it may have turned, so that `oriented` is unknown
    assert [each.objects["red"].yaw is None for each in held[:4]] == [False, False, True, True]
    # the tags file may say so as well; who asks for another time gets that
    own = parse_tags(TABLE + "fastest: 0.5\nhold: 40ms\n")
    for hold_ns, frames in ((None, 3), (0, 2), (2 * PERIOD_NS, 4)):
        samples = [seen.sample for seen in observe_frames(film(poses_at, 5), own, hold_ns=hold_ns)]
        assert sum("red" in each.objects for each in samples) == frames


def test_a_plane_that_is_not_known_says_which_reference_tags_lack() -> None:
    square = np.array([[0, 0], [9, 0], [9, 9], [0, 9]], np.float64)
    for numbers, why in (
        ((10, 11, 12), "fewer than 4 reference tags were seen; tag 13 was not"),
        ((10, 11), "fewer than 4 reference tags were seen; tags 12, 13 were not"),
        ((10, 11, 12, 13, 13), "enough reference tags were seen, but fewer than 4 of them once in a frame"),
    ):
        observer = TagObserver(parse_tags(FLAT))
        seen = tuple(Detection(number, square + 20 * place) for place, number in enumerate(numbers))
        observer.observe(Frame(0, np.zeros((0, 0), np.uint8), detections=seen))
        assert any(line.startswith(f"the plane is not known: {why}") for line in observer.remarks())


def test_what_is_strange_about_tags_is_listed_at_the_end() -> None:
    tags = parse_tags(TABLE)
    scene = [*plates(tags, {0: (0.4, 0, 0)}), plate(5, 0.56, 0.1, 0, 0), plate(0, 0.5, -0.1, 0, 0)]
    observer = TagObserver(tags)
    assert "red" not in observer.observe(Frame(0, picture(scene))).sample.objects
    remarks = observer.remarks()
    assert "tags has no tag 5 (in 1 frame)" in remarks
    assert "tag 0 is in 1 frame more than once, and left out there" in remarks
    assert "blue was never seen: no tag 1 in 1 frame" in remarks
    blank = TagObserver(tags)
    blank.observe(Frame(0, picture([])))
    assert "no tag of family 36h11 is in any of 1 frame" in blank.remarks()[0]


@pytest.mark.parametrize("text", [TABLE, FLAT], ids=["camera", "homography"])
def test_a_reference_tag_that_does_not_fit_is_named_with_how_far_it_is_off(text: str) -> None:
    scene = plates(parse_tags(text), {})
    for number, place, wrong_place in ((12, "0.65, 0.17", "0.6, 0.17"), (10, "0.3, -0.17", "0.3, -0.1")):
        wrong = parse_tags(text.replace(f"{number}: [{place}]", f"{number}: [{wrong_place}]"), "tags.yaml")
        said = (
            rf"tags\.yaml: the reference tags do not fit .* tag {number} is off by \d+\.\d pixels from where"
        )
        with pytest.raises(UsageError, match=said):
            TagObserver(wrong).observe(Frame(0, picture(scene)))
    # if all are wrong, none is to blame
    half = parse_tags(text.replace("size: 48mm", "size: 24mm"), "tags.yaml")
    with pytest.raises(UsageError, match=r"tag 1\d is off most, by .* the size of the tags"):
        TagObserver(half).observe(Frame(0, picture(scene)))


@pytest.mark.parametrize("camera", [False, True])
def test_a_plane_that_is_seen_edge_on_is_refused(camera: bool) -> None:
    places = {
        number: (x, y)
        for number, (x, y) in enumerate([(-0.15, -0.3), (0.15, -0.3), (0.15, 0.3), (-0.15, 0.3)], 10)
    }
    text = f"""
size: 20cm
objects: {{red: {{tag: 0, disc: 50mm}}}}
plane: {{tags: {{{", ".join(f"{number}: [{x}, {y}]" for number, (x, y) in places.items())}}}}}
"""
    lens = Camera((1100.0, 1100.0), (639.5, 359.5), (1280, 720))
    tags = parse_tags(
        text + ("camera: {size: [1280, 720], focal: [1100, 1100]}" if camera else ""), "tags.yaml"
    )
    scene = [plate(number, x, y, 0.0, 0.0, size=0.2) for number, (x, y) in places.items()]

    def seen_at(degrees: float) -> TagObserver:
        slant = math.radians(degrees)
        eye = np.array([math.cos(slant), 0.0, math.sin(slant)])
        pose = pose_looking_at(eye, np.zeros(3), np.array([0.0, 0.0, 1.0]))
        observer = TagObserver(tags)
        observer.observe(Frame(0, render("36h11", [scene], lens, pose)))
        return observer

    (fit,) = seen_at(15.0).fits
    assert fit is not None
    assert fit.worst[1] < 0.3
    with pytest.raises(UsageError, match=r"tags\.yaml: the plane is seen edge-on, .* from further above"):
        seen_at(8.5)
    # still flatter, tags are no longer found
    assert "and that the camera looks from above" in seen_at(3.0).remarks()[0]


def test_a_camera_that_moves_is_noticed_and_places_stay_right() -> None:
    tags = parse_tags(TABLE)
    observer = TagObserver(tags)
    shifted = Camera(LENS.focal, (LENS.centre[0] + 12.0, LENS.centre[1]), LENS.size)
    scene = plates(tags, {0: (0.4, 0.02, 0.0)})
    for index, lens in enumerate((LENS, LENS, shifted, shifted)):
        red = observer.observe(Frame(index, picture(scene, lens=lens))).sample.objects["red"]
        # the shifted lens is seen as a camera that has turned
        assert np.hypot(*(place_of(red) - [0.4, 0.02])) < 0.004
    assert "the camera has moved 1 time: places are uncertain while it does" in observer.remarks()


def test_a_calibration_for_another_size_is_refused() -> None:
    with pytest.raises(UsageError, match="calibrated for images of 480 x 360; these have 240 x 180"):
        TagObserver(parse_tags(TABLE)).observe(Frame(0, picture([])[::2, ::2].copy()))


def test_lens_distortion_is_taken_out() -> None:
    bent = Camera(LENS.focal, LENS.centre, LENS.size, (-0.25, 0.08, 0.0, 0.0))
    calibrated = TABLE.replace("[640, 640]", "[640, 640], distortion: [-0.25, 0.08, 0, 0]")
    scene = plates(parse_tags(TABLE), {0: (0.42, -0.1, 0.3), 1: (0.56, 0.1, 0.0)})
    frame = Frame(0, picture(scene, lens=bent))
    (seen,) = observe_frames([frame], parse_tags(calibrated))
    for name, place in (("red", [0.42, -0.1]), ("blue", [0.56, 0.1])):
        each = seen.sample.objects[name]
        assert np.hypot(*(place_of(each) - place)) <= each.uncertainty
    # without being calibrated, its reference tags do not fit as well, and everything is less certain
    informed, blind = TagObserver(parse_tags(calibrated)), TagObserver(parse_tags(TABLE))
    stated = [each.observe(frame).sample.objects["red"].uncertainty for each in (informed, blind)]
    assert blind.fits[0].rms > 3 * informed.fits[0].rms
    assert stated[1] > 2 * stated[0]
