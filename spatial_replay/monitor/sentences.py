"""Witnesses in words: what decided a verdict, and what would flip it."""

from __future__ import annotations

import math
from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal

from spatial_replay.monitor.causes import Cause, LeastPart
from spatial_replay.monitor.verdict import Verdict
from spatial_replay.monitor.witness.atom import DecidingAtom, Measured
from spatial_replay.monitor.witness.threshold import Threshold
from spatial_replay.monitor.witness.witness import Witness, WitnessStep
from spatial_replay.text import Instant, Sentence

_DIGITS = 6
_LONGEST = 60
"""Characters of a formula that is only mentioned, at most."""
_EDGES = {"min_x": "left", "max_x": "right", "min_y": "lower", "max_y": "upper"}


def sentences_of(
    witness: Witness, *, first_ns: int, since_ns: int | None = None, is_open: bool = False
) -> tuple[Sentence, ...]:
    """Return sentences on why a node has its verdict: what decided it, and what would flip it.

    Args:
        first_ns: the time that others are counted from.
        since_ns: since when it has had its verdict, if that is known.
        is_open: whether samples after those evaluated may change it.
    """
    if witness.is_settled:
        since = Instant(witness.settled_ns or 0, first_ns)
        sentences = [_settled(_title(witness), witness.verdict, since)]
    else:
        sentences = [_verdict(witness, first_ns, since_ns, is_open)]
    if witness.deciding is None:
        sentences.append(_dead_end(witness.path[-1], first_ns))
    elif witness.deciding.unknown:
        sentences.append(_unknown(witness, witness.deciding, first_ns))
    elif witness.verdict is Verdict.UNKNOWN:
        sentences.append(_uncertain(witness, witness.deciding, first_ns))
    else:
        sentences.append(_decision(witness, witness.deciding, first_ns))
        sentences.append(Sentence(_flip(witness, witness.deciding, witness.threshold)))
    if witness.open_end is not None:
        sentences.append(_open_end(*witness.open_end, first_ns))
    return tuple(sentences)


def cause_sentences(cause: Cause, *, first_ns: int, object: str | None = None) -> tuple[Sentence, ...]:
    """Return sentences on one cause of a verdict: since when, what decided it, and what would flip it."""
    if cause.witness is not None:
        return sentences_of(cause.witness, first_ns=first_ns)
    instance = f" for {object}" if object is not None else ""
    if cause.settled_ns is not None:
        return (_settled(f"`{cause.spec}`{instance}", cause.verdict, Instant(cause.settled_ns, first_ns)),)
    robustness = number_text(cause.robustness)
    return (Sentence(f"`{cause.spec}`{instance} is {cause.verdict}: robustness {robustness}."),)


def verdict_sentence(
    title: str,
    verdict: Verdict,
    ends: tuple[float, float],
    *,
    certain_since: Instant | None = None,
    least: LeastPart | None = None,
) -> Sentence:
    """Return a sentence on the verdict of a result as a whole.

    Args:
        title: what the result is called.
        ends: of its interval for the finished log.
        certain_since: since when it is certain.
        least: the part that its number is of, if that is another than the first cause.
    """
    since = (", certain since ", certain_since) if certain_since is not None else ()
    of = f" (the least robustness is that of `{least.name}`)" if least is not None else ""
    return Sentence(f"{title} is {verdict}: {_robustness(*ends)}", *since, f"{of}.")


def number_text(number: float) -> str:
    """Return a number with six digits."""
    return f"{number:.{_DIGITS}g}"


def _verdict(witness: Witness, first_ns: int, since_ns: int | None, is_open: bool) -> Sentence:
    numbers = _robustness(witness.lower, witness.upper)
    since = (", since ", Instant(since_ns, first_ns)) if since_ns is not None else ()
    so_far, later = (" so far", "; later samples may change that") if is_open else ("", "")
    return Sentence(f"{_title(witness)} is {witness.verdict}{so_far}: {numbers}", *since, f"{later}.")


def _title(witness: Witness) -> str:
    instance = f" for {witness.object}" if witness.object is not None else ""
    return f"`{witness.path[0].name or witness.path[0].text}`{instance}"


