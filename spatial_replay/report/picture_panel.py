"""What the log's camera saw → the report's strip of small pictures."""

from __future__ import annotations

import base64
from collections.abc import Collection, Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from spatial_replay.bags.open import is_log, open_messages
from spatial_replay.errors import LogError, UsageError
from spatial_replay.logs.remote import LogFile
from spatial_replay.logs.source import Source
from spatial_replay.logs.topics import CAMERA_VIDEO, is_image_type
from spatial_replay.perception.frame import Image
from spatial_replay.perception.image_sources import ImageTopic
from spatial_replay.perception.opencv import encode_jpeg

MOST_PICTURES: Final = 60
"""Pictures of a page, at most: those of what decided verdicts, and others at equal distances."""
MOST_PICTURE_BYTES: Final = 1_500_000
"""Characters of a page that its pictures take, at most."""

_FORMS: Final = ((320, 70), (320, 45), (200, 45), (120, 40), (60, 30))
"""Widths in pixels and qualities of JPEG, of which the first is taken that is small enough."""


class ReportedPictures(NamedTuple):
    """What the camera of a run saw.

    Attributes:
        topic: with the images; "" without any.
        times_ns: of the pictures, increasing.
        pictures: each as JPEG.
        reason: why there is none though the log has images; "" otherwise.
    """

    topic: str = ""
    times_ns: tuple[int, ...] = ()
    pictures: tuple[bytes, ...] = ()
    reason: str = ""


NO_PICTURES: Final = ReportedPictures()
"""Of a log without images."""


def pictures_of(source: Source, start_ns: int, end_ns: int, decided_ns: Collection[int]) -> ReportedPictures:
    """Return small pictures of what a log's camera saw from `start_ns` to `end_ns`.

    Args:
        decided_ns: samples whose pictures are among them, as far as there is room.
    """
    path = getattr(source, "path", None)
    if not isinstance(path, LogFile) or (topic := _image_topic(path)) is None:
        return NO_PICTURES
    decided = sorted(decided_ns)[: MOST_PICTURES // 2]
    others = np.linspace(start_ns, end_ns, MOST_PICTURES - len(decided)).astype(np.int64).tolist()
    try:
        frames = ImageTopic(path, topic).frames_at(sorted({*decided, *others}))
        made = [(frame.time_ns, _small(frame.image)) for frame in frames]
    except (LogError, UsageError) as error:
        return ReportedPictures(topic, reason=f"The pictures of {topic} are not shown: {error}.")
    if not made:
        return ReportedPictures(topic, reason=f"No picture of {topic} can be decoded.")
    times_ns, pictures = zip(*made, strict=True)
    return ReportedPictures(topic, times_ns, pictures)


def picture_values(seen: ReportedPictures, first_ns: int) -> Mapping[str, Any]:
    """Return the pictures as the page reads them."""
    return {
        "topic": seen.topic,
        "reason": seen.reason,
        "times": [(time_ns - first_ns) / 1e9 for time_ns in seen.times_ns],
        "pictures": [
            f"data:image/jpeg;base64,{base64.b64encode(each).decode('ascii')}" for each in seen.pictures
        ],
    }


def _image_topic(path: LogFile) -> str | None:
    """Return the topic with images that a layout shows, too: our own, or else the first."""
    if not is_log(path):
        return None
    try:
        topics = [each.name for each in open_messages(path).topics() if is_image_type(each.type)]
    except LogError:
        # the replay has said how damaged it is
        return None
    return CAMERA_VIDEO if CAMERA_VIDEO in topics else next(iter(topics), None)


def _small(image: Image) -> bytes:
    most = MOST_PICTURE_BYTES * 3 // 4 // MOST_PICTURES - 64
    data = b""
    for width, quality in _FORMS:
        data = encode_jpeg(image, width, quality)
        if len(data) <= most:
            break
    return data
