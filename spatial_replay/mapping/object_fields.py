"""Fields of objects in messages of unknown types: decoded messages in, paths of likely fields out.

Fields are found by their names and the types of their values.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import hypot, inf

from spatial_replay.mapping.field_paths import (
    INDEX,
    FieldError,
    FieldPath,
    Sparse,
    field_names,
    get_field,
    is_list,
    is_number,
    iter_elements,
    keys_of,
    sparse,
    walk,
)
from spatial_replay.mapping.message_types import geodetic_order

_DEEPEST = 4
"""Nesting limit of the search for fields."""
_POSITIONS = ("position", "center", "centre", "translation", "location", "point")
_TURNS = ("orientation", "rotation", "quaternion", "q", "quat")
_YAWS = ("yaw", "theta", "heading", "angle", "course", "cog")
_SIZES = ("dimension", "dimensions", "size", "scale", "extent", "shape", "bbox")
_OUTLINES = ("corners", "polygon", "points", "vertices", "outline", "footprint", "contour")
_BOUNDS = ("xyxy", "bounds", "bbox_xyxy", "box_xyxy", "xywh", "bbox_xywh", "bbox", "box", "bounding_box")
_FOUR_BOUNDS = (
    ("xmin", "ymin", "xmax", "ymax"),
    ("x_min", "y_min", "x_max", "y_max"),
    ("min_x", "min_y", "max_x", "max_y"),
    ("left", "top", "right", "bottom"),
    ("x1", "y1", "x2", "y2"),
    ("x_offset", "y_offset", "width", "height"),
)
"""Names of a box's four numbers. The last row is a corner and a size (sensor_msgs/RegionOfInterest)."""
_NAMES = ("name", "id", "track_id", "object_id", "tracking_id", "child_frame_id", "uuid", "mmsi", "label")
_NAMES_BESIDE = ("name", "names", "id", "ids", "object_names", "object_ids", "tracking_ids", "track_ids")
"""Names of lists whose elements are the names of objects in another list."""
_NO_IDENTITIES = frozenset({"frame", "class", "type", "category", "parent", "sensor", "status", "seq"})
"""Words in names of ids that several objects share, such as `class_id` and `frame_id`."""
_CLASSES = ("class", "class_name", "classification", "category", "label", "object_type", "type")
_GEOMETRIES = ("Polygon", "MultiPolygon", "Feature")
"""GeoJSON types with an outline. A field `type` with such a value is not a class."""
_PLANES = ("level_name", "level", "floor", "floor_name", "storey", "map_name", "map_id", "map")
"""Names of fields with an object's floor or map."""
_PARTS = frozenset(
    {
        *(*_POSITIONS, *_TURNS, *_YAWS, *_SIZES, *_OUTLINES, *_NAMES, *_CLASSES),
        *("pose", "min", "max", "start", "end", "from", "to", "goal", "offset", "base"),
    }
)
"""Keys of parts of one object. Other keys of a JSON object may be names of objects."""
_LISTS = re.compile("object|detection|track|tag|agent|obstacle|pose|vehicle|pedestrian|marker")
_PLANS = frozenset(
    {
        *("path", "paths", "plan", "plans", "trajectory", "trajectories", "route", "routes"),
        *("waypoint", "waypoints", "node", "nodes", "edge", "edges", "viapoints"),
    }
)
"""Words in the names of lists of planned places, which are not objects."""
_NOT_PLACES = frozenset(
    {
        *("velocity", "velocities", "vel", "speed", "acceleration", "accel", "twist", "linear", "angular"),
        *("force", "torque", "wrench", "covariance", "header", "stamp", "timestamp", "origin"),
        *("mount", "mounting", "sensor", "camera", "extrinsic", "extrinsics", "calibration"),
    }
)
"""Words in names of fields whose points are not positions of objects, such as mounts of sensors."""
_ELSEWHERE = frozenset(
    {"goal", "target", "desired", "reference", "home", "last", "next", "previous", "initial"}
)
"""Words in the names of planned or earlier positions."""
_VECTORS = re.compile(r"twist|vector3|accel|wrench|imu|cmd_vel|velocity", re.IGNORECASE)
"""Topics and types whose x and y are not a position."""
_TIMES = frozenset({"time", "stamp", "timestamp", "sec", "secs", "nsec", "nsecs", "nanosec", "nanos", "seq"})
"""Words in the names of times and counters, which are not signals."""
_UUID_BYTES = 16
_FIELD = re.compile(r"[A-Za-z_][\w-]*", re.ASCII)
_KEY = re.compile(r"[^\[\]{}|=\s]{1,100}", re.ASCII)


