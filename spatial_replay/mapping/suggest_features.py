"""Suggest a mapping for a data set: names of features and numbers of some frames in; YAML with comments out.

Names of features and places identify positions. Numbers identify unit quaternions and their order.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.logs.formats.episodes import AS_STORED, Body, DataSet, Feature, quaternion_order
from spatial_replay.mapping.trial import yaml_text
from spatial_replay.text import listing, plural, printable

_NO_OBJECTS: Final = re.compile(
    r"(.*[./])?(actions?\b.*|rewards?|timestamps?|time|truncat\w*|terminat\w*|is_success|success|done)"
    r"|next\..*|(frame_|episode_|task_|subtask_)?index|observation\.images?\b.*"
)
"""Names of features without objects: actions, rewards, labels, times, row numbers, images."""
_STATES_OF_BODIES: Final = ("states/", "env_states/")
"""Prefixes of features with bodies that the data set names itself."""
_JOINTS: Final = re.compile(
    r"joint|shoulder|elbow|wrist|waist|forearm|upperarm|hip|knee|ankle|finger|thumb|gripper|torso|neck"
    r"|\bhead_(pan|tilt)|qvel|velocity|effort|torque|current",
    re.IGNORECASE,
)
"""Names of numbers that concern a robot's joints instead of a position."""
_NO_POINT: Final = re.compile(
    r"vel|acc|force|torque|twist|delta|linear|angular|rot|rpy|euler|axis|joint|image|_to_", re.IGNORECASE
)
_AXIS: Final = re.compile(
    r"(?P<stem>.*?)(?:(?:^|[_. ])(?:pos|position|xyz)[_. ]?(?P<number>[012])"
    r"|(?:[_. ](?:pos|position)[_. ]|[_. ]|^(?:(?:pos|position)[_. ])?)(?P<axis>[xyz]))",
    re.IGNORECASE,
)
_PART: Final = re.compile(
    r"(?P<stem>.*?)(?:^|[_. ])(?:q|quat|quaternion|rot|ori|orientation)[_. ]?(?P<part>[wxyz0123])",
    re.IGNORECASE,
)
_POINT: Final = re.compile(r"(?P<stem>.*?)_?(?P<what>pos|position|xyz|xpos|goal)", re.IGNORECASE)
_POSE: Final = re.compile(r"(?P<stem>.*?)_?pose", re.IGNORECASE)
HANDS: Final = re.compile(r"eef|\bee\b|tcp|hand|grip|tool|robot|flange", re.IGNORECASE)
"""Names of robot parts, which need not stand upright."""
_LENGTH_ERROR: Final = 0.01
"""Largest error of a quaternion's length."""
_EXACT: Final = 1e-4
"""Largest error of the length of a simulator's quaternion."""
_IN_PLANE: Final = ("[0:2]", "x", "y")
_MOST_SIGNALS: Final = 20
_MOST_EPISODES: Final = 8
"""Limit of episodes whose numbers are read."""


class Suggestion(NamedTuple):
    """An object in a feature.

    Attributes:
        position, orientation: one place per number, or one text for all numbers; () if missing.
        order: order of a quaternion's numbers, "xyzw" or "wxyz"; "" if undecided.
        signals: places of other numbers of the feature.
        remark: note on a decision that the user has to make or check.
    """

    feature: str
    name: str
    position: tuple[str, ...]
    orientation: tuple[str, ...] = ()
    order: str = ""
    signals: tuple[str, ...] = ()
    remark: str = ""

    @property
    def is_in_space(self) -> bool:
        """Whether the position has three numbers."""
        return len(self.position) == 3 or self.position[0] not in _IN_PLANE


def mappable_features(data_set: DataSet) -> list[Feature]:
    """Return the features that may hold objects, sorted by name.

    Names exclude actions, rewards, labels, times and images.
    """
    label = None if data_set.label is None else data_set.label.field
    return sorted(
        feature
        for feature in data_set.features
        if feature.width
        and feature.name != label
        and not _NO_OBJECTS.fullmatch(feature.name)
        and not (data_set.names_bodies and feature.name.startswith(_STATES_OF_BODIES))
    )


