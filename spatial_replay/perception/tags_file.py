"""Tags files: tags on objects, the plane, and the camera."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from os import PathLike
from types import MappingProxyType
from typing import Any, Final, Literal, cast

import numpy as np

from spatial_replay.errors import GeometryError, UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.footprint import Footprint
from spatial_replay.logs.remote import log_file
from spatial_replay.mapping.yaml_document import Document, Place, checked_document, read_yaml_text, schema_of
from spatial_replay.perception.opencv import FAMILY_SIZES, Camera, pose_looking_at
from spatial_replay.trace.trace import duration_ns_from_text

LEAST_REFERENCES: Final = 4
"""Least number of reference tags for a plane.

With a calibrated camera, one tag would be enough, but an error of its place would not be noticed.
"""

_UNITS: Final = {"": 1.0, "mm": 1e-3, "cm": 1e-2, "m": 1.0}
_LENGTH: Final = re.compile(r"([-+]?[0-9]*\.?[0-9]+)\s*(mm|cm|m)")
_ANGLE: Final = re.compile(r"([-+]?[0-9]*\.?[0-9]+)\s*deg")


@dataclass(frozen=True, slots=True)
class MountedTag:
    """A tag in the frame of its object, or a reference tag in the frame of the plane.

    Attributes:
        id: number of the tag.
        size: edge of the black square, in footprint units.
        x, y: place of the tag's centre.
        yaw: angle from the frame's x axis to the tag's right, counter-clockwise, radians.
        z: height of the tag above the reference tags while its object rests.
    """

    id: int
    size: float
    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    z: float = 0.0

    @property
    def corners(self) -> Floats:
        """(4, 2), corners in the order of a `Detection`."""
        half = self.size / 2
        rotation = np.array(
            [[math.cos(self.yaw), math.sin(self.yaw)], [-math.sin(self.yaw), math.cos(self.yaw)]]
        )
        square = np.array(
            [
                (-half, -half),
                (half, -half),
                (half, half),
                (-half, half),
            ]
        )
        corners: Floats = square @ rotation + np.array([self.x, self.y])
        return corners


@dataclass(frozen=True, slots=True)
class TaggedObject:
    """An object with tags.

    Attributes:
        footprint: footprint in the object's frame.
        height: (bottom, top) above the plane, or None.
        is_lifted: whether the object may leave the plane; its tags then have poses in space.
        fastest: highest speed, footprint units per second; the uncertainty of a held object grows at this
            speed.
    """

    name: str
    footprint: Footprint
    tags: tuple[MountedTag, ...]
    class_name: str | None = None
    height: tuple[float, float] | None = None
    is_lifted: bool = False
    fastest: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class TagsFile:
    """A valid tags file.

    Attributes:
        name: name of the file.
        family: family of all its tags.
        is_image: whether the plane is the image itself, in pixels.
        references: tags with known places.
        camera: model of the camera; None if it is not calibrated.
        pose: (6,), rotation vector and translation from the plane's frame to the camera's; None if
            reference tags determine the pose.
        cameras: camera and pose of each of several cameras, by name or number; replaces `camera` and `pose`.
        corner_error: standard deviation of a corner, pixels; None to measure it.
        reference_error: error of a reference tag's place, in footprint units.
        sigmas: number of standard deviations that the stated uncertainty covers.
        hold_ns: time that a hidden object is held at its last place, with growing uncertainty.
        by_id: object and mounting of each tag by number.
        text: text of the file.
    """

    name: str
    family: str
    objects: tuple[TaggedObject, ...]
    is_image: bool = False
    references: tuple[MountedTag, ...] = ()
    camera: Camera | None = None
    pose: Floats | None = None
    cameras: Mapping[str, tuple[Camera, Floats | None]] = field(default_factory=lambda: MappingProxyType({}))
    corner_error: float | None = None
    reference_error: float = 0.0
    sigmas: float = 4.0
    hold_ns: int = 0
    by_id: Mapping[int, tuple[TaggedObject, MountedTag]] = field(default_factory=lambda: MappingProxyType({}))
    text: str = field(default="", repr=False)

    @property
    def unit(self) -> Literal["m", "px"]:
        """The unit of footprints."""
        return "px" if self.is_image else "m"

    @property
    def ids(self) -> frozenset[int]:
        """Numbers of all tags in the file."""
        return frozenset([*self.by_id, *(reference.id for reference in self.references)])

    def of_camera(self, name: str, number: int = 1, *, count: int = 1) -> TagsFile:
        """Return the tags file for one of several cameras.

        Args:
            name: name of its video or topic.
            number: number of the camera, from 1.
            count: number of cameras.

        Raises:
            UsageError: the file lacks this camera, or gives one pose or one image for several cameras.
        """
        if self.cameras:
            camera_and_pose = self.cameras.get(name, self.cameras.get(str(number)))
            if camera_and_pose is None:
                camera_names = ", ".join(self.cameras)
                raise UsageError(
                    f"{self.name} has no camera {name or number}; its cameras are {camera_names}; name this"
                    f" one by its video or topic, or by its number, {number}"
                )
            return replace(self, camera=camera_and_pose[0], pose=camera_and_pose[1])
        if count > 1 and self.is_image:
            raise UsageError(
                f"{self.name}: plane: image is that of one camera; for several, give reference tags"
            )
        if count > 1 and self.pose is not None:
            raise UsageError(
                f"{self.name} gives one pose for {count} cameras; write cameras, with an entry for each"
                " video, or leave out the pose, which follows from the reference tags"
            )
        return self


def load_tags(path: str | PathLike[str]) -> TagsFile:
    """Load a tags file, from a path or an address.

    Raises:
        MissingFileError: there is no such file.
        UsageError: the file is not valid; all errors are listed.
    """
    return parse_tags(read_yaml_text(path), log_file(path).name)


def parse_tags(text: str, name: str = "tags") -> TagsFile:
    """Parse the text of a tags file.

    Args:
        name: name of the file, for errors.

    Raises:
        UsageError: the text is not valid; all errors are listed.
    """
    document = checked_document(text, name, schema_of("perception", "tags"), _contradictions, "a tags file")
    content: Any = document.value
    camera_value = content.get("camera") or {}
    default_size = content.get("size")
    plane = content.get("plane", {})
    is_image = plane == "image"
    camera = _camera(camera_value) if camera_value else None
    camera_entries: Mapping[str, Any] = content.get("cameras", {})
    try:
        reference_height = 0.0 if is_image else _length(plane.get("height", 0.0))
        objects = tuple(
            _object(object_name, entry, default_size, content, reference_height)
            for object_name, entry in content["objects"].items()
        )
        references = () if is_image else tuple(_references(plane, default_size))
        pose = _pose(camera_value)
        cameras = {
            camera_name: (_camera(entry), _pose(entry)) for camera_name, entry in camera_entries.items()
        }
    except (UsageError, GeometryError) as error:
        raise UsageError(f"{name}: {error}") from None
    return TagsFile(
        name=name,
        family=content.get("family", "36h11"),
        objects=objects,
        is_image=is_image,
        references=references,
        camera=camera,
        pose=pose,
        cameras=MappingProxyType(cameras),
        corner_error=content.get("corner_error"),
        reference_error=0.0 if is_image else _length(plane.get("error", 0.0)),
        sigmas=float(content.get("sigmas", 4.0)),
        hold_ns=duration_ns_from_text(content["hold"]) if "hold" in content else 0,
        by_id=MappingProxyType({tag.id: (tagged, tag) for tagged in objects for tag in tagged.tags}),
        text=text,
    )


def _object(
    name: str,
    entry: Mapping[str, Any],
    default_size: Any,
    defaults: Mapping[str, Any],
    reference_height: float,
) -> TaggedObject:
    height_entry = entry.get("height")
    heights = None if height_entry is None else (_length(height_entry[0]), _length(height_entry[1]))
    # an image has no heights; a tag on an object without a height is as high as the reference tags
    default_height = reference_height if heights is None or _is_image(defaults) else heights[1]
    mountings = entry["tags"] if "tags" in entry else [entry["tag"]]
    tags = []
    for mounting in mountings:
        tag_entry = mounting if isinstance(mounting, dict) else {"id": mounting}
        z = _length(tag_entry.get("z", default_height)) - reference_height
        tags.append(_tag(tag_entry["id"], tag_entry, 0.0 if default_size is None else default_size, z))
    return TaggedObject(
        name,
        _footprint(entry),
        tuple(tags),
        entry.get("class"),
        heights,
        entry.get("lifted", False),
        _length(entry.get("fastest", defaults.get("fastest", 1000.0 if _is_image(defaults) else 1.0))),
    )


def _footprint(entry: Mapping[str, Any]) -> Footprint:
    if "box" in entry:
        half_length, half_width = (_length(side) / 2 for side in entry["box"])
        return Footprint.box(-half_length, -half_width, half_length, half_width)
    if "disc" in entry:
        return Footprint.disc(0.0, 0.0, _length(entry["disc"]))
    return Footprint.polygon([[_length(coordinate) for coordinate in corner] for corner in entry["polygon"]])


def _references(plane: Mapping[str, Any], default_size: Any) -> Iterator[MountedTag]:
    for tag_id, entry in plane.get("tags", {}).items():
        tag_entry = entry if isinstance(entry, dict) else {"at": entry}
        yield _tag(int(tag_id), tag_entry, plane.get("size", default_size))


def _tag(tag_id: int, entry: Mapping[str, Any], default_size: Any, z: float = 0.0) -> MountedTag:
    x, y = (_length(coordinate) for coordinate in entry.get("at", (0.0, 0.0)))
    return MountedTag(
        tag_id, _length(entry.get("size", default_size)), x, y, _angle(entry.get("yaw", 0.0)), z
    )


def _camera(entry: Mapping[str, Any]) -> Camera:
    width, height = entry["size"]
    (fx, fy), (cx, cy) = entry["focal"], entry.get("centre", ((width - 1) / 2, (height - 1) / 2))
    return Camera(
        (float(fx), float(fy)),
        (float(cx), float(cy)),
        (width, height),
        tuple(map(float, entry.get("distortion", ()))),
    )


def _pose(camera_entry: Mapping[str, Any]) -> Floats | None:
    """Return the pose (6,) from a camera's position and the point that it looks at; None without them."""
    pose_entry = camera_entry.get("pose")
    if pose_entry is None:
        return None
    eye, target = (
        np.array([_length(coordinate) for coordinate in pose_entry[key]]) for key in ("position", "look_at")
    )
    return pose_looking_at(eye, target, np.array(pose_entry.get("up", (0.0, 0.0, 1.0)), np.float64))