@dataclass(frozen=True, slots=True)
class Guess:
    """Likely fields of an object in a message; texts are field paths.

    Attributes:
        objects: path of the list of objects; None for a single object.
        position: path of a point, or paths of x and y.
        orientation: path of a quaternion.
        has_order: whether the orientation is a list, which needs an `order`.
        yaw: path of an angle.
        polygon: path of an outline.
        is_own: whether the corners of the outline are relative to the object's pose.
        bounds: path of a list with a box's two opposite corners, or paths of its four numbers.
        bounds_have_size: whether the last two numbers of the bounds are width and height.
        size: paths of length, width and maybe height, or path of a radius.
        names: paths of possible names or ids, the likeliest first; `index` for keys of a JSON object.
        class_name: path of a class.
        is_in_pixels: whether coordinates look like pixels.
        is_sizeless: whether all objects have size 0.
        other_outline: path of the outline of objects with size 0, if other objects have a size.
        plane: path of the name of an object's floor or map, if objects have different names.
        has_zeros_left_out: whether some objects lack coordinates that other objects have.
        others: guesses for further lists of objects.
        is_plan: whether the positions are planned positions.
    """

    objects: str | None = None
    position: str | tuple[str, ...] | None = None
    orientation: str | None = None
    has_order: bool = False
    yaw: str | None = None
    polygon: str | None = None
    is_own: bool = False
    bounds: str | tuple[str, ...] | None = None
    bounds_have_size: bool = False
    size: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    class_name: str | None = None
    is_in_pixels: bool = False
    is_sizeless: bool = False
    other_outline: str | None = None
    plane: str | None = None
    has_zeros_left_out: bool = False
    others: tuple[Guess, ...] = ()
    is_plan: bool = False

    @property
    def is_body(self) -> bool:
        """Whether the object has a name, and an extent or an orientation. Plans are excluded.

        A further list of objects is used only if this is True.
        """
        has_extent = bool(self.size or self.polygon or self.bounds or self.orientation or self.yaw)
        return bool(self.names) and has_extent and not self.is_plan

    @property
    def has_compass(self) -> bool:
        """Whether the yaw is an angle from north: a heading next to latitude and longitude."""
        is_geodetic = isinstance(self.position, tuple) and geodetic_order(self.position) is not None
        return is_geodetic and self.yaw is not None and _words(self.yaw)[-1] in ("heading", "course", "cog")

    @property
    def score(self) -> int:
        """Number of known properties of the object, such as size and name, plus ten if its place is known."""
        part_fields = (
            self.polygon or self.bounds,
            self.size,
            self.names,
            self.orientation or self.yaw,
            self.class_name,
        )
        has_place = any(place is not None for place in (self.polygon, self.bounds, self.position))
        return 10 * has_place + sum(map(bool, part_fields))


def guess_objects(topic: str, kind: str, messages: Sequence[object]) -> Guess | None:
    """Find an object, or a list of objects, in a topic's messages; None without an object.

    Args:
        kind: type of the messages.
    """
    if _VECTORS.search(kind) or _VECTORS.search(topic.rsplit("/", 1)[-1]):
        return None
    best_guess = _best(messages)
    if best_guess is not None and best_guess.objects is not None and not best_guess.names:
        # a list of positions without ids is a plan if the topic or type has such a name, as nav_msgs/Path has
        words_by_name = (_words(re.split(r"[/.]", name)[-1]) for name in (topic, kind))
        best_guess = replace(
            best_guess, is_plan=best_guess.is_plan or any(map(_PLANS.intersection, words_by_name))
        )
    if any(isinstance(message, dict) for message in messages):
        with suppress(FieldError):
            sparse_guess = _best([sparse(message) for message in messages])
            if (
                sparse_guess is not None
                and isinstance(sparse_guess.position, str)
                and _lacks_coordinates(sparse_guess, messages)
            ):
                return replace(sparse_guess, has_zeros_left_out=True)
    return best_guess


