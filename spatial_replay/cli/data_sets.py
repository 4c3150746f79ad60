"""`spatial-replay info` of data sets of episodes, and of an episode without a mapping."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from spatial_replay.cli.application import ExitCode
from spatial_replay.cli.output import align_rows
from spatial_replay.cli.terminal import progress, show_result, warn
from spatial_replay.errors import LogError, UsageError
from spatial_replay.text import json_fields, json_number, listing, plural, printable, without_numbers

if TYPE_CHECKING:
    from spatial_replay.logs.formats.episodes import DataSet, EpisodeColumns, EpisodeReading, Feature

_MOST_LABELS: Final = 1_000
"""Maximum number of episodes whose labels are counted."""
_MOST_TASKS: Final = 5
_MOST_NAMED: Final = 5
"""Maximum number of episodes in a warning."""
_MOST_PLACES: Final = 60
"""Maximum number of printed places of a feature."""


def show_data_set(data_set: DataSet, as_json: bool) -> int:
    """Print the contents of a data set.

    Raises:
        UsageError: the data set has no poses.
    """
    from spatial_replay.mapping.suggest_features import why_poseless

    labels = _read_labels(data_set)
    bodies, remarks = _bodies(data_set)
    warn(*(f"{data_set.name}: {remark}" for remark in (*data_set.remarks, *remarks)))
    show_result(
        lambda: _document(data_set, labels, bodies, remarks),
        lambda: _lines(data_set, labels, bodies),
        as_json,
    )
    if reason := why_poseless(data_set):
        raise UsageError(reason)
    return ExitCode.SATISFIED


def show_episode(data_set: DataSet, number: int, as_json: bool) -> int:
    """Print the contents of an episode without a mapping: its task, its label, and ranges of numbers."""
    from spatial_replay.mapping.suggest_features import mappable_features

    episode, features = data_set.episode(number), mappable_features(data_set)
    columns = data_set.columns(number, _any_rate(data_set), [feature.name for feature in features])
    name = f"{data_set.name}#{number}"
    unjudged_reasons = [columns.unjudged] if columns.unjudged else []
    warn(*(f"{name}: {text}" for text in (*columns.faults, *columns.remarks, *unjudged_reasons)))

    def document() -> dict[str, Any]:
        return {
            "name": name,
            "kind": f"{data_set.kind} episode",
            **json_fields(episode, "number", "key", "task", "seed"),
            "frames": len(columns.times_ns),
            "seconds": _seconds(columns) if data_set.fps else None,
            "success": columns.label,
            "faults": columns.faults,
            "remarks": columns.remarks,
            "unjudged": columns.unjudged or None,
            "features": [
                {"name": feature.name, "places": list(_ranges(feature, columns))} for feature in features
            ],
        }

    show_result(document, lambda: _episode_lines(data_set, number, columns, features), as_json)
    return ExitCode.DAMAGED if columns.faults else ExitCode.SATISFIED


def _episode_lines(
    data_set: DataSet, number: int, columns: EpisodeColumns, features: Sequence[Feature]
) -> Iterator[str]:
    episode = data_set.episode(number)
    length_text = f" in {_seconds(columns):.3f} s" if data_set.fps else ""
    frames_text = plural(len(columns.times_ns), "frame")
    yield f"{data_set.name}#{number}: {data_set.kind} episode, {frames_text}{length_text}"
    if episode.task:
        yield f"task     {printable(episode.task)}"
    if columns.label is not None:
        yield f"label    {_label_text(data_set, columns)}"
    for feature in features:
        yield printable(feature.name)
        range_rows = list(_ranges(feature, columns))
        yield from align_rows(
            (
                row["place"],
                f"first {row['first']:.4g}",
                f"from {row['least']:.4g} to {row['greatest']:.4g}",
            )
            for row in range_rows[:_MOST_PLACES]
        )
        if len(range_rows) > _MOST_PLACES:
            yield f"  … and {len(range_rows) - _MOST_PLACES:,} more; --json prints all"


def _seconds(columns: EpisodeColumns) -> float:
    return int(columns.times_ns[-1] - columns.times_ns[0]) / 1e9 if len(columns.times_ns) else 0.0


def _any_rate(data_set: DataSet) -> EpisodeReading:
    """Return reading options for values that are independent of times."""
    from spatial_replay.logs.formats.episodes import AS_STORED

    return AS_STORED._replace(fps=data_set.fps or 1.0)


def _read_labels(data_set: DataSet) -> list[bool | None]:
    """Return the labels of the first episodes; None for a missing or unreadable label."""
    if data_set.label is None:
        return []
    episodes = data_set.episodes[:_MOST_LABELS]
    labels: list[bool | None] = []
    numbers_by_error: dict[str, list[str]] = {}
    with progress("episodes", len(episodes)) as advance:
        for episode in episodes:
            address = f"{data_set.name}#{episode.number}"
            try:
                success_flags = data_set.success(episode.number)
                labels.append(None if success_flags is None else bool(success_flags.any()))
            except LogError as error:
                reason = str(error).removeprefix(f"{address}: ")
                numbers_by_error.setdefault(without_numbers(reason), [reason]).append(f"#{episode.number}")
                labels.append(None)
            advance(1)
    for reason, *numbers in numbers_by_error.values():
        warn(f"{reason} ({plural(len(numbers), 'episode')}: {listing(numbers, _MOST_NAMED)})")
    return labels


def _bodies(data_set: DataSet) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the bodies of the first episode, and remarks. An unreadable episode gives only a remark."""
    if not data_set.names_bodies or not data_set.episodes:
        return [], []
    try:
        columns = data_set.columns(data_set.episodes[0].number, _any_rate(data_set), ())
    except (UsageError, LogError) as error:
        return [], [str(error).removeprefix(f"{data_set.name} ")]
    bodies = [
        {
            "name": body.name,
            "has_orientation": body.quaternions is not None,
            "has_shape": body.shapes is not None,
        }
        for body in columns.bodies
    ]
    return bodies, list(columns.remarks)