def why_poseless(data_set: DataSet) -> str:
    """Return the reason why no mapping can find objects in a data set; "" if a mapping can."""
    features = mappable_features(data_set)
    joint_features = [feature for feature in features if _holds_joints(feature)]
    if data_set.names_bodies or len(joint_features) < len(features):
        return ""
    names = [feature.name for feature in joint_features]
    picture_features = [feature.name for feature in data_set.features if "image" in feature.name]
    content = "; ".join(
        [
            *([f"the joints of the robot ({listing(names)})"] if names else []),
            *([f"pictures ({listing(picture_features)})"] if picture_features else []),
        ]
    )
    return (
        "no poses in this data set; what would be needed: a feature with the positions of objects in each"
        f" frame, from a simulator or a tracker, such as observation.environment_state; it has"
        f" {content or 'no numbers but actions and times'}"
    )


def _holds_joints(feature: Feature) -> bool:
    if feature.places:
        return all(_JOINTS.search(place) for place in feature.places)
    return _JOINTS.search(re.split(r"[./]", feature.name)[-1]) is not None


def suggest_feature_mapping(data_set: DataSet) -> str:
    """Return the text of a mapping file for a data set, with comments.

    Raises:
        UsageError: the data set has no poses, or needs no mapping.
        LogError: the data set cannot be read.
    """
    if reason := why_poseless(data_set):
        raise UsageError(reason)
    features = mappable_features(data_set)
    numbers_by_feature, bodies = _numbers(data_set, features)
    suggestions, body_by_feature = _without_bodies(
        suggest_objects(features, numbers_by_feature), numbers_by_feature, bodies
    )
    if data_set.names_bodies and not suggestions and (data_set.fps or data_set.has_times):
        raise UsageError(f"{data_set.name} needs no mapping: it names its objects")
    name = printable(data_set.name)
    lines = [f"# how features of {name} become objects: a start, by their names", *_head_lines(data_set)]
    if suggestions or not data_set.names_bodies:
        lines += _feature_lines(suggestions)
    used_names = {suggestion.feature for suggestion in suggestions}
    used_names |= {place for suggestion in suggestions for place in suggestion.orientation}
    for feature in features:
        line = f"# not used: {feature.name}: {places_text(feature)}"
        if feature.name in body_by_feature:
            line = f"# {feature.name}: the same as the body {body_by_feature[feature.name]}"
        lines += [f"  {printable(line, 400)}"] if feature.name not in used_names else []
    return "\n".join(lines) + "\n"


def places_text(feature: Feature) -> str:
    """Return the names of a feature's places, or the count of its numbers."""
    return " ".join(feature.places) or f"{plural(feature.width, 'number')} without names"


def suggest_objects(features: Sequence[Feature], columns: Mapping[str, Floats]) -> list[Suggestion]:
    """Return the objects that the names of features and places suggest.

    Args:
        columns: numbers (T, W) of some frames by feature.
    """
    suggestions: dict[str, Suggestion] = {}
    for feature in features:
        frame_numbers = columns.get(feature.name)
        if feature.places:
            objects = _objects_by_places(feature, frame_numbers)
        elif re.split(r"[./]", feature.name)[-1] == "qpos":
            objects = _free_joints(feature, frame_numbers)
        else:
            objects = _whole_feature(feature, features, columns)
        for suggestion in objects:
            # two features, such as an observation and a state, may hold the same object
            suggestions.setdefault(suggestion.name, suggestion)
    return list(suggestions.values())


def _numbers(data_set: DataSet, features: Sequence[Feature]) -> tuple[dict[str, Floats], list[Body]]:
    """Return the numbers of some episodes by feature, and the bodies of the first episode."""
    feature_names = [feature.name for feature in features]
    # any frame rate will do, because only the numbers are read
    reading = AS_STORED._replace(fps=data_set.fps or 1.0)
    value_arrays: dict[str, list[Floats]] = {name: [] for name in feature_names}
    bodies: list[Body] = []
    for episode_index, episode in enumerate(data_set.episodes[:_MOST_EPISODES]):
        try:
            columns = data_set.columns(episode.number, reading, feature_names)
        except UsageError:
            # the data set cannot be read without keys of a mapping, such as `order`
            break
        bodies += columns.bodies if episode_index == 0 else ()
        for name, values in columns.features.items():
            value_arrays[name].append(values.reshape(len(values), -1))
    return {name: np.concatenate(arrays) for name, arrays in value_arrays.items() if arrays}, bodies