def _lacks_coordinates(guess: Guess, messages: Sequence[object]) -> bool:
    """Return whether all objects have a position, and some positions lack x or y."""
    coordinate_counts = set()
    for message in messages:
        try:
            positions = [
                walk(FieldPath.of(str(guess.position)), element) for element in _objects_in(guess, message)
            ]
        except FieldError:
            return False
        if not all(isinstance(position, dict) for position in positions):
            return False
        coordinate_counts |= {
            len({"x", "y"} & position.keys()) for position in positions if isinstance(position, dict)
        }
    return bool(coordinate_counts - {2})


def _best(messages: Sequence[object]) -> Guess | None:
    guesses = [guess for message in messages if (guess := _guess(message)) is not None]
    if not guesses:
        return None
    # near the origin an outline may be in either frame; a message with `is_own` decides
    best_guess = _with_evidence(max(guesses, key=lambda guess: (guess.score, guess.is_own)), messages)
    if best_guess.objects is None:
        return best_guess
    guess_by_path = {
        candidate.objects: candidate for guess in guesses for candidate in (guess, *guess.others)
    }
    further_guesses = (
        guess for path, guess in guess_by_path.items() if path not in (None, best_guess.objects)
    )
    return replace(best_guess, others=tuple(_with_evidence(guess, messages) for guess in further_guesses))


def _with_evidence(guess: Guess, messages: Sequence[object]) -> Guess:
    """Correct a guess by the values of the guessed fields in all messages."""
    if guess.names == (INDEX,):
        return guess
    if isinstance(guess.position, tuple) and geodetic_order(guess.position):
        # the frame of a fix identifies its receiver
        guess = replace(guess, names=(*guess.names, "frame_id"))
    distinguishing_names = tuple(name for name in guess.names if _distinguishes(name, guess, messages))
    with suppress(FieldError):
        guess = replace(guess, bounds_have_size=_have_size(guess, messages))
    if guess.size and not any(_values_at(guess.size[:2], guess, messages)):
        guess = replace(guess, size=(), is_sizeless=True)
    elif guess.size:
        guess = replace(guess, other_outline=_outline_of_sizeless(guess, messages))
    if guess.plane is not None:
        plane_names = {
            value for value in _values_at((guess.plane,), guess, messages) if isinstance(value, str)
        }
        guess = replace(guess, plane=guess.plane if len(plane_names) > 1 else None)
    return replace(guess, names=distinguishing_names or tuple(_names_beside(guess, messages)))


def _names_beside(guess: Guess, messages: Sequence[object]) -> Iterator[str]:
    """Yield the paths of neighbouring lists that hold a name for each object."""
    if guess.objects is None or guess.objects.count("[*]") > 1:
        return
    path_prefix = guess.objects.rpartition(".")[0]
    for name in _NAMES_BESIDE:
        path = FieldPath.of(f"{path_prefix}.{name}" if path_prefix else name)
        objects = FieldPath.of(guess.objects)
        try:
            names_and_counts = [
                (walk(path, message), sum(1 for _ in iter_elements(objects, message))) for message in messages
            ]
        except FieldError:
            continue
        name_lists = [list(map(str, names)) for names, _ in names_and_counts if is_list(names)]
        object_counts = [object_count for _, object_count in names_and_counts]
        if [len(names) for names in name_lists] == [len(set(names)) for names in name_lists] == object_counts:
            yield f"$.{path.text}[{INDEX}]"