def _length(value: Any) -> float:
    if isinstance(value, str):
        match = _LENGTH.fullmatch(value)
        if match is None:
            raise UsageError(f"{value!r} is not a length; write 40mm, 4cm or 0.04m")
        return float(match[1]) * _UNITS[match[2]]
    return float(value)


def _angle(value: Any) -> float:
    if isinstance(value, str):
        match = _ANGLE.fullmatch(value)
        if match is None:
            raise UsageError(f"{value!r} is not an angle; write 90deg, or radians as a number")
        return math.radians(float(match[1]))
    return float(value)


def _is_image(value: Mapping[str, Any]) -> bool:
    return value.get("plane") == "image"


def _contradictions(document: Document) -> list[tuple[Place, str]]:
    """Find faults that a schema cannot express, such as a tag that is used twice or an undetermined plane."""
    content: Any = document.value
    if not isinstance(content, dict) or not isinstance(content.get("objects"), dict):
        return []
    faults: list[tuple[Place, str]] = []
    tag_uses: dict[int, str] = {}

    def use(tag_id: Any, place: Place, description: str) -> None:
        if not isinstance(tag_id, int) or isinstance(tag_id, bool):
            return
        if tag_id in tag_uses:
            faults.append((place, f"tag {tag_id} is {tag_uses[tag_id]} already; a tag is in one place"))
        tag_uses.setdefault(tag_id, description)

        family = content.get("family", "36h11")
        if tag_id >= FAMILY_SIZES.get(family, tag_id + 1):
            last_id = FAMILY_SIZES[family] - 1
            faults.append((place, f"family {family} has no tag {tag_id}; its tags are 0 to {last_id}"))

    if _is_image(content) and isinstance(content.get("size"), str):
        faults.append(
            (("size",), f"in plane: image lengths are pixels; write a number; got {content['size']!r}")
        )
    camera = content.get("camera") or content.get("cameras")
    if "camera" in content and "cameras" in content:
        faults.append((("cameras",), "give either camera, of one or of all, or cameras, one for each"))
    plane = content.get("plane")
    references = plane.get("tags") if isinstance(plane, dict) else None
    reach_m = _reach(references or (camera.get("pose") if isinstance(camera, dict) else None))
    if length_fault := _beyond(content.get("size"), reach_m):
        faults.append((("size",), length_fault))
    if length_fault := _beyond(plane.get("height") if isinstance(plane, dict) else None, reach_m):
        faults.append((("plane", "height"), length_fault))
    for name, entry in cast("dict[str, Any]", content["objects"]).items():
        if not isinstance(entry, dict):
            continue
        place: Place = ("objects", name)
        shape_keys = [key for key in ("box", "disc", "polygon") if key in entry]
        length_keys = (*shape_keys, "height")
        faults += [
            ((*place, key), length_fault)
            for key in length_keys
            if (length_fault := _beyond(entry.get(key), reach_m))
        ]
        if len(shape_keys) != 1:
            faults.append(
                (place, "give one of box, disc and polygon, the footprint around the object's centre")
            )
        if "polygon" in entry and (fault := _outline_fault(entry["polygon"])):
            faults.append(((*place, "polygon"), fault))
        if ("tag" in entry) == ("tags" in entry):
            faults.append((place, "give either tag, a number, or tags, a list"))
        tags = entry["tags"] if isinstance(entry.get("tags"), list) else [entry.get("tag")]
        for tag_index, tag in enumerate(tags):
            tag_place = (*place, "tags", tag_index) if "tags" in entry else (*place, "tag")
            use(tag.get("id") if isinstance(tag, dict) else tag, tag_place, f"on {name}")
            if isinstance(tag, dict) and tag.get("z") and _is_image(content):
                faults.append((tag_place, "an image has no heights; leave z out, or give reference tags"))
            has_size = "size" in content or (isinstance(tag, dict) and "size" in tag)
            if entry.get("lifted") and not has_size:
                faults.append((tag_place, "a lifted object is found by the size of its tags; give size"))
        if entry.get("lifted") and not camera:
            faults.append(
                (place, "lifted needs a calibrated camera; add camera (tags calibrate measures one)")
            )
    if isinstance(plane, dict) and isinstance(references, dict):
        for key, entry in references.items():
            tag_place = ("plane", "tags", key)
            if not key.isdecimal():
                faults.append((tag_place, f"expected the number of a tag; got {key[:40]!r}"))
                continue
            use(int(key), tag_place, "a reference tag")
            has_own_size = isinstance(entry, dict) and "size" in entry
            if not has_own_size and "size" not in content and "size" not in plane:
                faults.append(
                    (tag_place, "the size of the tag is missing; give size for all, or for this one")
                )
    camera_entries = camera if "cameras" in content and isinstance(camera, dict) else {"camera": camera}
    cameras_without_pose = [
        str(name)
        for name, camera_entry in camera_entries.items()
        if not (isinstance(camera_entry, dict) and "pose" in camera_entry)
    ]
    has_enough_references = isinstance(references, dict) and len(references) >= LEAST_REFERENCES
    if plane != "image" and cameras_without_pose and not has_enough_references:
        references_text = f"{LEAST_REFERENCES} or more tags with known places"
        alternative = "the camera with its pose, or write plane: image for pixels"
        if "cameras" in content:
            alternative = f"the pose of each camera; {cameras_without_pose[0]} has none"
        faults.append((("plane",), f"the plane is not determined: give {references_text}, or {alternative}"))
    return faults