def _document(
    data_set: DataSet, labels: Sequence[bool | None], bodies: Sequence[dict[str, Any]], remarks: Sequence[str]
) -> dict[str, Any]:
    from spatial_replay.mapping.suggest_features import mappable_features

    mappable = {feature.name for feature in mappable_features(data_set)}
    label = data_set.label
    successes = [*labels, *[None] * (len(data_set.episodes) - len(labels))]
    return {
        **json_fields(data_set, "name", "kind", "fps"),
        "robot": data_set.robot or None,
        "label": None
        if label is None
        else {**json_fields(label), "episodes": len(labels), "successes": labels.count(True)},
        "episodes": [
            {"episode": f"{data_set.name}#{episode.number}", **json_fields(episode), "success": success}
            for episode, success in zip(data_set.episodes, successes, strict=True)
        ],
        "features": [
            {**json_fields(feature), "mappable": feature.name in mappable} for feature in data_set.features
        ],
        "objects": list(bodies),
        "remarks": [*data_set.remarks, *remarks],
    }


def _lines(
    data_set: DataSet, labels: Sequence[bool | None], bodies: Sequence[dict[str, Any]]
) -> Iterator[str]:
    from spatial_replay.mapping.suggest_features import mappable_features, places_text, why_poseless

    frame_counts = [episode.frames for episode in data_set.episodes]
    total = plural(sum(map(int, filter(None, frame_counts))), "frame") if None not in frame_counts else ""
    rate_text = f"at {data_set.fps:g} Hz" if data_set.fps else ""
    facts = [
        data_set.kind,
        plural(len(data_set.episodes), "episode"),
        " ".join(filter(None, (total, rate_text))),
        f"robot {data_set.robot}" if data_set.robot else "",
    ]
    yield f"{data_set.name}: {', '.join(filter(None, facts))}"
    if not data_set.fps and not data_set.has_times:
        yield "rate     not in the data set: a mapping says it, such as `fps: 20`"
    task_counts = Counter(printable(episode.task) for episode in data_set.episodes if episode.task)
    if task_counts:
        task_texts = [f"{task} ({count:,})" for task, count in task_counts.most_common(_MOST_TASKS)]
        more_text = f", and {len(task_counts) - _MOST_TASKS:,} more" if len(task_counts) > _MOST_TASKS else ""
        yield f"tasks    {', '.join(task_texts)}{more_text}"
    yield f"label    {_labels_text(data_set, labels)}"
    if bodies:
        yield f"objects  {', '.join(_body_text(body) for body in bodies)}"
    features = mappable_features(data_set)
    for index, line in enumerate(align_rows((feature.name, places_text(feature)) for feature in features)):
        yield f"{'features' if index == 0 else '':8} {line.strip()}"
    picture_names = [feature.name for feature in data_set.features if not feature.width]
    if picture_names:
        yield f"pictures {printable(', '.join(picture_names), 400)}"
    if not data_set.episodes or why_poseless(data_set):
        return
    if not data_set.names_bodies:
        yield "a mapping says which of these are objects: --suggest-mapping"
    elif bodies:
        has_times = data_set.fps or data_set.has_times
        mapping_hint = ", so it needs no mapping" if has_times else "; a mapping with `fps:` is enough"
        yield f"it names its objects{mapping_hint}"
    first_address = f"{shlex.quote(str(data_set.path))}#{data_set.episodes[0].number}"
    yield f"each episode is a log: spatial-replay info {first_address}"


def _labels_text(data_set: DataSet, labels: Sequence[bool | None]) -> str:
    """Return a text with the number of labelled successes, and the state that a label describes."""
    if data_set.label is None:
        return "none; `label: FIELD` in a mapping names one"
    state_note = "; it is about the state after each frame's action" if data_set.label.is_about_next else ""
    scope = "the first " if len(labels) < len(data_set.episodes) else ""
    unlabelled_text = f" ({labels.count(None):,} without a label)" if None in labels else ""
    count_text = f"true in {labels.count(True):,} of {scope}{plural(len(labels), 'episode')}{unlabelled_text}"
    return f"{data_set.label.field}: {count_text}{state_note}"


def _body_text(body: dict[str, Any]) -> str:
    return f"{body['name']} ({'pose' if body['has_orientation'] else 'place'})"


def _label_text(data_set: DataSet, columns: EpisodeColumns) -> str:
    field = data_set.label.field if data_set.label else "label"
    if columns.success is None or columns.success.ndim == 0 or not columns.label:
        return f"{field}: {str(columns.label).lower()}"
    first_frame = int(columns.success.argmax())
    return f"{field}: true in {plural(int(columns.success.sum()), 'frame')}, first in frame {first_frame}"


def _ranges(feature: Feature, columns: EpisodeColumns) -> Iterator[dict[str, Any]]:
    """Yield the first, least and greatest number in each place of a feature; null if no number is finite."""
    if feature.name not in columns.features:
        return
    frame_rows = columns.features[feature.name].reshape(len(columns.times_ns), -1)
    for index, column in enumerate(frame_rows.T):
        finite_numbers = column[np.isfinite(column)]
        place = feature.places[index] if feature.places else f"[{index}]"
        yield {
            "place": place,
            "first": json_number(float(column[0])) if len(column) else None,
            "least": float(finite_numbers.min()) if len(finite_numbers) else None,
            "greatest": float(finite_numbers.max()) if len(finite_numbers) else None,
        }