def signals_in(message: object) -> tuple[str, ...]:
    """Return the paths of numbers and truth values in a message, without times and the header.

    A list of numbers is used only if a neighbouring list `name` names the numbers: `position[name=elbow]`. A
    text is a signal only if it is the field `data`, as in `std_msgs/String`.
    """
    paths: list[str] = []
    for path, value in _iter_fields(message, is_skipped=_is_time):
        if isinstance(value, int | float) or (isinstance(value, str) and path == "data"):
            paths.append(path)
        elif is_list(value) and len(value) and isinstance(value[0], int | float):
            prefix, _, last_name = path.rpartition(".")
            name_lists = [
                names
                for name, names in _iter_fields(message, is_skipped=_is_time)
                if name == (f"{prefix}.name" if prefix else "name") and is_list(names)
            ]
            if name_lists and len(name_lists[0]) == len(value):
                usable_keys = [key for key in name_lists[0] if isinstance(key, str) and _KEY.fullmatch(key)]
                paths += [f"{prefix + '.' if prefix else ''}{last_name}[name={key}]" for key in usable_keys]
    return tuple(paths)


def frame_of(message: object) -> str | None:
    """Return the frame of a message's coordinates; None without a frame."""
    for path, value in _iter_fields(message, is_skipped=lambda name: False):
        if path.split(".")[-1] == "frame_id" and isinstance(value, str) and value:
            return value.removeprefix("/")
    return None


def _guess(message: object) -> Guess | None:
    whole_message = _object_in(message)
    list_guesses = sorted(
        ((guess, path) for path, guess in _iter_lists(message)),
        key=lambda guess_and_path: (
            guess_and_path[0].is_plan,
            -_list_rank(guess_and_path[1]),
            -guess_and_path[0].score,
        ),
    )
    if list_guesses and (
        whole_message is None or (whole_message.polygon is None and not list_guesses[0][0].is_plan)
    ):
        best_guess, path = list_guesses[0]
        other_guesses = tuple(replace(guess, objects=path) for guess, path in list_guesses[1:])
        return replace(best_guess, objects=path, others=other_guesses)
    return whole_message


def _distinguishes(name: str, guess: Guess, messages: Sequence[object]) -> bool:
    """Return whether a field distinguishes the objects of each message, or the senders of single objects."""
    try:
        texts_by_message = [
            [str(walk(FieldPath.of(name), element)) for element in _objects_in(guess, message)]
            for message in messages
        ]
    except FieldError:
        return False
    if guess.objects is None:
        return takes_turns([text for (text,) in texts_by_message])
    return all(len(set(message_texts)) == len(message_texts) for message_texts in texts_by_message)


def _outline_of_sizeless(guess: Guess, messages: Sequence[object]) -> str | None:
    """Return the path of the corners of objects with size 0; None without such objects."""
    with suppress(FieldError):
        for element in (element for message in messages for element in _objects_in(guess, message)):
            if not any(walk(FieldPath.of(path), element) for path in guess.size[:2]):
                return _outline_in(dict(_iter_fields(element)))[0]
    return None


def _values_at(paths: Sequence[str], guess: Guess, messages: Sequence[object]) -> Iterator[object]:
    """Iterate over the values at some paths in all objects; skip paths that do not resolve."""
    for message in messages:
        for path in paths:
            with suppress(FieldError):
                yield from [walk(FieldPath.of(path), element) for element in _objects_in(guess, message)]


def share_places(first: Guess, second: Guess, messages: Sequence[object]) -> bool:
    """Return whether most objects of the second list have the position of an object of the first list.

    Such lists, for example detections and tracks, have the same objects.
    """
    shared_count = object_count = 0
    with suppress(FieldError, TypeError):
        for message in messages:
            first_places = [_place_of(first, element) for element in _objects_in(first, message)]
            for element in _objects_in(second, message):
                second_place = _place_of(second, element)
                object_count += 1
                shared_count += any(
                    hypot(x - second_place[0], y - second_place[1]) < _SAME_PLACE for x, y, *_ in first_places
                )
    return 2 * shared_count > object_count


