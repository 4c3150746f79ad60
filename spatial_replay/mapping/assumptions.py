"""Assumptions about mapped logs, and their contradictions in a log.

Each row of the table `ASSUMPTIONS` has an assumption, the measurement that contradicts it, and the key that
resolves the contradiction. A new assumption is one row and one function. `contradictions` compares the table
with the evidence of a log.
"""

from __future__ import annotations

from cmath import phase
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from math import degrees, pi
from typing import Final, TypeAlias

import numpy as np

from spatial_replay.mapping.binding import BY_PLACE
from spatial_replay.mapping.evidence import FAR_LEAP, Moment, TopicEvidence
from spatial_replay.mapping.mapping_file import UNITS_NS, LogMapping
from spatial_replay.text import Instant, Sentence, number_text, plural
from spatial_replay.trace.doubts import MANY_TURNS, SHORTEST_PERIOD_NS, Doubt

Log: TypeAlias = Mapping[str, TopicEvidence]
Check: TypeAlias = Callable[[TopicEvidence, Log], str | None]


@dataclass(frozen=True, slots=True)
class Assumption:
    """An assumption about the messages of a topic.

    Attributes:
        name: name for `accept` in a mapping.
        assumed: the assumption, for the documentation.
        measured: the measurement with its limit, for the documentation.
        check: function that returns the contradiction as a clause to follow "TOPIC: "; None without a
            contradiction.
        remedy: key that resolves the contradiction.
        is_remark: whether a contradiction is only a remark, because unusual but sound data look the same.
        is_about_signals: whether the topic's signals also depend on the assumption.
    """

    name: str
    assumed: str
    measured: str
    check: Check
    remedy: str
    is_remark: bool = False
    is_about_signals: bool = False


def contradictions(log: Log, mapping: LogMapping) -> Iterator[Doubt | str]:
    """Yield contradictions of the assumptions: doubts, or remarks if the data may be unusual but sound.

    If many topics contradict an assumption, one sentence covers all of them. A name in `accept` that the log
    does not contradict gives a remark, too.
    """
    uncontradicted = dict.fromkeys(mapping.accept)
    for evidence in log.values():
        evidence.settle()
    for assumption in ASSUMPTIONS:
        clauses = {}
        for topic, evidence in log.items():
            clause = assumption.check(evidence, log) if evidence.arrivals.messages else None
            if clause is not None:
                clauses[topic] = clause
        if not clauses:
            continue
        is_accepted = assumption.name in mapping.accept
        uncontradicted.pop(assumption.name, None)
        for topics in _group_topics(clauses):
            more_topics = f" (and so in {plural(len(topics) - 1, 'more topic')})" if len(topics) > 1 else ""
            if len({clauses[topic] for topic in topics}) == 1:
                more_topics = ""
            subjects = topics[:1] if more_topics else topics[:_MOST_NAMED]
            remedy = f"; {assumption.remedy}" if assumption.remedy else ""
            text = Sentence(f"{', '.join(subjects)}: ", clauses[topics[0]], f"{more_topics}{remedy}")
            if assumption.is_remark:
                yield Sentence("accepted: ", text) if is_accepted else text
                continue
            topic_evidence = [log[topic] for topic in topics]
            signals = [
                signal.name
                for evidence in topic_evidence
                if assumption.is_about_signals and evidence.planned.mapping is not None
                for signal in evidence.planned.mapping.signals
            ]
            yield Doubt(
                assumption.name,
                topics[0],
                text,
                objects=frozenset[str]().union(*(evidence.object_names for evidence in topic_evidence)),
                signals=frozenset(signals),
                is_accepted=is_accepted,
            )
    for name in uncontradicted:
        yield f"{mapping.name}: `accept: [{name}]` has no effect: the messages do not contradict that"


def _group_topics(clauses: Mapping[str, str]) -> list[list[str]]:
    """Return groups of topics, one per sentence: a single group for many topics, else one per clause."""
    if len(clauses) >= _MANY_TOPICS:
        return [list(clauses)]
    groups: dict[str, list[str]] = {}
    for topic, clause in clauses.items():
        groups.setdefault(clause, []).append(topic)
    return list(groups.values())


_MANY_TOPICS: Final = 3
"""Least number of topics that share one sentence."""
_MOST_NAMED: Final = 8
"""Limit of names in a sentence."""
_FEW: Final = 3
"""Least number of messages or reports for a measurement."""


def _unit_of_log_times(evidence: TopicEvidence, log: Log) -> str | None:
    arrivals = evidence.arrivals
    first_ns, last_ns = arrivals.first_ns, arrivals.last_ns
    if evidence.planned.clock == "header" or arrivals.messages <= _FEW or first_ns is None or last_ns is None:
        return None
    # the mean period, because messages within a burst are close in any unit
    period_ns = arrivals.mean_period_s * 1e9
    for unit, unit_ns in list(UNITS_NS.items())[1:]:
        year = _year(first_ns * unit_ns)
        if year is not None and period_ns < SHORTEST_PERIOD_NS < period_ns * unit_ns:
            return (
                f"its times look like {unit}: {first_ns} is {year} in {unit} and January 1970 in ns;"
                f" messages would come every {period_ns:.3g} ns"
            )
    return None