def _robustness(lower: float, upper: float) -> str:
    if math.isnan(lower):
        return "robustness not determined"
    low, high = number_text(lower), number_text(upper)
    return f"robustness {low}" if lower == upper else f"robustness between {low} and {high}"


def _settled(title: str, verdict: Verdict, since: Instant) -> Sentence:
    return Sentence(f"{title} is {verdict} since ", since, ", whatever came after.")


def reason_sentence(witness: Witness, *, first_ns: int) -> Sentence:
    """Return one sentence on what decided a verdict or, for an unknown one, on what was not known."""
    deciding = witness.deciding
    if deciding is None or deciding.unknown or witness.verdict is Verdict.UNKNOWN:
        _, reason, *_ = sentences_of(witness, first_ns=first_ns)
        return reason
    return Sentence(f"`{deciding.text}` ", *_how_it_decides(witness, deciding, first_ns).parts)


def _decision(witness: Witness, deciding: DecidingAtom, first_ns: int) -> Sentence:
    how = _how_it_decides(witness, deciding, first_ns)
    return Sentence(f"What decides is `{deciding.text}`, which ", *how.parts)


def _how_it_decides(witness: Witness, deciding: DecidingAtom, first_ns: int) -> Sentence:
    amount = deciding.value if deciding.lower == deciding.upper else _end(witness, deciding)
    how = f"holds by {number_text(amount)}" if amount >= 0.0 else f"fails by {number_text(-amount)}"
    if amount == 0.0:
        how = "just holds"
    what = " and ".join(map(_measured, deciding.measured))
    where = (
        _in_time_of_all(witness) if witness.path[-1].operator == deciding.atom.relation else _in_time(witness)
    )
    return Sentence(f"{how} at ", Instant(witness.time_ns, first_ns), f"{where}: {what}.")


def _end(witness: Witness, deciding: DecidingAtom) -> float:
    return deciding.lower if deciding.end.value == "low" else deciding.upper


def _in_time(witness: Witness) -> str:
    """Name the temporal operator that chose the sample."""
    for step in reversed(witness.path[:-1]):
        if step.operator in ("F", "G", "U", "R", "W", "X", "WX", "O", "H", "S", "Y"):
            return f" (within `{_shortened(step)}`)"
    return ""


def _in_time_of_all(witness: Witness) -> str:
    """Name it, and say that the atom is greatest or least within it, where that is so."""
    passed: set[str] = set()
    for step in reversed(witness.path[:-1]):
        if step.operator in ("F", "O") and passed <= {"or", "spec"}:
            return f" (its greatest within `{_shortened(step)}`)"
        if step.operator in ("G", "H") and passed <= {"and", "spec"}:
            return f" (its least within `{_shortened(step)}`)"
        if step.operator not in ("and", "or", "spec"):
            break
        passed.add(step.operator)
    return _in_time(witness)


def _shortened(step: WitnessStep) -> str:
    text = step.name or step.text
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1].rstrip()}…"


def _measured(measured: Measured) -> str:
    names, value = measured.names, measured.value
    size = number_text(abs(value))
    match measured.quantity:
        case "signed_distance" if math.isinf(value):
            return f"{names[0]} and {names[1]} are infinitely far apart, since a group is empty"
        case "signed_distance":
            if value == 0.0:
                return f"{names[0]} and {names[1]} touch"
            return f"{names[0]} and {names[1]} " + (
                f"are {size} apart" if value > 0 else f"overlap by {size}"
            )
        case "protrusion":
            if value > 0.0:
                return f"{names[0]} sticks out of {names[1]} by {size}"
            return f"{names[0]} lies {size} inside {names[1]}"
        case "misalignment":
            degrees = math.degrees(math.acos(max(-1.0, min(1.0, 1.0 - value))))
            return f"{names[0]} is turned by {number_text(degrees)}° from {names[1]}"
        case "signal":
            return f"{names[0]} is {number_text(value)}"
    if math.isinf(value):
        return f"no object is in {names[0]}"
    axis = measured.quantity[-1]
    if measured.quantity.startswith("centroid"):
        return f"the centroid of {names[0]} is at {axis} = {number_text(value)}"
    edge = _EDGES.get(measured.quantity, "bottom" if measured.quantity == "min_z" else "top")
    return f"the {edge} edge of {names[0]} is at {axis} = {number_text(value)}"