_SAME_PLACE = 0.2
"""Distance below which objects of two lists are one object, units of the log."""


def _place_of(guess: Guess, element: object) -> tuple[float, ...]:
    """Return the position of an object, or the first corner of its outline or bounds."""
    if isinstance(guess.position, tuple):
        return tuple(float(walk(FieldPath.of(path), element)) for path in guess.position)  # type: ignore[arg-type]
    if guess.position is not None:
        return _point(walk(FieldPath.of(guess.position), element)) or (inf, inf)
    if guess.bounds is not None:
        return _box_at(guess.bounds, element) or (inf, inf)
    return next(_corners_in(walk(FieldPath.of(str(guess.polygon)), element)), (inf, inf))


def _objects_in(guess: Guess, message: object) -> Iterator[object]:
    """Iterate over the objects in a message.

    Raises:
        FieldError: the message lacks the list.
    """
    return iter([message]) if guess.objects is None else iter_elements(FieldPath.of(guess.objects), message)


def takes_turns(texts: Sequence[str]) -> bool:
    """Return whether a text occurs again after a different text, as names of several senders do.

    The texts of a counter do not occur again.
    """
    run_starts = [
        text for text, previous_text in zip(texts, (None, *texts), strict=False) if text != previous_text
    ]
    return len(set(run_starts)) < len(run_starts)


def _iter_lists(message: object) -> Iterator[tuple[str, Guess]]:
    for path, value in (("", message), *_iter_fields(message)):
        table_objects = _table_of_objects(value)
        if table_objects and (guess := _object_in(table_objects[0])) is not None:
            yield f"{path}[*]", replace(guess, names=(INDEX,))
        elif is_list(value) and len(value) and field_names(value[0]):
            guess = _object_in(value[0])
            last_name = path.split(".")[-1]
            # corners of an outline are points, but not objects
            if guess is not None and not (last_name in _OUTLINES and guess.score <= 10):
                yield f"{path}[*]", replace(guess, is_plan=not _PLANS.isdisjoint(_words(last_name)))


def _table_of_objects(value: object) -> list[object]:
    """Return the objects of a protobuf map, or of a JSON object whose keys are names; [] for other values.

    A JSON object counts as a map if it has at least two objects, all with the same fields.
    """
    if not isinstance(value, Mapping):
        return []
    object_keys = keys_of(value)
    objects = [value[key] for key in object_keys]
    if not isinstance(value, dict):
        return objects
    field_sets = {frozenset(field_names(element)) for element in objects}
    is_table = len(objects) > 1 and len(field_sets) == 1 and _PARTS.isdisjoint(object_keys)
    return objects if is_table and not any(map(_is_no_place, object_keys)) else []


def _object_in(message: object) -> Guess | None:
    """Find the fields of one object in a message, or in an element of a list; None without a position."""
    field_values = dict(_iter_fields(message))
    position, orientation = _pose_in(field_values)
    polygon, corners = _outline_in(field_values)
    bounds = _bounds_in(field_values)
    is_in_object_frame = False
    if polygon is not None and orientation is not None and isinstance(position, str):
        origin = _point(field_values[position]) or (0.0, 0.0)
        is_in_object_frame = not _is_around(corners, origin) and _is_around(corners, (0.0, 0.0))
        if not is_in_object_frame and not _is_around(corners, origin):
            # the outline does not belong to the pose, such as pixels next to a pose in metres
            polygon, corners = None, []
    if polygon is not None or position is not None:
        bounds = None
    if polygon is None and position is None and bounds is None:
        return None
    is_posed = polygon is None or is_in_object_frame
    if bounds is not None:
        corners = [_box_at(bounds, message)]
    elif polygon is None and isinstance(position, str) and _IMAGES.search(position):
        corners = [_point(field_values[position]) or ()]
    return Guess(
        position=position if is_posed else None,
        orientation=orientation if is_posed else None,
        has_order=is_posed and orientation is not None and is_list(field_values[orientation]),
        yaw=_first(field_values, _YAWS, _is_number) if is_posed and not orientation else None,
        polygon=polygon,
        is_own=is_in_object_frame,
        bounds=bounds,
        size=_size_in(field_values) if polygon is None else (),
        names=_names_in(field_values),
        class_name=_first(
            field_values, _CLASSES, lambda message: isinstance(message, str) and message not in _GEOMETRIES
        ),
        plane=_first(field_values, _PLANES, lambda message: isinstance(message, str) and message != ""),
        is_in_pixels=not is_in_object_frame and _are_pixels(corners),
    )