def _without_bodies(
    suggestions: Sequence[Suggestion], numbers_by_feature: Mapping[str, Floats], bodies: Sequence[Body]
) -> tuple[list[Suggestion], dict[str, str]]:
    """Return the suggestions that are not bodies of the data set, and the names of bodies by feature."""
    body_by_feature: dict[str, str] = {}
    for suggestion in suggestions:
        for body in bodies:
            positions = numbers_by_feature[suggestion.feature][: len(body.positions), :3]
            if suggestion.position == ("[0:3]",) and np.allclose(positions, body.positions, atol=1e-5):
                body_by_feature[suggestion.feature] = body.name
    return [
        suggestion for suggestion in suggestions if suggestion.feature not in body_by_feature
    ], body_by_feature


# ------------------------------------------------------------------------------------- objects by their names


def _objects_by_places(feature: Feature, frame_numbers: Floats | None) -> Iterator[Suggestion]:
    """Yield objects whose coordinates have names, such as `puck_x`."""
    point_places: dict[str, dict[str, str]] = {}
    quaternion_places: dict[str, dict[str, str]] = {}
    for place in feature.places:
        if part_match := _PART.fullmatch(place):
            quaternion_places.setdefault(part_match["stem"], {})[part_match["part"].lower()] = place
        elif (axis_match := _AXIS.fullmatch(place)) and not _NO_POINT.search(axis_match["stem"]):
            axis_letter = (
                axis_match["axis"].lower() if axis_match["axis"] else "xyz"[int(axis_match["number"])]
            )
            point_places.setdefault(axis_match["stem"], {})[axis_letter] = place
    point_places = {
        stem: place_by_axis
        for stem, place_by_axis in point_places.items()
        if {"x", "y"} <= place_by_axis.keys()
    }
    used_places = {
        place
        for stem in point_places
        for place in (*point_places[stem].values(), *quaternion_places.get(stem, {}).values())
    }
    signals = tuple(place for place in feature.places if place not in used_places)[:_MOST_SIGNALS]
    for stem, place_by_axis in point_places.items():
        position = tuple(place_by_axis[axis] for axis in "xyz" if axis in place_by_axis)
        suggestion = Suggestion(feature.name, stem or _last_word(feature.name), position, signals=signals)
        # only the first object of a feature has its signals
        signals = ()
        place_by_part = quaternion_places.get(stem, {})
        if set("wxyz") <= place_by_part.keys():
            places, order = tuple(place_by_part[part] for part in "xyzw"), "xyzw"
        elif set("0123") <= place_by_part.keys():
            # numbers do not show which part is w
            places, order = tuple(place_by_part[part] for part in "0123"), ""
        else:
            yield suggestion
            continue
        indices = [feature.places.index(place) for place in places]
        yield _with_orientation(
            suggestion, places, None if frame_numbers is None else frame_numbers[:, indices], order
        )


def _whole_feature(
    feature: Feature, features: Sequence[Feature], numbers_by_feature: Mapping[str, Floats]
) -> Iterator[Suggestion]:
    """Yield the object of a feature that is named like a position or a pose, such as `obj_pos`."""
    parent_word, last_word = (["", *re.split(r"[./]", feature.name)])[-2:]
    point_match, pose_match = _POINT.fullmatch(last_word), _POSE.fullmatch(last_word)
    frame_numbers = numbers_by_feature.get(feature.name)
    if feature.width in (2, 3) and point_match is not None and not _NO_POINT.search(last_word):
        name = (
            last_word
            if point_match["what"].lower() == "goal"
            else point_match["stem"] or parent_word or last_word
        )
        suggestion = Suggestion(feature.name, name, (f"[0:{feature.width}]",))
        quaternion_feature = f"{feature.name[: len(feature.name) - len(point_match['what'])]}quat"
        if any((sibling.name, sibling.width) == (quaternion_feature, 4) for sibling in features):
            suggestion = _with_orientation(
                suggestion, (quaternion_feature,), numbers_by_feature.get(quaternion_feature)
            )
        yield suggestion
    elif feature.width == 7 and pose_match is not None:
        name = pose_match["stem"] if pose_match["stem"] not in ("", "root") else parent_word or last_word
        suggestion = Suggestion(feature.name, name, ("[0:3]",))
        yield _with_orientation(
            suggestion, ("[3:7]",), None if frame_numbers is None else frame_numbers[:, 3:7]
        )