_FIRST_YEAR, _LAST_YEAR = 2005, 2100
"""Years in which robots are recorded."""


def _year(time_ns: int) -> int | None:
    """Return the year of a time; None outside the years in which robots are recorded."""
    # a time in another unit may be beyond datetime's last year
    if time_ns > 2**62:
        return None
    year = datetime.fromtimestamp(time_ns / 1e9, UTC).year
    return year if _FIRST_YEAR <= year <= _LAST_YEAR else None


def _times_never_set(evidence: TopicEvidence, log: Log) -> str | None:
    arrivals, clock = evidence.arrivals, evidence.planned.clock
    varies_by_clock = {"log": arrivals.log_varies, "publish": arrivals.publish_varies}
    varying_clocks = [name for name, is_varying in varies_by_clock.items() if is_varying and name != clock]
    # latched messages may all arrive at the same time
    is_latched = evidence.planned.is_latched or evidence.planned.is_lasting
    if varies_by_clock.get(clock, True) or arrivals.messages < _FEW or not varying_clocks or is_latched:
        return None
    return (
        f"its {arrivals.messages:,} messages have one {clock} time, and different {varying_clocks[0]} times"
    )


def _still_stamps(evidence: TopicEvidence, log: Log) -> str | None:
    arrivals, planned = evidence.arrivals, evidence.planned
    if planned.is_latched or planned.is_lasting or (planned.layout is not None and planned.layout.stays):
        return None
    # messages repeated with one stamp are wrong only if objects are in moving frames
    if not evidence.uses_stamps or not (arrivals.stamps_vary or evidence.uses_frames):
        return None
    still_s, usual_s = arrivals.longest_still_s, arrivals.log_period_s.median
    if not still_s > max(_LONG_STILL_S, _LONG_STILL * usual_s):
        return None
    return (
        Sentence(
            "its stamps stand still from ",
            Instant(arrivals.still_ns, 0),
            f" on for {still_s:.3g} s, while messages",
        )
        + f" come every {usual_s:.3g} s"
    )


_LONG_STILL_S, _LONG_STILL = 0.3, 5
"""Longest accepted time without a new stamp, in seconds and in median periods; the longer time applies."""


def _unit_of_stamps(evidence: TopicEvidence, log: Log) -> str | None:
    arrivals = evidence.arrivals
    passed_s, log_s = arrivals.stamps_passed_s, arrivals.log_passed_s
    if not (evidence.uses_stamps and evidence.has_moving_stamps and passed_s > 0 and log_s > 0):
        return None
    # a simulation may run at any rate, but a rate that equals a factor between units shows a wrong unit
    stamp_factor = passed_s / log_s
    if not any(
        abs(stamp_factor * unit_factor - 1) < _UNIT_ERROR or abs(stamp_factor / unit_factor - 1) < _UNIT_ERROR
        for unit_factor in _FACTORS
    ):
        return None
    return (
        f"its stamps advance by {number_text(passed_s)} s while {number_text(log_s)} s pass in the log, as"
        " if they were in another unit"
    )


_UNIT_ERROR: Final = 0.02
"""Largest relative error of a factor between units."""
_FACTORS: Final = (1e3, 1e6, 1e9)
"""Factors between units of time."""