def _outline_in(fields: dict[str, object]) -> tuple[str | None, list[tuple[float, ...]]]:
    """Return the path of an outline and its corners; (None, []) without an outline."""
    for path in _paths_by_name(fields, _OUTLINES):
        field_value = fields[path]
        if not is_list(field_value) and "points" in field_names(field_value):
            path, field_value = f"{path}.points", get_field(field_value, "points")
        if is_list(field_value) and len(field_value) >= 3 and _has(field_value[0], "xy"):
            return path, [point for corner in field_value if (point := _point(corner)) is not None]
    for path in _paths_by_name(fields, ("geometry",)):
        # a geometry of GeoJSON
        geometry_fields = field_names(fields[path])
        if "coordinates" in geometry_fields and get_field(fields[path], "type") in _GEOMETRIES:
            return path, list(_corners_in(get_field(fields[path], "coordinates")))
    return None, []


def _corners_in(rings: object) -> Iterator[tuple[float, ...]]:
    if (point := _point(rings)) is not None:
        yield point
    elif is_list(rings):
        for ring in rings:
            yield from _corners_in(ring)


def _bounds_in(fields: dict[str, object]) -> str | tuple[str, ...] | None:
    """Return the path of the bounds of a box, or the paths of their four numbers; None without bounds."""
    for path in _paths_by_name(fields, _BOUNDS):
        if _numbers(fields[path], 4):
            return path
    # the order is reversed, so that the first of several fields with one name is used
    path_by_name = {
        "_".join(_words(path.split(".")[-1])): path for path in reversed(fields) if _is_number(fields[path])
    }
    for names in _FOUR_BOUNDS:
        if all(name in path_by_name for name in names):
            left, bottom, right, top = (float(fields[path_by_name[name]]) for name in names)  # type: ignore[arg-type]
            # numbers in another order are the ends of a line, not corners of a box
            return tuple(path_by_name[name] for name in names) if left <= right and bottom <= top else None
    return None


def _box_at(bounds: str | tuple[str, ...], element: object) -> tuple[float, ...]:
    """Return the four numbers of an object's bounds; () if the value is not a list of four numbers.

    Raises:
        FieldError: a path does not resolve.
    """
    bound_numbers = [
        walk(FieldPath.of(path), element) for path in (bounds if isinstance(bounds, tuple) else [bounds])
    ]
    return tuple(_numbers(bound_numbers if len(bound_numbers) == 4 else bound_numbers[0], 4))


def _have_size(guess: Guess, messages: Sequence[object]) -> bool:
    """Return whether bounds have width and height instead of a second corner.

    Field names such as `height`, `xywh` and `xyxy` decide. Without such a name, bounds have a size if the
    second corner of any box would be left of or below the first corner.
    """
    bounds = guess.bounds
    if bounds is None or isinstance(bounds, tuple):
        return bounds is not None and _words(bounds[-1].split(".")[-1])[-1] == "height"
    last_name = bounds.split(".")[-1]
    if "xywh" in last_name:
        return True
    boxes = [_box_at(bounds, element) for message in messages for element in _objects_in(guess, message)]
    return "xyxy" not in last_name and any(
        right < left or top < bottom for left, bottom, right, top in filter(None, boxes)
    )