def _free_joints(feature: Feature, frame_numbers: Floats | None) -> Iterator[Suggestion]:
    """Yield the bodies with a free joint in a state of MuJoCo.

    A free joint has seven numbers: a position and a unit quaternion (w x y z).
    """
    if frame_numbers is None or not len(frame_numbers):
        return
    width = frame_numbers.shape[1]
    length_errors = [
        float(np.abs(np.linalg.norm(frame_numbers[:, start + 3 : start + 7], axis=1) - 1).max())
        for start in range(width - 6)
    ]
    joint_starts: list[int] = []
    # the most exact quaternions are taken first, because the numbers of two bodies do not overlap
    for start in np.argsort(length_errors, kind="stable").tolist():
        if length_errors[start] < _EXACT and all(
            abs(start - joint_start) >= 7 for joint_start in joint_starts
        ):
            joint_starts.append(start)
    for body_number, start in enumerate(sorted(joint_starts)):
        yield Suggestion(
            feature.name,
            f"body_{body_number}",
            (f"[{start}:{start + 3}]",),
            (f"[{start + 3}:{start + 7}]",),
            "wxyz",
            remark=f"its orientation has length 1 in all {len(frame_numbers):,} frames looked at",
        )


def _with_orientation(
    suggestion: Suggestion, places: tuple[str, ...], quaternions: Floats | None, order: str = ""
) -> Suggestion:
    """Return a suggestion with an orientation, or with a remark why the orientation is missing."""
    text = places[0] if len(places) == 1 else f"[{', '.join(places)}]"
    undecided = f"orientation: {text} needs `order: wxyz` or `order: xyzw`; the numbers do not show which"
    if quaternions is None:
        return suggestion._replace(remark=undecided)
    quaternions = quaternions[np.isfinite(quaternions).all(axis=1)]
    lengths = np.linalg.norm(quaternions, axis=1)
    if len(lengths) and np.abs(lengths - 1).max() > _LENGTH_ERROR:
        return suggestion._replace(
            remark=f"{text} has lengths from {lengths.min():.3g} to {lengths.max():.3g}, so it is no"
            " orientation"
        )
    if order:
        return suggestion._replace(orientation=places, order=order)
    upright_order = None if HANDS.search(suggestion.name) else quaternion_order([quaternions])
    if upright_order is None:
        return suggestion._replace(remark=undecided)
    return suggestion._replace(
        orientation=places,
        order=upright_order,
        remark="in this order it stands upright in some frames; check it",
    )


# ------------------------------------------------------------------------------------------ the text


def _head_lines(data_set: DataSet) -> Iterator[str]:
    if data_set.names_bodies:
        yield "# its bodies are objects by themselves; shapes: {NAME: {disc: 0.02}} gives one a footprint"
    if data_set.fps is None and not data_set.has_times:
        yield "# frames a second: the data set does not say; put the number here"
        yield "fps:"
    yield "# without a shape an object is a point: add shape: {disc: 0.02}, with a radius in metres"


def _feature_lines(suggestions: Sequence[Suggestion]) -> Iterator[str]:
    yield "features:"
    if not suggestions:
        yield "  # no name looks like a position; name the places of an object, such as"
        yield '  # observation.state: {name: cup, position: "[0:3]"}'
    for feature in dict.fromkeys(suggestion.feature for suggestion in suggestions):
        yield f"  {yaml_text(feature)}:"
        for suggestion in suggestions:
            if suggestion.feature == feature:
                yield from _entry_lines(suggestion)


def _entry_lines(suggestion: Suggestion) -> Iterator[str]:
    entry_fields = [f"name: {yaml_text(suggestion.name)}", f"position: {_places(suggestion.position)}"]
    if suggestion.orientation:
        entry_fields += [f"orientation: {_places(suggestion.orientation)}", f"order: {suggestion.order}"]
    if suggestion.is_in_space:
        entry_fields.append("height: [0, 0]")
    if suggestion.signals:
        signal_text = ", ".join(
            f"{yaml_text(_signal_name(place))}: {yaml_text(place)}" for place in suggestion.signals
        )
        entry_fields.append(f"signals: {{{signal_text}}}")
    if suggestion.remark:
        yield f"    # {printable(suggestion.name)}: {printable(suggestion.remark, 300)}"
    yield f"    - {{{', '.join(entry_fields)}}}"


def _places(places: tuple[str, ...]) -> str:
    texts = [yaml_text(place) for place in places]
    return texts[0] if len(texts) == 1 else f"[{', '.join(texts)}]"


def _signal_name(place: str) -> str:
    return re.sub(r"\W+", "_", place, flags=re.ASCII).strip("_") or "signal"


def _last_word(name: str) -> str:
    return re.split(r"[./]", name)[-1]