def _reach(point_entries: Any) -> float:
    """Return the diagonal of the box around points, in metres; inf if it is not known.

    The points are the reference tags, or a camera and the point that it looks at.
    """
    try:
        entries = [entry for key, entry in point_entries.items() if key != "up"]
        places = [[*map(_length, entry["at"] if isinstance(entry, dict) else entry)] for entry in entries]
        return float(np.linalg.norm(np.ptp(places, axis=0))) or math.inf
    except (AttributeError, KeyError, TypeError, ValueError, UsageError):
        return math.inf


def _beyond(length_entry: Any, reach_m: float) -> str:
    """Return the fault of a length without a unit that exceeds `reach_m`; "" without a fault."""
    length = max(_plain_numbers(length_entry), default=0.0)
    if length <= reach_m:
        return ""
    return (
        f"{length:g} is {length:g} m, and the table that the camera sees is within {reach_m:.3g} m;"
        f" write {length:g}mm, or {length:g}m if that is meant"
    )


def _plain_numbers(value: Any) -> Iterator[float]:
    """Yield the absolute values of numbers without a unit in nested lists."""
    if isinstance(value, list):
        for number in value:
            yield from _plain_numbers(number)
    elif isinstance(value, int | float):
        yield abs(float(value))


def _outline_fault(corners: Any) -> str | None:
    """Return the reason why a polygon is no footprint; None for a footprint, and for malformed corners."""
    try:
        Footprint.polygon([[_length(coordinate) for coordinate in corner] for corner in corners])
    except GeometryError as error:
        # a tags file has no `concave`
        return str(error).removesuffix(", or take its hull (concave='hull')")
    except (UsageError, TypeError, ValueError):
        pass
    return None