def _pose_in(fields: dict[str, object]) -> tuple[str | tuple[str, ...] | None, str | None]:
    """Return the paths of a position and an orientation, preferably in the same pose."""
    orientation_paths = [
        path
        for path in _paths_by_name(fields, _TURNS)
        if _has(fields[path], "xyzw") or _numbers(fields[path], 4)
    ]
    position_paths = [
        path
        # first names such as `position`, then names such as `agvPosition`
        for path in (*_paths_by_name(fields, _POSITIONS), *_paths_by_last_word(fields, _POSITIONS))
        # positions next to a list of names are positions of joints, as in sensor_msgs/JointState
        if _point(fields[path]) is not None
        and not (is_list(fields[path]) and is_list(fields.get(f"{path.rpartition('.')[0]}.name".lstrip("."))))
    ]
    for position_path in position_paths:
        for orientation_path in orientation_paths:
            if position_path.rpartition(".")[0] == orientation_path.rpartition(".")[0]:
                return position_path, orientation_path
    position: str | tuple[str, ...] | None = position_paths[0] if position_paths else None
    if position is None and all(_is_number(fields.get(name)) for name in "xy"):
        # x and y next to w belong to a quaternion
        position = None if _is_number(fields.get("w")) else ("x", "y")
    if position is None:
        position = geodetic_order(tuple(path for path, value in fields.items() if _is_number(value)))
    return position, orientation_paths[0] if orientation_paths else None


def _point(value: object) -> tuple[float, ...] | None:
    """Return the coordinates of a point: a message with x and y, or a list of two or three numbers."""
    if _has(value, "xy"):
        names = "xy" if isinstance(value, Sparse) else field_names(value)
        return tuple(float(get_field(value, name)) for name in "xyz" if name in names)  # type: ignore[arg-type]
    return tuple(_numbers(value, 2) or _numbers(value, 3)) or None


def _numbers(value: object, count: int) -> list[float]:
    """Return the elements of a list of `count` numbers; [] for other values."""
    if not is_list(value) or len(value) != count:
        return []
    numbers = [float(number) for number in value if is_number(number) and number is not None]  # type: ignore[arg-type]
    return numbers if len(numbers) == count else []


def _is_around(corners: Sequence[tuple[float, ...]], point: tuple[float, ...]) -> bool:
    """Return whether a point is in the box around an outline, enlarged by the outline's size."""
    lower_corner, upper_corner = (
        tuple(extremum(corner[axis] for corner in corners) for axis in (0, 1)) for extremum in (min, max)
    )
    half_perimeter = sum(upper_corner) - sum(lower_corner)
    return all(
        lower_corner[axis] - half_perimeter <= point[axis] <= upper_corner[axis] + half_perimeter
        for axis in (0, 1)
    )


_PIXELS = 50
"""Lower limit of the greatest coordinate of points in pixels."""
_IMAGES = re.compile("pixel|image|bbox|keypoint", re.IGNORECASE)


def _are_pixels(points: Sequence[tuple[float, ...]]) -> bool:
    """Return whether points, or boxes of four numbers, look like pixels: large, not negative, no z."""
    flat = [number for point in points for number in (point if len(point) > 3 else point[:2])]
    is_flat = not any(point[2] for point in points if len(point) == 3)
    return bool(flat) and is_flat and min(flat) >= 0 and max(flat) >= _PIXELS


def _size_in(fields: dict[str, object]) -> tuple[str, ...]:
    for path in _paths_by_name(fields, _SIZES):
        for size_names in (("length", "width", "height"), ("x", "y", "z"), ("size_x", "size_y", "size_z")):
            inner_names = field_names(fields[path])
            if all(
                name in inner_names and _is_number(get_field(fields[path], name)) for name in size_names[:2]
            ):
                return tuple(f"{path}.{name}" for name in size_names if name in inner_names)
        numbers = () if path.endswith("bbox") else _numbers(fields[path], 3) or _numbers(fields[path], 2)
        if numbers:
            return tuple(f"{path}[{index}]" for index in range(len(numbers)))
    for size_names in (("length", "width", "height"), ("size_x", "size_y", "size_z")):
        if all(_is_number(fields.get(name)) for name in size_names[:2]):
            return tuple(name for name in size_names if name in fields)
    return ("radius",) if _is_number(fields.get("radius")) else ()