def _flip(witness: Witness, deciding: DecidingAtom, threshold: Threshold | None) -> str:
    if threshold is None:
        opposite = "violated" if witness.verdict is Verdict.SATISFIED else "satisfied"
        match witness.obstacle:
            case "infinity":
                return f"No number in it makes that {opposite}: it is infinite."
            case "limits":
                return f"No number that can stand in it makes that {opposite}."
        return f"No number of this atom alone makes it {opposite}: other atoms decide it, too."
    change = _change(threshold)
    would = f"It would be {threshold.verdict}"
    if witness.is_settled:
        would = f"It would not have been {witness.verdict} then"
    if threshold.is_written:
        limit = f"{change} in place of {number_text(threshold.value)}"
        return f"{would} with {limit} in `{deciding.text}`."
    margin = change.removeprefix("-").removesuffix(" or less").removesuffix(" or more")
    how = "were allowed to fail by" if threshold.flips_at < 0.0 else "had to hold by"
    return f"{would} if `{deciding.text}` {how} {margin}."


def _change(threshold: Threshold) -> str:
    """Return the numbers that flip a verdict."""
    if threshold.is_exact:
        return f"exactly {threshold.flips_at!r}"
    rises = threshold.flips_at > threshold.value
    if threshold.flips_at == 0.0:
        return "0"
    for limit in (threshold.value, 0.0):
        # a change that is only a rounding error is left out of the number
        if abs(threshold.flips_at - limit) <= 1e-12 * max(abs(threshold.value), 1.0):
            return f"anything {'above' if rises else 'below'} {number_text(limit)}"
    return f"{_rounded(threshold.flips_at, up=rises)} or {'more' if rises else 'less'}"


def _rounded(number: float, *, up: bool) -> str:
    """Return six digits, rounded so that the change is no smaller."""
    rounding = ROUND_CEILING if up else ROUND_FLOOR
    rounded = Context(prec=_DIGITS, rounding=rounding).create_decimal(Decimal(number))
    is_plain = -5 <= rounded.adjusted() < 2 * _DIGITS
    return f"{rounded.normalize():f}" if is_plain else str(rounded.normalize()).lower()


def _unknown(witness: Witness, deciding: DecidingAtom, first_ns: int) -> Sentence:
    reasons = " and ".join(deciding.unknown)
    return Sentence(
        f"`{deciding.text}` is unknown at ",
        Instant(witness.time_ns, first_ns),
        f", where it could decide{_in_time(witness)}: {reasons}.",
    )


def _uncertain(witness: Witness, deciding: DecidingAtom, first_ns: int) -> Sentence:
    low, high = number_text(deciding.lower), number_text(deciding.upper)
    return Sentence(
        f"`{deciding.text}` lies between {low} and {high} at ",
        Instant(witness.time_ns, first_ns),
        f"{_in_time(witness)}: the uncertainty of the objects leaves open whether it holds.",
    )


def _open_end(deciding: DecidingAtom, time_ns: int, first_ns: int) -> Sentence:
    """Name what leaves the robustness open, where the verdict is known."""
    when = Instant(time_ns, first_ns)
    if deciding.unknown:
        reasons = " and ".join(deciding.unknown)
        return Sentence(f"By how much is open: `{deciding.text}` is unknown at ", when, f", {reasons}.")
    low, high = number_text(deciding.lower), number_text(deciding.upper)
    what = f"By how much is uncertain: `{deciding.text}` lies between {low} and {high} at "
    return Sentence(what, when, ".")


_DEAD_ENDS = {
    "X": "the log has no next sample",
    "WX": "the log has no next sample",
    "Y": "there is no sample before",
    "forall": "no object is in its group",
    "exists": "no object is in its group",
}


def _dead_end(step: WitnessStep, first_ns: int) -> Sentence:
    if step.operator in ("true", "false"):
        return Sentence(f"What decides is the constant `{step.text}`.")
    why = _DEAD_ENDS.get(step.operator, "no sample lies in its window")
    return Sentence(f"What decides is `{step.text}` at ", Instant(step.time_ns, first_ns), f": {why}.")