def _another_clock(evidence: TopicEvidence, log: Log) -> str | None:
    lateness_s = [topic.arrivals.lateness_s for topic in log.values() if topic.has_moving_stamps]
    # medians are sorted by distance from the log's clock, because the nearer of two clocks counts as right
    medians_s = sorted((late_s.median for late_s in lateness_s), key=abs)
    late_s = evidence.arrivals.lateness_s
    if not (evidence.uses_stamps and evidence.has_moving_stamps):
        return None
    usual_s = medians_s[(len(medians_s) - 1) // 2]
    offset_s = late_s.median - usual_s
    # results of long computations are also late, but with varying delays
    is_steady = late_s.quantile(0.9) - late_s.quantile(0.1) < _STEADY_S
    if abs(offset_s) < _OTHER_CLOCK_S or (0 < offset_s < _SLOWEST_S and not is_steady):
        return None
    return (
        f"its stamps lie {_signed_s(late_s.median)} the log's clock, and those of other topics"
        f" {_signed_s(usual_s)}"
    )


_OTHER_CLOCK_S, _SLOWEST_S, _STEADY_S = 5.0, 600.0, 0.5
"""Limits, seconds: delay between two clocks, delay of the slowest computation, spread of a steady delay."""


def _signed_s(late_s: float) -> str:
    return f"{number_text(abs(late_s))} s {'behind' if late_s >= 0 else 'ahead of'}"


def _order_of_quaternion(evidence: TopicEvidence, log: Log) -> str | None:
    layout, quaternion_count = evidence.planned.layout, evidence.quaternions
    if layout is None or not layout.order or quaternion_count < _FEW:
        return None
    upright_count, other_upright_count = evidence.upright, evidence.upright_otherwise
    if (
        other_upright_count < _MOST_UPRIGHT * quaternion_count
        or upright_count > _FEW_UPRIGHT * quaternion_count
    ):
        return None
    # the other order reads a table's upside-down tag as upright and unturned, so some objects have to turn
    if evidence.turned_otherwise < max(_FEW, _SOME_TURNED * quaternion_count):
        return None
    other_order = "xyzw" if layout.order == "wxyz" else "wxyz"
    return (
        f"{upright_count:,} of {plural(quaternion_count, 'object')} stand upright if the order of the four"
        f" numbers is {layout.order}, and {other_upright_count:,} if it is {other_order}"
    )


_MOST_UPRIGHT, _FEW_UPRIGHT, _SOME_TURNED = 0.9, 0.5, 0.05
"""Shares of quaternions that contradict the mapping's order: at least the first share is upright in the other
order, at most the second share in the mapping's order. At least the third share is turned in the other order.
"""


def _length_of_quaternion(evidence: TopicEvidence, log: Log) -> str | None:
    lengths = evidence.quaternion_length
    shortest, longest = lengths.quantile(_OUTLIERS), lengths.quantile(1 - _OUTLIERS)
    if not longest - shortest > _LENGTH_ERROR * longest:
        return None
    return f"its quaternions have lengths from {number_text(shortest)} to {number_text(longest)}"


def _scaled_quaternion(evidence: TopicEvidence, log: Log) -> str | None:
    usual_length = evidence.quaternion_length.median
    if not abs(usual_length - 1) > _LENGTH_ERROR or _length_of_quaternion(evidence, log):
        return None
    return (
        f"its quaternions have the length {number_text(usual_length)}, and are taken as multiples of a"
        " rotation"
    )


_LENGTH_ERROR, _OUTLIERS = 0.05, 0.02
"""Largest relative spread of lengths, and share of lengths ignored at each end."""


def _is_unwrapped(evidence: TopicEvidence, turn: float) -> bool:
    """Return whether angles may be unwrapped: they begin within a turn, and steps are below half a turn."""
    return evidence.first_turn <= turn and evidence.motions.turn_step < turn / 2


def _radians(evidence: TopicEvidence, log: Log) -> str | None:
    layout, angles = evidence.planned.layout, evidence.turn
    greatest_angle = max(angles.greatest, -angles.least)
    if layout is None or abs(layout.angle_scale) != 1.0 or not greatest_angle > MANY_TURNS:
        return None
    # degrees stay within 360. Read as radians, they turn more than once a second, which few robots do.
    is_fast = evidence.motions.turn_rate.quantile(0.9) > 2 * pi and greatest_angle <= _A_TURN
    if _is_unwrapped(evidence, 2 * pi) and not is_fast:
        return None
    return f"its angles reach {number_text(greatest_angle)} and are read as radians"


def _some_turns(evidence: TopicEvidence, log: Log) -> str | None:
    layout, angles = evidence.planned.layout, evidence.turn
    greatest_angle = max(angles.greatest, -angles.least)
    if layout is None or abs(layout.angle_scale) != 1.0 or not greatest_angle > 2 * pi + _ROUNDING:
        return None
    if _radians(evidence, log):
        return None
    return f"its angles reach {number_text(greatest_angle)} and are read as radians"


_ROUNDING: Final = 0.01
"""Tolerance of a turn, radians."""


def _beyond_a_turn(evidence: TopicEvidence, log: Log) -> str | None:
    layout, angles = evidence.planned.layout, evidence.turn
    if layout is None or abs(layout.angle_scale) == 1.0:
        return None
    a_turn = round(2 * pi / abs(layout.angle_scale))
    limit = a_turn * _A_TURN / 360
    if not angles.greatest > limit or _is_unwrapped(evidence, limit):
        return None
    reached_text = number_text(angles.greatest)
    if angles.median > a_turn:
        return f"its yaw reaches {reached_text}, and mostly lies beyond a turn of {a_turn}"
    return (
        f"its yaw reaches {reached_text}, which is beyond a turn of {a_turn}; {reached_text} often means not"
        " available"
    )


_A_TURN: Final = 360.5
"""A turn with its tolerance, degrees."""


def _heading(evidence: TopicEvidence, log: Log) -> str | None:
    """Compare the yaw of objects with the course of their motion, for each interpretation of the angle."""
    motions, layout = evidence.motions, evidence.planned.layout
    if layout is None or motions.steps < _FEW_STEPS or evidence.has_given_heading or _radians(evidence, log):
        return None
    courses = motions.courses
    read_course = courses.pop("read")
    if abs(read_course) > _STEADY and abs(phase(read_course)) < _ASKEW:
        return None
    fitting_courses = {
        heading_keys: mean
        for heading_keys, mean in courses.items()
        if abs(mean) > _CLOSE and abs(phase(mean)) < _ALONG
    }
    heading_keys = max(
        fitting_courses, key=lambda heading_keys: fitting_courses[heading_keys].real, default=None
    )
    # a straight path is no evidence, because a robot may go sideways. A heading next to satellite fixes
    # counts from north.
    is_straight = abs(motions.course) > _STRAIGHT
    is_compass = evidence.planned.is_geodetic and evidence.is_called_heading
    if heading_keys is None or (is_straight and not ("north" in heading_keys and is_compass)):
        return None
    deviation = (
        f"{degrees(phase(read_course)):.0f} degrees" if abs(read_course) > _STEADY else "by changing angles"
    )
    return (
        f"its objects move {deviation} off their yaw, and along it with"
        f" `yaw: {{field: {evidence.turn_path}, {heading_keys}}}`"
    )


def _compass(evidence: TopicEvidence, log: Log) -> str | None:
    """Return a clause on a yaw next to satellite fixes, unless motions confirm the mapping's yaw."""
    yaw = None if evidence.planned.mapping is None else evidence.planned.mapping.yaw
    courses = evidence.motions.courses
    goes_along = abs(courses["read"]) > _STEADY and abs(phase(courses["read"])) < _ASKEW
    if yaw is None or not yaw.is_plain or not evidence.planned.is_geodetic:
        return None
    if goes_along or _heading(evidence, log):
        return None
    unit = {1.0: "rad", pi / 180: "deg"}.get(abs(yaw.scale), "cdeg")
    heading_keys = f"{{field: {yaw.field}, unit: {unit}, zero: north, clockwise: true}}"
    return (
        f"{yaw.field} counts from the east, counter-clockwise; a heading from the north, clockwise, is"
        f" `yaw: {heading_keys}`"
    )


_FEW_STEPS: Final = 20
"""Least number of steps for a comparison of yaw and course."""
_STRAIGHT, _CLOSE = 0.8, 0.95
"""Least lengths of two mean unit vectors: of courses on a straight path, and of the difference between course
and yaw if an interpretation of the angle fits."""
_STEADY, _ASKEW, _ALONG = 0.9, pi / 4, pi / 9
"""Least length of the mean unit vector of a steady difference between course and yaw. Limits of this
difference, radians: for the mapping's interpretation of the angle, and for any other interpretation."""


def _degrees_as_metres(evidence: TopicEvidence, log: Log) -> str | None:
    layout = evidence.planned.layout
    if layout is None or layout.origin is not None:
        return None
    if evidence.angle_path:
        return f"{evidence.angle_path} is an angle by its name, and is taken as a coordinate"
    if not evidence.is_called_degrees:
        return None
    if not (abs(evidence.low[:2]).max() <= 360 and abs(evidence.high[:2]).max() <= 360):
        return None
    # a radar may name lateral and longitudinal metres lat and lon. 0.01 degrees a second are 1.1 km a second.
    if evidence.motions.speed.quantile(0.9) > _FAST_DEGREES:
        return None
    low, high = (", ".join(map(number_text, corner[:2].tolist())) for corner in (evidence.low, evidence.high))
    return f"its latitudes and longitudes, from {low} to {high}, are taken as metres"


_FAST_DEGREES: Final = 0.01
"""Highest plausible speed of an object, degrees per second; faster coordinates are not degrees."""


def _upward(evidence: TopicEvidence, log: Log) -> str | None:
    low, high = evidence.low, evidence.high
    layout = evidence.planned.layout
    if layout is None or layout.solids or layout.origin is not None:
        return None
    is_flat = np.isfinite([*low, *high]).all() and low[1] == high[1]
    if not is_flat or evidence.motions.speed.count < _FEW_LEAPS or high[2] - low[2] <= evidence.size.greatest:
        return None
    depth_text = number_text(float(high[2] - low[2]))
    return (
        f"y is {number_text(float(low[1]))} throughout and z varies by {depth_text}, as where y points"
        " upwards"
    )


def _no_degrees(evidence: TopicEvidence, log: Log) -> str | None:
    layout = evidence.planned.layout
    if layout is None or layout.origin is None:
        return None
    greatest_latitude = max(abs(evidence.low[0]), abs(evidence.high[0]))
    if not greatest_latitude > 90:
        return None
    # degrees times 10^7 are at most 9e8
    hint = (
        f"; times 1e-7 it is {number_text(greatest_latitude * 1e-7)}"
        if 1e6 < greatest_latitude <= 9e8
        else ""
    )
    if greatest_latitude == _NO_LATITUDE:
        hint = ", and AIS sends 91 and 181 for not available"
    return f"{greatest_latitude:.0f} is no latitude in degrees{hint}"


_NO_LATITUDE: Final = 91.0
"""Latitude of a missing position in AIS (ITU-R M.1371)."""


def _far_origin(evidence: TopicEvidence, log: Log) -> str | None:
    layout = evidence.planned.layout
    if layout is None or layout.origin is None or _no_degrees(evidence, log):
        return None
    origin = np.array(layout.origin)
    distance_deg = max(np.abs(evidence.low[:2] - origin).max(), np.abs(evidence.high[:2] - origin).max())
    if not (distance_deg > _FAR_DEGREES and np.abs(evidence.high[:2]).max() <= 360):
        return None
    return (
        f"its fixes are up to {number_text(distance_deg)} degrees from the origin, where the earth is not"
        " flat"
    )


_FAR_DEGREES: Final = 2.0
"""Largest distance from the origin, degrees (220 km)."""


def _precision(evidence: TopicEvidence, log: Log) -> str | None:
    greatest_coordinate = float(max(np.abs(evidence.low[:2]).max(), np.abs(evidence.high[:2]).max()))
    if not (evidence.is_single and evidence.has_fraction and np.isfinite(greatest_coordinate)):
        return None
    resolution = float(np.spacing(np.float32(greatest_coordinate)))
    is_geodetic = evidence.planned.is_geodetic
    if is_geodetic:
        resolution *= _METRES_A_DEGREE
    object_sizes = [topic.size.median for topic in log.values() if topic.size.median > 0]
    if resolution < _COARSE * min(object_sizes, default=np.inf):
        return None
    place_text = f"{greatest_coordinate:.0f} degrees" if is_geodetic else f"{greatest_coordinate:.0f}"
    return (
        f"its coordinates are float32, whose step at {place_text} is"
        f" {number_text(resolution)}{' m' * is_geodetic}; the smallest objects are"
        f" {number_text(min(object_sizes))} long"
    )


_COARSE: Final = 0.05
"""Largest step of float32, as a share of the smallest objects' size."""
_METRES_A_DEGREE: Final = 111_320.0
"""Length of a degree at the equator, metres."""


def _covariances(evidence: TopicEvidence, log: Log) -> str | None:
    zero_count, covariance_count = evidence.zero_covariances, evidence.covariances
    if not zero_count or zero_count < covariance_count / 2:
        return None
    return (
        f"{zero_count:,} of {plural(covariance_count, 'covariance')} are zeros, which means unknown, and"
        " count as exact"
    )


def _publishers(evidence: TopicEvidence, log: Log) -> str | None:
    arrivals, extractor, layout = evidence.arrivals, evidence.reader.extractor, evidence.planned.layout
    # a few changes back to an earlier channel do not show two publishers: each file of a bag has its own
    # channels, and a publisher may be replaced
    if arrivals.returns < max(_FEW, _IN_TURN * arrivals.messages):
        return None
    shares_names = extractor is None or extractor.namer.is_constant or evidence.motions.returns > 0
    if not (shares_names or (layout is not None and layout.complete)):
        return None
    return (
        f"{len(arrivals.publishers)} publishers (channels of the log) send it in turn, and their objects"
        " are read under the same names"
    )


_IN_TURN: Final = 0.01
"""Least share of messages with a change back to an earlier publisher."""


def _one_object(evidence: TopicEvidence, log: Log) -> str | None:
    motions = evidence.motions
    moment = motions.return_moment
    returns = motions.returns - motions.slow_returns
    if moment is None or returns < max(_FEW, motions.chances / 4):
        return None
    return _there_and_back(moment, returns, motions.chances, "two objects under one name do")


def _there_and_back(moment: Moment, returns: int, chances: int, comparison: str) -> Sentence:
    return Sentence(
        f"{moment.name} leaps by {number_text(moment.amount)} at ",
        Instant(moment.time_ns, 0),
        f" and back, and so in {returns:,} of {plural(chances, 'report')}, as {comparison}",
    )


def _complete_list(evidence: TopicEvidence, log: Log) -> str | None:
    layout, gaps = evidence.planned.layout, evidence.motions.gaps
    if layout is None or not layout.complete:
        return None
    if evidence.reader.extractor is not None and evidence.reader.extractor.differences:
        message_text = plural(evidence.reader.extractor.differences, "message")
        return (
            f"{message_text} have `is_diff`: lists of changes, and objects that they leave out are still"
            " there"
        )
    usual_gap = int(gaps[:-1].argmax())
    if usual_gap < 2 or gaps[usual_gap] < max(2 * _FEW, _REGULAR * gaps.sum()):
        return None
    return (
        f"its objects leave and return in turn: most are in every {_ordinal(usual_gap)} message only, as if"
        " a list came in parts"
    )


_REGULAR: Final = 0.8
"""Least share of steps whose two reports are the usual number of messages apart."""


def _ordinal(number: int) -> str:
    return {2: "second", 3: "third"}.get(number, f"{number}th")


def _one_class(evidence: TopicEvidence, log: Log) -> str | None:
    changes, change_count = evidence.motions.changes, evidence.motions.change_count
    if not changes:
        return None
    first_change = changes[0]
    more_text = f", and so {change_count - 1:,} more times" if change_count > 1 else ""
    return Sentence(
        (
            f"the class of {first_change.name} changes from {first_change.before or 'none'} to"
            f" {first_change.after or 'none'} at "
        ),
        Instant(first_change.time_ns, 0),
        f"{more_text}; a formula about a class says nothing of its object afterwards",
    )


def _corners(evidence: TopicEvidence, log: Log) -> str | None:
    extractor = evidence.reader.extractor
    if extractor is None or not extractor.boxes:
        return None
    leftward_count, downward_count, box_count = extractor.leftward, extractor.downward, extractor.boxes
    if leftward_count < box_count / 5 and not box_count / 5 < downward_count < box_count * 4 / 5:
        return None
    # swapped corners spread as widely as first corners, but widths and heights do not
    corner_reach = extractor.corner_high - extractor.corner_low
    if min(leftward_count, downward_count) == box_count and (corner_reach[1] > corner_reach[0] / 2).all():
        return None
    return (
        f"in {leftward_count:,} of {box_count:,} boxes the second corner lies left of the first: these may be"
        " x, y, width and height"
    )


def _extent(evidence: TopicEvidence, log: Log) -> str | None:
    layout = evidence.planned.layout
    if layout is None or not evidence.pointlike or not (layout.sizes or layout.solids or layout.shape):
        return None
    outlines = plural(evidence.objects, "outline")
    return f"{evidence.pointlike:,} of {outlines} have no extent: a size or scale is 0"


def _one_unit(evidence: TopicEvidence, log: Log) -> str | None:
    other_topics = [topic for topic in log.values() if topic is not evidence and topic.objects]
    other_sizes = [topic.size.median for topic in other_topics if topic.size.median > 0]
    other_speeds = [topic.motions.speed.quantile(0.9) for topic in other_topics]
    other_speeds = [speed for speed in other_speeds if speed > 0]
    size, arrivals = evidence.size.median, evidence.arrivals
    # objects in messages recorded in bursts seem fast, because times within a burst are close
    burst_factor = min(1.0, arrivals.period_s.median / arrivals.mean_period_s)
    usual_speed, speed = (evidence.motions.speed.quantile(share) * burst_factor for share in (0.5, 0.9))
    # if an object moves 1,000 sizes a second, the mapping's size and the positions have different units
    if usual_speed > max(_SOUND, _SIZES_A_SECOND * size) and size > 0:
        return f"its objects are {number_text(size)} long and move at {number_text(usual_speed)} a second"
    if not (other_sizes and other_speeds and speed > _THOUSAND * max(other_speeds)):
        return None
    # a shape from the mapping does not show the log's unit, so speed decides: no robot is faster than sound
    if not (size > _THOUSAND * max(other_sizes) or speed > _SOUND):
        return None
    return (
        f"its objects are {number_text(size)} long and move at {number_text(speed)} a second, and others at"
        f" most {number_text(max(other_sizes))} and {number_text(max(other_speeds))}: it may be in mm"
    )


_THOUSAND, _SOUND, _SIZES_A_SECOND = 200, 343.0, 1_000.0
"""Least ratio to other topics that shows millimetres; speed of sound, metres per second; highest plausible
speed, object sizes per second."""


def _one_frame(evidence: TopicEvidence, log: Log) -> str | None:
    frames = sorted(frozenset[str]().union(*(topic.frames for topic in log.values())))
    if evidence.uses_frames or len(frames) < 2 or not evidence.frames:
        return None
    return f"coordinates are in the frames {', '.join(map(repr, frames[:_MOST_NAMED]))} and taken as they are"


def _alternating(evidence: TopicEvidence, log: Log) -> str | None:
    arrivals, mapping = evidence.arrivals, evidence.planned.mapping
    if mapping is None or evidence.signal_chances < _FEW_LEAPS or arrivals.period_s.median > 1.0:
        return None
    is_often = evidence.signal_returns > _IN_PAIRS * evidence.signal_chances
    names = [
        signal.name for signal, returns_often in zip(mapping.signals, is_often, strict=True) if returns_often
    ]
    if not names:
        return None
    return f"{', '.join(names[:_MOST_NAMED])} goes there and back with each message, as if two senders report"


_IN_PAIRS: Final = 0.5
"""Least share of messages in which an alternating signal has the value of two messages before."""


def _by_place(evidence: TopicEvidence, log: Log) -> str | None:
    extractor = evidence.reader.extractor
    return BY_PLACE if extractor is not None and extractor.namer.is_by_place else None


def _cornerless(evidence: TopicEvidence, log: Log) -> str | None:
    extractor = evidence.reader.extractor
    if extractor is None or not extractor.cornerless:
        return None
    is_bounds = extractor.layout.is_bounds
    corner_condition = "other than two corners" if is_bounds else "fewer than three corners"
    hint = "" if is_bounds else "; `bounds` reads two opposite corners of a box"
    outlines = plural(extractor.cornerless, "outline")
    return f"{outlines} with {corner_condition}: objects are unknown there{hint}"


def _unset(evidence: TopicEvidence, log: Log) -> str | None:
    extractor = evidence.reader.extractor
    if extractor is None or not extractor.unset:
        return None
    clauses = (f"{plural(count, 'object')} did not set {path}" for path, count in extractor.unset.items())
    return f"{', '.join(clauses)}, so it is unknown there"


def _zero_quaternions(evidence: TopicEvidence, log: Log) -> str | None:
    extractor = evidence.reader.extractor
    if extractor is None or not 0 < extractor.unturned < extractor.turned:
        return None
    return (
        f"{extractor.unturned:,} of {plural(extractor.turned, 'pose')} have a quaternion of zeros, as"
        " trackers send for what they have lost; they count as poses without a turn"
    )


def _leap(evidence: TopicEvidence, log: Log) -> str | None:
    motions = evidence.motions
    moment = motions.return_moment
    usual_step = motions.speed.median * evidence.arrivals.period_s.median
    is_far = moment is not None and moment.amount > _FAST_LEAP * usual_step
    if moment is not None and is_far and motions.returns >= _FEW and _one_object(evidence, log) is None:
        comparison = "with a number that stands for not available"
        return _there_and_back(moment, motions.returns, motions.chances, comparison)
    jump, comeback, usual_speed = motions.jump, motions.comeback, max(motions.speed.quantile(0.9), 0.0)
    if jump is None or motions.speed.count < _FEW_LEAPS or not evidence.size.greatest > 0:
        return None
    if motions.zeros >= _FEW:
        times_text = plural(motions.zeros, "time")
        return f"its objects leap to (0, 0) {times_text}, as where that stands for not available"
    far_distance = FAR_LEAP * evidence.size.greatest
    if comeback is not None and comeback.amount > max(
        far_distance, _FARTHER * usual_speed * motions.comeback_s
    ):
        return Sentence(
            f"{comeback.name} is {number_text(comeback.amount)} farther at ",
            Instant(comeback.time_ns, 0),
            f", after {number_text(motions.comeback_s)} s without it, as where a name is used again; usual"
            f" speeds are below {number_text(usual_speed)}",
        )
    speed = jump.amount / motions.jump_s if motions.jump_s > 0 else np.inf
    if not (jump.amount > far_distance and speed > _FAST_LEAP * usual_speed):
        return None
    return Sentence(
        f"{jump.name} is {number_text(jump.amount)} farther at ",
        Instant(jump.time_ns, 0),
        f", after {number_text(motions.jump_s)} s; usual speeds are below {number_text(usual_speed)}",
    )


_FEW_LEAPS, _FAST_LEAP, _FARTHER = 10, 20.0, 3.0
"""Least number of steps of objects or signals; least speeds of a suspicious leap, and of a suspicious step
over an absence, as multiples of the usual speed."""

_DEGREES: Final = "`yaw: {field: PATH, unit: deg}` reads degrees"

ASSUMPTIONS: Final = (
    Assumption(
        "log_time_unit",
        "Log and publish times are nanoseconds.",
        "the date and the period of messages; plausible values in us, ms or s, but not in ns, contradict",
        _unit_of_log_times,
        "write the log with nanoseconds, or take `clock: header`",
        is_about_signals=True,
    ),
    Assumption(
        "log_times_set",
        "Messages have times on the clock that counts.",
        "log times and publish times; equal times on this clock, but not on the other, contradict",
        _times_never_set,
        "`clock: publish` takes publish times, `clock: log` those of recording",
        is_about_signals=True,
    ),
    Assumption(
        "stamps_advance",
        "Stamps advance with messages.",
        "the time during which messages repeat one stamp; more than 0.3 s and five periods contradicts",
        _still_stamps,
        "`clock: log` takes the times of recording",
    ),
    Assumption(
        "stamp_unit",
        "Stamps have the unit that the mapping says.",
        "the advance of stamps against the log's time; a factor of 1,000, 1e6 or 1e9 contradicts",
        _unit_of_stamps,
        "`stamp: {field: PATH, unit: ms}` names the unit, and `clock: log` takes the times of recording",
        is_about_signals=True,
    ),
    Assumption(
        "one_clock",
        "All stamps come from one clock.",
        "the delay from stamps to recording; a difference of 5 s from other topics contradicts",
        _another_clock,
        "`clock: log` takes one clock for all",
        is_about_signals=True,
    ),
    Assumption(
        "quaternion_order",
        "Four numbers without names are in the order that the mapping says.",
        "the number of upright objects in this order, and in the other order",
        _order_of_quaternion,
        "change `order`",
    ),
    Assumption(
        "quaternion_length",
        "Quaternions have the length 1.",
        "the lengths of quaternions; a spread of 5 % without the shortest and longest 2 % contradicts",
        _length_of_quaternion,
        "give the path of a quaternion as `orientation`",
    ),
    Assumption(
        "quaternion_scale",
        "Quaternions of another length are multiples of a rotation.",
        "the median length; a deviation of 5 % is remarked",
        _scaled_quaternion,
        "numbers that are no rotation are better left out: give `position` alone",
        is_remark=True,
    ),
    Assumption(
        "radians",
        "Angles without a unit are radians.",
        "the maximum angle; four turns contradict, unless angles count turns slowly from within one turn",
        _radians,
        _DEGREES,
    ),
    Assumption(
        "one_turn",
        "Angles in radians stay within a turn.",
        "the maximum angle",
        _some_turns,
        _DEGREES,
        is_remark=True,
    ),
    Assumption(
        "degrees",
        "Angles in degrees stay within a turn.",
        "the maximum angle; more than 360.5 contradicts, unless angles count turns",
        _beyond_a_turn,
        "`invalid: [NUMBER]` makes the object unknown there, `unit: cdeg` reads hundredths of a degree",
    ),
    Assumption(
        "heading",
        "An angle counts from x, counter-clockwise.",
        "directions of motion, compared with the angle in each reading",
        _heading,
        "",
    ),
    Assumption(
        "compass",
        "An angle next to latitudes counts from the east, counter-clockwise.",
        "directions of motion; an angle that motion does not confirm is remarked",
        _compass,
        "",
        is_remark=True,
    ),
    Assumption(
        "metres",
        "Positions are lengths.",
        "names of fields and the range of coordinates; latitudes and longitudes contradict",
        _degrees_as_metres,
        "`origin: [LATITUDE, LONGITUDE]` brings latitudes and longitudes into metres; no key reads a range"
        " with an angle",
    ),
    Assumption(
        "upward",
        "z points upwards.",
        "the extent along each axis; a constant y is remarked if z varies by more than an object's size",
        _upward,
        "`position: [x, z]` takes the ground plane",
        is_remark=True,
    ),
    Assumption(
        "latitude",
        "Latitudes are degrees.",
        "the maximum latitude; more than 90 contradicts",
        _no_degrees,
        "`scale: 1e-7` for the topic reads integers, `invalid: [91, 181]` leaves out what is not available",
    ),
    Assumption(
        "origin",
        "The origin is near the fixes.",
        "the distance of fixes from the origin; 2 degrees contradict",
        _far_origin,
        "give the `origin` a fix of this log",
    ),
    Assumption(
        "precision",
        "Coordinates are exact enough.",
        "the resolution of float32 coordinates; a step of 5 % of the smallest objects contradicts",
        _precision,
        "read them from a topic with float64, or nearer to the origin",
    ),
    Assumption(
        "covariance",
        "A covariance of zeros is exact.",
        "the share of covariances with zeros only; one half contradicts",
        _covariances,
        "give a radius as `uncertainty`",
    ),
    Assumption(
        "one_publisher",
        "One publisher sends a topic.",
        "channels of the topic whose messages alternate and share names",
        _publishers,
        "`[{name: a, publisher: 1}, {name: b, publisher: 2}]` for the topic makes two objects",
        is_about_signals=True,
    ),
    Assumption(
        "one_object",
        "A name is one object.",
        "leaps by more than the object's size and back within four reports; a quarter of reports contradicts",
        _one_object,
        "give a `name` with the field that distinguishes them",
    ),
    Assumption(
        "complete_list",
        "A list has all objects.",
        "the number of messages until objects return; usually the same number above one contradicts",
        _complete_list,
        "`complete: false` keeps objects that a message leaves out",
    ),
    Assumption(
        "one_class",
        "An object keeps its class.",
        "changes of class",
        _one_class,
        "`class: {field: PATH, changes: split}` makes two objects of it, `first` keeps its first class",
        is_remark=True,
    ),
    Assumption(
        "corners",
        "Bounds are two opposite corners.",
        "the place of the second corner; left of the first in a fifth of all boxes contradicts",
        _corners,
        "`bounds: {field: PATH, form: xywh}` reads a corner and a size",
    ),
    Assumption(
        "extent",
        "Outlines of messages have an extent.",
        "the number of outlines of size 0",
        _extent,
        "give a `shape`",
    ),
    Assumption(
        "one_unit",
        "All topics have one unit of length.",
        "sizes and speeds; 200 times those of all other topics contradict, also a speed above 1,000 sizes per"
        " second and above the speed of sound",
        _one_unit,
        "`scale: 0.001` for the topic brings millimetres into metres, also the sizes in its entry",
    ),
    Assumption(
        "one_frame",
        "Without `fixed_frame`, all coordinates are in one frame.",
        "the frames that messages and objects name; two frames contradict",
        _one_frame,
        "`fixed_frame` brings them into one",
    ),
    Assumption(
        "one_series",
        "A signal is one series.",
        "the share of values that return to the last value but one; one half is remarked, except for switches"
        " of 0 and 1",
        _alternating,
        "",
        is_remark=True,
        is_about_signals=True,
    ),
    Assumption("places", "Places in a list name objects.", "the presence of ids", _by_place, "", True),
    Assumption(
        "outlines",
        "Outlines have corners.",
        "the number of outlines with too few corners",
        _cornerless,
        "",
        is_remark=True,
    ),
    Assumption("fields_set", "Fields are set.", "the presence of protobuf fields", _unset, "", True),
    Assumption(
        "orientation_set",
        "Orientations are set.",
        "the number of zero quaternions among other quaternions",
        _zero_quaternions,
        "",
        is_remark=True,
    ),
    Assumption(
        "motion",
        "Objects move steadily.",
        "the longest step; five sizes at 20 times the usual speed are remarked (3 times after an absence),"
        " also leaps to (0, 0)",
        _leap,
        "`invalid` names numbers without a value, a `name` with an id distinguishes objects",
        is_remark=True,
    ),
)

NAMES: Final = tuple(assumption.name for assumption in ASSUMPTIONS)
"""Names for `accept` in a mapping."""