def _names_in(fields: dict[str, object]) -> tuple[str, ...]:
    """Return the paths of fields that may distinguish objects: `name`, `id`, then e.g. `fiducial_id`."""
    other_paths = [
        path
        for path in fields
        if (words := _words(path.split(".")[-1]))[-1] in ("id", "uuid") and not _NO_IDENTITIES & {*words}
    ]
    name_paths: list[str] = []
    for path in dict.fromkeys(
        [*_paths_by_name(fields, _NAMES), *sorted(other_paths, key=lambda path: path.count("."))]
    ):
        field_value = fields[path]
        if isinstance(field_value, str | int) and not isinstance(field_value, bool) and field_value != "":
            name_paths.append(path)
        elif isinstance(field_value, bytes) or (
            is_list(field_value) and len(field_value) in (1, _UUID_BYTES)
        ):
            # a list with one id, or with the bytes of a UUID
            name_paths.append(path)
        elif inner_name := next(
            (name for name in ("value", "uuid") if name in field_names(field_value)), None
        ):
            name_paths.append(f"{path}.{inner_name}")
    return tuple(dict.fromkeys(name_paths))


def _words(name: str) -> list[str]:
    """Return the words in the name of a field: `trackId` and `track_id` → track, id."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower().split("_")


def _paths_by_name(fields: dict[str, object], names: tuple[str, ...]) -> list[str]:
    """Return the paths whose last name is in `names`, by depth, then in the order of `names`."""
    last_names = {path: "_".join(_words(path.split(".")[-1])) for path in fields}
    matching_paths = [path for path in fields if last_names[path] in names]
    return sorted(matching_paths, key=lambda path: (path.count("."), names.index(last_names[path])))


def _paths_by_last_word(fields: dict[str, object], names: tuple[str, ...]) -> list[str]:
    """Return the paths whose last name has several words and ends with a word of `names`, by depth.

    Names of planned or earlier positions are excluded.
    """
    words_of = {path: _words(path.split(".")[-1]) for path in fields}
    matching_paths = [
        path
        for path, words in words_of.items()
        if len(words) > 1 and words[-1] in names and _ELSEWHERE.isdisjoint(words)
    ]
    return sorted(matching_paths, key=lambda path: path.count("."))


def _first(fields: dict[str, object], names: tuple[str, ...], fits: Callable[[object], bool]) -> str | None:
    return next((path for path in _paths_by_name(fields, names) if fits(fields[path])), None)


def _is_no_place(name: str) -> bool:
    return not _NOT_PLACES.isdisjoint(_words(name.removesuffix("_with_covariance")))


def _is_time(name: str) -> bool:
    return name == "header" or not _TIMES.isdisjoint(_words(name))


def _iter_fields(
    message_part: object, path: str = "", depth: int = 0, *, is_skipped: Callable[[str], bool] = _is_no_place
) -> Iterator[tuple[str, object]]:
    """Iterate over the (path, value) of fields in a message and its parts, without elements of lists."""
    for name in field_names(message_part) if depth < _DEEPEST else ():
        if not is_skipped(name) and _FIELD.fullmatch(name):
            inner_value = get_field(message_part, name)
            full_path = f"{path}.{name}" if path else name
            yield full_path, inner_value
            yield from _iter_fields(inner_value, full_path, depth + 1, is_skipped=is_skipped)


def _list_rank(path: str) -> int:
    """Return a rank of a list by its name; lists of moving objects have the highest rank."""
    last_name = path.removesuffix("[*]").split(".")[-1].lower()
    return 2 * ("moving" in last_name or "dynamic" in last_name) + bool(_LISTS.search(last_name))


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _has(message: object, names: str) -> bool:
    """Return whether a message has numbers in all fields with the given one-letter names."""
    fields = field_names(message)
    if isinstance(message, Sparse):
        allowed_names = "xyz" if names == "xy" else names
        return all(name in allowed_names and _is_number(message[name]) for name in fields)
    return all(name in fields and _is_number(get_field(message, name)) for name in names)
