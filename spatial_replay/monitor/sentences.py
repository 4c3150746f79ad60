"""Explain verdicts: one cause for each named spec that fails in a result, and witnesses in words."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.stream import NEVER
from spatial_replay.monitor.verdict import Verdict, final_verdict
from spatial_replay.monitor.witness.evidence import Gap
from spatial_replay.monitor.witness.path import DecidingAtom, End, Measured, MissedResponse
from spatial_replay.monitor.witness.threshold import RESIDUE, Threshold
from spatial_replay.monitor.witness.witness import Witness, WitnessStep
from spatial_replay.spec.format import format_formula, format_number
from spatial_replay.spec.formula import Atom, Formula, NamedSpec, Number, Scaled, iter_nodes, operator_of
from spatial_replay.spec.walks import declared_unit, iter_parts, per_second
from spatial_replay.text import (
    Instant,
    Sentence,
    interval_text,
    is_text_number,
    names_from_unit,
    number_text,
    plural,
    requirement_text,
    shortened_formula,
    with_unit,
)


@dataclass(frozen=True, slots=True)
class Cause:
    """One reason why a result is violated or unknown.

    Attributes:
        spec: innermost named spec that contains the conjunct.
        node: node id of the conjunct.
        text: canonical text of the conjunct.
        verdict: violated or unknown.
        robustness: robustness of the conjunct on the whole log; NaN if undetermined.
        settled_ns: time at which the violation became certain; None if only the end of the log decided.
        witness: witness of the conjunct on the samples up to `settled_ns`, or on the whole log if
            `settled_ns` is None. The witness is None under the paper's semantics, and if leaves were not
            stored.
        least: witness of `robustness` if it is less than the robustness at `settled_ns`; else None.
        requirement, title: id ("REQ-12") and title of the spec's requirement, or None.
    """

    spec: str
    node: int
    text: str
    verdict: Verdict
    robustness: float
    settled_ns: int | None
    witness: Witness | None
    requirement: str | None = None
    title: str | None = None
    least: Witness | None = None

    @property
    def robustness_witness(self) -> Witness | None:
        """Witness of the conjunct's robustness on the whole log."""
        return self.least or self.witness


@dataclass(frozen=True, slots=True)
class LeastPart:
    """The conjunct of a result that has the least robustness.

    Attributes:
        spec: innermost named spec that contains the conjunct.
        name: the spec's name. If the first cause or the result has the same name, `name` is the conjunct's
            shortened text instead.
        node: node id of the conjunct.
    """

    spec: str
    name: str
    node: int
    robustness: float


@dataclass(frozen=True, slots=True)
class Conjunct:
    """A part of a formula that has to hold for the formula to hold.

    Attributes:
        node: node id of the part.
        spec: innermost named spec that contains the part.
    """

    node: int
    spec: str
    formula: Formula


def conjuncts_of(formula: Formula, name: str, node: int = 0) -> tuple[Conjunct, ...]:
    """Split a formula at its conjunctions, through named specs, in the order of the text.

    Args:
        name: name of the whole formula.
        node: id of the whole formula.
    """
    spec_by_node: dict[int, str] = {}
    conjuncts = []
    for part_id, parent, part in iter_nodes(formula):
        if parent is None:
            spec_by_node[part_id] = name
        elif parent in spec_by_node:
            spec_by_node[part_id] = part.name or spec_by_node[parent]
        else:
            continue
        if operator_of(part) not in ("and", "spec"):
            conjuncts.append(Conjunct(node + part_id, spec_by_node.pop(part_id), part))
    return tuple(conjuncts)


def find_causes(
    conjuncts: Sequence[Conjunct],
    values: Floats,
    final: Floats,
    settled_ns: Integers,
    witnesses: Callable[[int, int | None], tuple[Witness | None, Witness | None]] = lambda *_: (None, None),
    named: Mapping[str, NamedSpec] = MappingProxyType({}),
) -> tuple[Cause, ...]:
    """Return one cause for each named spec with a conjunct that is not satisfied.

    Violations that settled before the end of the log come first, by time. Violations that only the end
    decided follow, the least robustness first. Unknown conjuncts come last.

    Args:
        values: (N,), value of each node on the whole log.
        final: (N, 2), ends of each node's interval on the finished log.
        settled_ns: (N, 2), see `InstanceStream`.
        witnesses: function of a node id and its settling time. It returns the deciding witness, and the
            witness of a later and lower robustness.
        named: specs by name.
    """
    failing_conjuncts = [
        conjunct for conjunct in conjuncts if _verdict(final, conjunct.node) is not Verdict.SATISFIED
    ]
    first_by_spec: dict[str, Conjunct] = {}
    for conjunct in sorted(
        failing_conjuncts, key=lambda conjunct: _order(conjunct.node, values, final, settled_ns)
    ):
        # the first conjunct of a spec in this order is the spec's cause
        first_by_spec.setdefault(conjunct.spec, conjunct)
    causes = []
    for conjunct in first_by_spec.values():
        settled_at_ns = settled_time(settled_ns, conjunct.node)
        spec = named.get(conjunct.spec)
        witness, least_witness = witnesses(conjunct.node, settled_at_ns)
        causes.append(
            Cause(
                conjunct.spec,
                conjunct.node,
                format_formula(conjunct.formula),
                _verdict(final, conjunct.node),
                float(values[conjunct.node]),
                settled_at_ns,
                witness,
                None if spec is None else spec.id,
                None if spec is None else spec.title,
                least_witness,
            )
        )
    return tuple(causes)


def find_least(
    conjuncts: Sequence[Conjunct], values: Floats, final: Floats, first: Cause, whole: str
) -> LeastPart | None:
    """Return the conjunct with the least robustness; None if the first cause has the same conjunct.

    Args:
        whole: name of the whole formula.
    """
    least_conjunct = min(conjuncts, key=lambda each: _number(each.node, values, final))
    robustness = _number(least_conjunct.node, values, final)
    if least_conjunct.node == first.node or not robustness < _number(first.node, values, final):
        return None
    has_own_name = least_conjunct.spec not in (first.spec, whole)
    name = least_conjunct.spec if has_own_name else shortened_formula(format_formula(least_conjunct.formula))
    return LeastPart(least_conjunct.spec, name, least_conjunct.node, robustness)


def settled_time(settled_ns: Integers, node: int) -> int | None:
    """Return the time at which the violation of a node became certain, or None."""
    time_ns = int(settled_ns[node, 1])
    return None if time_ns == NEVER else time_ns


def _verdict(final: Floats, node: int) -> Verdict:
    return final_verdict(*final[node].tolist())


def _number(node: int, values: Floats, final: Floats) -> float:
    value = float(values[node])
    # an undetermined value is compared by its upper end
    return float(final[node, 1]) if math.isnan(value) else value


def _order(node: int, values: Floats, final: Floats, settled_ns: Integers) -> tuple[int, float, int]:
    if _verdict(final, node) is not Verdict.VIOLATED:
        return 2, 0.0, node
    settled_at_ns = settled_time(settled_ns, node)
    return (1, _number(node, values, final), node) if settled_at_ns is None else (0, settled_at_ns, node)


_ENDED = ", for the log has ended"
_ENDS = {
    "min_x": "left edge",
    "max_x": "right edge",
    "min_y": "lower edge",
    "max_y": "upper edge",
    "min_z": "bottom edge",
    "max_z": "top edge",
    **dict.fromkeys(("centroid_min_x", "centroid_max_x", "centroid_min_y", "centroid_max_y"), "centroid"),
}
"""Names of coordinates in sentences; other quantities keep their own names."""


def sentences_of(
    witness: Witness,
    *,
    first_ns: int,
    requirement: str = "",
    is_open: bool = False,
    has_ended: bool = False,
    least: Witness | None = None,
) -> tuple[Sentence, ...]:
    """Return sentences on a node's verdict: the deciding atom, and the change that flips the verdict.

    Args:
        first_ns: reference time of the sentences.
        requirement: requirement of the node's spec in words (see `requirement_text`).
        is_open: whether the verdict is pending, so that later samples decide it.
        has_ended: whether the end of the log turned a pending verdict into a violation.
        least: witness of a lower robustness after a violation had settled.
    """
    title = f"`{witness.path[0].name or shortened_formula(witness.path[0].text)}`"
    title += f" for {witness.object}" if witness.object is not None else ""
    title += f" ({requirement})" if requirement else ""
    robustness_text = _robustness(witness.lower, witness.upper, witness.unit)
    if witness.settled_ns is not None:
        sentences = [_permanence_sentence(title, witness.verdict, Instant(witness.settled_ns, first_ns))]
    elif is_open:
        sentences = [Sentence(f"{title} is pending: {robustness_text} so far, and later samples decide.")]
    else:
        sentences = [
            Sentence(f"{title} is {witness.verdict}{_ENDED if has_ended else ''}: {robustness_text}.")
        ]
    flipping_witness, witness = witness, least or witness
    if witness.missed is not None and not is_open:
        sentences += missed_sentences(witness, witness.missed, first_ns)
    if witness.deciding is None:
        sentences.append(_dead_end(witness.path[-1], first_ns))
    elif witness.deciding.unknown:
        sentences.append(_unknown_sentence(witness, witness.deciding, first_ns))
        sentences += [gap_sentence(gap, first_ns) for gap in witness.gaps]
        if (presence := witness.while_present) is not None:
            verb = "is" if len(presence.names) == 1 else "are"
            clause = f"Asked only while {' and '.join(presence.names)} {verb} in the samples"
            sentences.append(Sentence(f"{clause}, it is {presence.verdict}: write `{presence.text}`."))
    elif witness.verdict is Verdict.UNKNOWN:
        sentences.append(_uncertain_sentence(witness, witness.deciding, first_ns))
    else:
        subject = "What counts so far" if is_open else "What decides"
        outcome = _how_it_decides(witness, witness.deciding, first_ns, is_open=is_open)
        if witness.missed is None or not witness.missed.is_condition or is_open:
            sentences.append(Sentence(f"{subject} is `{witness.deciding.text}`, which ", outcome))
        if least is not None:
            sentences.append(_first_failure(flipping_witness, first_ns))
        if flipping_witness.closest is not None and flipping_witness.closest_threshold is not None:
            flip_text = _flip(
                flipping_witness, flipping_witness.closest[0], flipping_witness.closest_threshold
            )
            sentences.append(Sentence(flip_text))
        elif flipping_witness.deciding is not None and flipping_witness.obstacle != "infinity":
            flip_text = _flip(
                flipping_witness, flipping_witness.deciding, flipping_witness.threshold, is_open=is_open
            )
            sentences.append(Sentence(flip_text))
    if witness.open_end is not None:
        sentences.append(_open_end(*witness.open_end, first_ns, witness.units))
    return tuple(sentences)


def cause_sentences(cause: Cause, *, first_ns: int, object: str | None = None) -> tuple[Sentence, ...]:
    """Return sentences on a cause: its time, its deciding atom, and the change that flips the verdict."""
    requirement = requirement_text(cause.requirement, cause.title)
    if cause.witness is not None:
        has_ended = cause.settled_ns is None and cause.verdict is Verdict.VIOLATED
        return sentences_of(
            cause.witness, first_ns=first_ns, requirement=requirement, has_ended=has_ended, least=cause.least
        )
    instance_text = f" for {object}" if object is not None else ""
    instance_text += f" ({requirement})" if requirement else ""
    if cause.settled_ns is not None:
        return (
            _permanence_sentence(
                f"`{cause.spec}`{instance_text}", cause.verdict, Instant(cause.settled_ns, first_ns)
            ),
        )
    robustness_text = number_text(cause.robustness)
    return (Sentence(f"`{cause.spec}`{instance_text} is {cause.verdict}: robustness {robustness_text}."),)


def verdict_sentence(
    title: str,
    verdict: Verdict,
    ends: tuple[float, float],
    *,
    unit: str = "",
    certain_since: Instant | None = None,
    has_ended: bool = False,
    least: LeastPart | None = None,
    least_at: Instant | None = None,
) -> Sentence:
    """Return a sentence on the verdict of a result as a whole.

    Args:
        title: name of the result.
        ends: ends of the robustness interval on the finished log.
        unit: declared unit of the robustness, or "".
        certain_since: time at which the verdict became certain.
        has_ended: whether the end of the log turned a pending verdict into a violation.
        least: conjunct with the least robustness, if it differs from the first cause's conjunct.
        least_at: time of the first cause's least robustness, if the cause had settled earlier.
    """
    since_parts = (", certain since ", certain_since) if certain_since is not None else ()
    part_text = f" (the least robustness is that of `{least.name}`)" if least is not None else ""
    # times are compared as texts, because the sentence should not show the same time twice
    is_later = least_at is not None and str(least_at) != str(certain_since)
    least_parts = (", least at ", least_at) if least_at is not None and is_later else ()
    verdict_words = f"{verdict}{_ENDED if has_ended else ''}"
    return Sentence(
        f"{title} is {verdict_words}: {_robustness(*ends, unit)}", *since_parts, *least_parts, f"{part_text}."
    )


_TESTED = {"nothing": ", tested by nothing", "cut": ", cut by the end of the log"}


def verdict_text(
    verdict: Verdict,
    numbers: tuple[float, float, float],
    unit: str,
    tested: str = "full",
    *,
    is_doubtful: bool = False,
) -> str:
    """Return a verdict with its robustness for a log's metadata: "violated, robustness -0.03 m".

    Args:
        numbers: robustness, lower end and upper end of its interval.
    """
    doubtful_text = ", doubtful" if is_doubtful else ""
    robustness_text = interval_text(*numbers, unit)
    return f"{verdict}{_TESTED.get(tested, '')}{doubtful_text}, robustness {robustness_text}"


def divisor_of(atom: Formula) -> float:
    """Return the divisor of an atom with `scale`; 1 for other formulas."""
    expression = atom.expression if isinstance(atom, Atom) else None
    return expression.divisor if isinstance(expression, Scaled) else 1.0


def amount_text(number: float, atom: Formula, units: Mapping[str, str] = MappingProxyType({})) -> str:
    """Return a number of an atom in the unit of the log; with `scale`, also the scaled number.

    Args:
        units: declared units (see `declared_unit`).
    """
    divisor, number = divisor_of(atom), without_residue(number, atom)
    amount = with_unit(number * divisor, declared_unit(atom, units, is_scaled=False))
    if divisor == 1.0:
        return amount
    return f"{amount} ({number_text(number)} on its scale of {format_number(divisor)})"


def how_text(
    number: float, atom: Formula, units: Mapping[str, str], *, past: bool = False, is_violated: bool = False
) -> str:
    """Return how well an atom holds, as in "fails by 3.2".

    Args:
        number: robustness of the atom.
        units: declared units (see `declared_unit`).
        past: whether the text is in the past tense.
        is_violated: whether the atom decides a violation. If such an atom holds, the text begins with
            "must not hold".
    """
    outcome = ("held" if past else "holds") if number >= 0.0 else ("failed" if past else "fails")
    unwanted_text = "must not hold, and " if is_violated and number >= 0.0 else ""
    if not without_residue(number, atom):
        return f"{unwanted_text}{outcome} by rounding" if number else f"{unwanted_text}just {outcome}"
    amount_clause = f" by {amount_text(abs(number), atom, units)}" if math.isfinite(number) else ""
    return f"{unwanted_text}{outcome}{amount_clause}"


def uncertain_text(least: str) -> str:
    """Return the clause with the least possible amount of an uncertain number."""
    return f", at least {least} with what is uncertain"


def without_residue(number: float, atom: Formula) -> float:
    """Return a number of an atom, or 0 if it is within rounding error."""
    # rounding errors grow with the numbers of the atom
    limits = [abs(part.value) for part in iter_parts(atom) if isinstance(part, Number)]
    limits = [limit for limit in limits if math.isfinite(limit)]
    scale = max(limits, default=0.0) or 1.0
    return 0.0 if abs(number * divisor_of(atom)) <= RESIDUE * scale else number


def _robustness(lower: float, upper: float, unit: str) -> str:
    if math.isnan(lower):
        return "robustness not determined"
    low_text, high_text = with_unit(lower, unit), with_unit(upper, unit)
    return f"robustness {low_text}" if lower == upper else f"robustness between {low_text} and {high_text}"


def _permanence_sentence(title: str, verdict: Verdict, since: Instant) -> Sentence:
    return Sentence(f"{title} is permanently {verdict} from ", since, " on.")


def reason_sentence(witness: Witness, *, first_ns: int) -> Sentence:
    """Return the reason of a verdict: the deciding atom or, for an unknown verdict, the unknown values."""
    deciding = witness.deciding
    response_sentences = () if witness.missed is None else missed_sentences(witness, witness.missed, first_ns)
    if deciding is None or deciding.unknown or witness.verdict is Verdict.UNKNOWN:
        return _join(
            *response_sentences, sentences_of(witness, first_ns=first_ns)[1 + len(response_sentences)]
        )
    if witness.missed is not None and witness.missed.is_condition:
        # the margin of a condition that held does not explain the violation
        return _join(*response_sentences)
    outcome = _how_it_decides(witness, deciding, first_ns)
    if witness.missed is not None and witness.missed.response == deciding.text:
        return Sentence(_missed_clause(witness.missed, first_ns), ": it ", outcome)
    return _join(*response_sentences, Sentence(f"`{deciding.text}` ", outcome))


def _join(first: Sentence, *others: Sentence) -> Sentence:
    return Sentence(first, *(part for sentence in others for part in (" ", sentence)))


def cause_reason(cause: Cause, first_ns: int) -> Sentence:
    """Return sentences on a cause's robustness and, if it fell after settling, on the first violation.

    The result is "" without a witness.
    """
    if cause.robustness_witness is None:
        return Sentence("")
    reason = reason_sentence(cause.robustness_witness, first_ns=first_ns)
    if cause.least is None or cause.witness is None:
        return reason
    return Sentence(reason, " ", _first_failure(cause.witness, first_ns))


def _first_failure(settled: Witness, first_ns: int) -> Sentence:
    """Return a sentence on the sample that settled a violation, for a violation that grew later."""
    amount, deciding = with_unit(abs(settled.upper), settled.unit), settled.deciding
    if deciding is not None and math.isfinite(deciding.value):
        amount = amount_text(abs(deciding.value), deciding.atom, settled.units)
        amount = amount if without_residue(deciding.value, deciding.atom) else "rounding"
    return Sentence(
        "It was violated first at ", Instant(settled.settled_ns or 0, first_ns), f", by {amount}."
    )


def missed_sentences(witness: Witness, missed: MissedResponse, first_ns: int) -> tuple[Sentence, ...]:
    """Return sentences on a missed response: the response, its closest atom, and the condition's atom."""
    clause = _missed_clause(missed, first_ns)
    deciding, closest_sentences = witness.deciding, []
    if witness.closest is not None:
        closest_atom, closest_ns = witness.closest
        measurement = measurement_clause(closest_atom, witness.units, first_ns)
        # if the response itself is the closest atom, one sentence suffices
        if (closest_atom.text, closest_ns) == (missed.response, missed.time_ns):
            clause = Sentence(clause, ": ", measurement)
        else:
            instant = Instant(closest_ns, first_ns)
            closest_sentences = [
                Sentence(f"`{closest_atom.text}` came closest at ", instant, ": ", measurement, ".")
            ]
    sentences = [Sentence(clause, "."), *closest_sentences]
    if missed.is_condition and deciding is not None and not deciding.unknown:
        measurement = measurement_clause(deciding, witness.units, first_ns)
        # an operator such as `Y` measures in another sample
        time_parts = () if witness.time_ns == missed.time_ns else (" at ", Instant(witness.time_ns, first_ns))
        sentences.append(Sentence("The condition held: ", measurement, *time_parts, "."))
    return tuple(sentences)


def _missed_clause(missed: MissedResponse, first_ns: int) -> Sentence:
    instant = Instant(missed.time_ns, first_ns)
    clause = f"`{missed.response}` did not hold at "
    return Sentence(clause, instant, f", when its condition `{missed.condition}` held")


def _how_it_decides(
    witness: Witness, deciding: DecidingAtom, first_ns: int, *, is_open: bool = False
) -> Sentence:
    amount, deciding_end = deciding.value, _end(deciding)
    # with uncertainty, the deciding end may have another sign than the value
    if math.isnan(amount) or (amount >= 0.0) != (deciding_end >= 0.0):
        amount = deciding_end
    is_violated = witness.verdict is Verdict.VIOLATED and not is_open
    outcome = how_text(amount, deciding.atom, witness.units, is_violated=is_violated)
    if abs(deciding_end) < abs(amount) and without_residue(amount, deciding.atom):
        outcome += uncertain_text(amount_text(abs(deciding_end), deciding.atom, witness.units))
    window_text = _in_time(witness)
    if witness.path[-1].operator == deciding.atom.relation:
        window_text = _in_time_of_all(witness, deciding, "so far " if is_open else "")
    measurement = measurement_clause(deciding, witness.units, first_ns)
    return Sentence(
        f"{outcome} at ", Instant(witness.time_ns, first_ns), f"{window_text}: ", measurement, "."
    )


def measurement_clause(deciding: DecidingAtom, units: Mapping[str, str], first_ns: int) -> Sentence:
    """Return a clause on the measurements of an atom, without a full stop."""
    if any(is_text_number(number.value) for number in deciding.measured):
        signal, comparison, text = deciding.atom.parameters
        is_equal = (deciding.value > 0.0) == (comparison == "==")
        return Sentence(f"{signal} is {text if is_equal else 'another text'}")
    clauses: list[str | Instant] = []
    for measured in deciding.measured:
        is_rate = measured.reports_ns is not None and measured.value != 0.0
        clause = _change(measured, units, first_ns) if is_rate else _measurement_text(measured, units)
        clauses += [" and ", clause]
    return Sentence(*clauses[1:])


def _change(measured: Measured, units: Mapping[str, str], first_ns: int) -> Sentence:
    """Return a clause on a change between two reports, with its amount and rate."""
    before_ns, now_ns = measured.reports_ns or (0, 0)
    names, signal_name = measured.names, measured.names[0] if measured.quantity == "rate" else ""
    change_text = with_unit(abs(measured.value) * (now_ns - before_ns) / 1e9, units.get(signal_name, ""))
    rate_text = with_unit(abs(measured.value), per_second(units.get(signal_name, "")) or "a second")
    motion = f"{names[0]} moved"
    if signal_name:
        motion = f"{signal_name} {'rose' if measured.value > 0.0 else 'fell'}"
    elif len(names) == 2:
        motion = f"{names[0]} and {names[1]} {'approached' if measured.value > 0.0 else 'parted'}"
    time_parts = Instant(before_ns, first_ns), " to ", Instant(now_ns, first_ns)
    return Sentence(
        f"{motion} by {change_text} from ", *time_parts, f", {'by' if signal_name else 'at'} {rate_text}"
    )


def _end(deciding: DecidingAtom) -> float:
    return deciding.lower if deciding.end.value == "low" else deciding.upper


def _in_time(witness: Witness) -> str:
    """Return the innermost temporal operator of the path in parentheses; "" without such an operator."""
    for step_index, step in reversed(list(enumerate(witness.path[:-1]))):
        if step.operator in ("F", "G", "U", "R", "W", "X", "WX", "O", "H", "S", "Y"):
            return f" (within `{_step_title(witness, step_index)}`)"
    return ""


def _step_title(witness: Witness, step_index: int) -> str:
    """Return the name or the text of a step. A long text is replaced by the innermost name around it."""
    step = witness.path[step_index]
    names = [node.name for node in witness.path[: step_index + 1] if node.name]
    if step.name or shortened_formula(step.text) == step.text or not names:
        return step.name or shortened_formula(step.text)
    return names[-1]


def _in_time_of_all(witness: Witness, deciding: DecidingAtom, so_far: str) -> str:
    """Return the operator in whose window an atom is greatest or least, in parentheses.

    Without such an operator, the result is that of `_in_time`: the innermost temporal operator.
    """
    passed_operators: set[str] = set()
    # one sample may settle a failing G or a holding F, and later samples may be more extreme
    unsure_operator = {End.HIGH: "G", End.LOW: "F"}.get(deciding.end) if witness.is_settled else None
    for step_index, step in reversed(list(enumerate(witness.path[:-1]))):
        if step.operator == unsure_operator:
            break
        window_text = f"{so_far}within `{_step_title(witness, step_index)}`"
        if step.operator in ("F", "O") and passed_operators <= {"or", "spec"}:
            return f" (its greatest {window_text})"
        if step.operator in ("G", "H") and passed_operators <= {"and", "spec"}:
            return f" (its least {window_text})"
        if step.operator not in ("and", "or", "spec"):
            break
        passed_operators.add(step.operator)
    return _in_time(witness)


def _measurement_text(measured: Measured, units: Mapping[str, str]) -> str:
    names, value, length_unit = measured.names, measured.value, units.get("", "")
    size_text = with_unit(abs(value), length_unit)
    match measured.quantity:
        case "signed_distance" if math.isinf(value):
            return f"{names[0]} and {names[1]} are infinitely far apart, since a group is empty"
        case "signed_distance":
            if value == 0.0:
                return f"{names[0]} and {names[1]} touch"
            return f"{names[0]} and {names[1]} " + (
                f"are {size_text} apart" if value > 0 else f"overlap by {size_text}"
            )
        case "protrusion":
            if value > 0.0:
                return f"{names[0]} sticks out of {names[1]} by {size_text}"
            return f"{names[0]} lies {size_text} inside {names[1]}"
        case "misalignment":
            # misalignment is 1 minus the cosine of the angle
            degrees = math.degrees(math.acos(max(-1.0, min(1.0, 1.0 - value))))
            return f"{names[0]} is turned by {number_text(degrees)}° from {names[1]}"
        case "present":
            return f"{names[0]} is {'' if value else 'not '}in the sample"
        case "speed" | "rate":
            signal_name = names[0] if measured.quantity == "rate" else ""
            size_text = with_unit(abs(value), per_second(units.get(signal_name, "")))
            if len(names) == 2:
                return f"{names[0]} and {names[1]} {'approach' if value > 0.0 else 'part'} at {size_text}"
            if value == 0.0:
                return f"{names[0]} {'does not change' if signal_name else 'stands still'}"
            return f"{names[0]} " + (
                f"{'rises' if value > 0.0 else 'falls'} by {size_text}"
                if signal_name
                else f"moves at {size_text}"
            )
        case "signal":
            unit = units.get(names[0], "")
            number_by_name = names_from_unit(unit)
            lack_text = (
                ", which has no name" if number_by_name and value not in number_by_name.values() else ""
            )
            return f"{names[0]} is {with_unit(value, unit)}{lack_text}"
    if math.isinf(value):
        return f"no object is in {' or in '.join(names)}"
    edge = _ENDS.get(measured.quantity)
    if edge is None:
        quantity = measured.quantity.replace("_", " ")
        return f"the {quantity} of {' and '.join(names)} is {with_unit(value, length_unit)}"
    return f"the {edge} of {names[0]} is at {measured.quantity[-1]} = {with_unit(value, length_unit)}"


def _flip(
    witness: Witness, deciding: DecidingAtom, threshold: Threshold | None, *, is_open: bool = False
) -> str:
    if threshold is None:
        opposite = "violated" if witness.verdict is Verdict.SATISFIED else "satisfied"
        match witness.obstacle:
            case "limits" if "==" in deciding.atom.parameters:
                advice = "compare with a band, such as 0.9 <= a dist b <= 1.1"
                return f"No number in it makes that {opposite}: its robustness is never above 0; {advice}."
            case "limits":
                return f"No number that can stand in it makes that {opposite}."
            case "unknown":
                return f"No number in it makes that {opposite}: samples that are unknown decide, too."
        return f"No number in `{deciding.text}` alone makes it {opposite}: other atoms decide it, too."
    would_text = f"It would be {threshold.verdict}"
    if is_open:
        would_text = f"So far it would {'fail' if witness.verdict is Verdict.SATISFIED else 'hold'}"
    elif threshold.verdict is Verdict.UNKNOWN:
        would_text = "It would not have been violated then"
    if _is_overlap(deciding, threshold):
        place_text = _place(deciding, threshold)
        return f"No distance {place_text} makes it {threshold.verdict}: the objects touch or overlap."
    if threshold.is_written:
        is_idle = deciding is witness.deciding and witness.missed is not None and witness.missed.is_condition
        reason = ", as the condition would not hold there" if is_idle else ""
        return f"{would_text} with {_limit(threshold)} {_place(deciding, threshold)}{reason}."
    if threshold.replacement:
        return f"{would_text} with `{threshold.replacement}` instead of `{deciding.text}`."
    unit = declared_unit(deciding.atom, witness.units, is_scaled=False)
    margin_text = with_unit(abs(threshold.flips_at), unit)
    direction = "more" if threshold.flips_at < 0.0 else "less"
    return f"{would_text} in a log in which `{deciding.text}` holds by {margin_text} {direction}."


def _is_overlap(deciding: DecidingAtom, threshold: Threshold) -> bool:
    """Return whether only a negative distance, which is a depth of overlap, would flip a verdict."""
    is_distance = deciding.atom.relation in ("dist", "closeto", "farfrom") and threshold.is_written
    is_settled = threshold.verdict is not Verdict.UNKNOWN
    return is_distance and is_settled and threshold.flips_at < 0.0 <= threshold.value


def _limit(threshold: Threshold) -> str:
    """Return a phrase on the numbers that flip a verdict when they replace the written number."""
    flip_text, written_text = format_number(threshold.flips_at), format_number(threshold.value)
    is_more = threshold.flips_at > threshold.value
    if threshold.is_exact:
        return f"exactly {flip_text} instead of {written_text}"
    if abs(threshold.flips_at - threshold.value) <= RESIDUE * max(abs(threshold.value), 1.0):
        return f"any number {'above' if is_more else 'below'} {written_text}"
    return f"{flip_text} {'or more' if is_more else 'or less'} instead of {written_text}"


def _place(deciding: DecidingAtom, threshold: Threshold) -> str:
    """Return a phrase that names the constant or the atom with the written number."""
    return f"for `{threshold.constant}`" if threshold.constant else f"in `{deciding.text}`"


def _unknown_sentence(witness: Witness, deciding: DecidingAtom, first_ns: int) -> Sentence:
    reasons = " and ".join(deciding.unknown)
    return Sentence(
        f"`{deciding.text}` is unknown at ",
        Instant(witness.time_ns, first_ns),
        f", where it could decide{_in_time(witness)}: {reasons}.",
    )


def gap_sentence(gap: Gap, first_ns: int) -> Sentence:
    """Return a sentence on the missing samples of an object or signal, or on a pause of the samples.

    The sentence names the replay options that leave out the missing samples, if such options exist.
    """
    begin_ns, end_ns = gap.longest_ns
    length_text = f" ({(end_ns - begin_ns) / 1e9:.3f} s)"
    if gap.name is None:
        lost_text = "the connection was lost, or topics were silent"
        if not gap.is_filled and end_ns - begin_ns < 10**6:
            return Sentence("Everything is unknown at ", Instant(begin_ns, first_ns), f": {lost_text}.")
        place_parts = (Instant(begin_ns, first_ns), " to ", Instant(end_ns, first_ns), length_text)
        last_ns = end_ns - 1 if gap.is_filled else begin_ns
        elsewhere = "" if (gap.first_ns, gap.last_ns) == (begin_ns, last_ns) else ", and at other times"
        reason = "`max_gap` makes that unknown" if gap.is_filled else lost_text
        return Sentence("The samples pause from ", *place_parts, f"{elsewhere}: {reason}.")
    if gap.missing == gap.samples:
        return Sentence(f"{gap.name} is missing in every sample.")
    count_text = f"{gap.name} is missing in {gap.missing:,} of {plural(gap.samples, 'sample')}"
    if gap.window is not None:
        window_parts: list[str | Instant] = []
        options = []
        for word, option, at_ns in zip(("before ", "from "), ("--from", "--to"), gap.window, strict=True):
            if at_ns is not None:
                window_parts += [" or " if window_parts else "", word, Instant(at_ns, first_ns)]
                # the time is rounded down to milliseconds, so that the option does not leave the sample out
                options.append(f"{option} {(at_ns - first_ns) // 10**6 / 1e3:.3f}s")
        onwards = " on" if gap.window[1] is not None else ""
        return Sentence(
            f"{count_text}, all ", *window_parts, f"{onwards}: {' '.join(options)} leaves them out."
        )
    if gap.first_ns == gap.last_ns:
        return Sentence(f"{count_text}, at ", Instant(begin_ns, first_ns), ".")
    extent = "all" if begin_ns <= gap.first_ns and gap.last_ns <= end_ns else "the longest time"
    begin_time, end_time = Instant(begin_ns, first_ns), Instant(end_ns, first_ns)
    return Sentence(f"{count_text}, {extent} from ", begin_time, " to ", end_time, f"{length_text}.")


def open_text(witness: Witness) -> str:
    """Return the bounds of the atom whose uncertainty leaves a verdict open; "" for other verdicts."""
    deciding = witness.deciding
    if witness.verdict is not Verdict.UNKNOWN or deciding is None or deciding.unknown:
        return ""
    return _between(deciding, witness.units)


def _between(deciding: DecidingAtom, units: Mapping[str, str]) -> str:
    low_text, high_text = (amount_text(end, deciding.atom, units) for end in (deciding.lower, deciding.upper))
    return f"between {low_text} and {high_text}"


def _uncertain_sentence(witness: Witness, deciding: DecidingAtom, first_ns: int) -> Sentence:
    return Sentence(
        f"The robustness of `{deciding.text}` lies {_between(deciding, witness.units)} at ",
        Instant(witness.time_ns, first_ns),
        f"{_in_time(witness)}: the uncertainty of the objects leaves open whether it holds.",
    )


def _open_end(deciding: DecidingAtom, time_ns: int, first_ns: int, units: Mapping[str, str]) -> Sentence:
    """Return a sentence on the atom that leaves the robustness open, for a known verdict."""
    instant = Instant(time_ns, first_ns)
    if deciding.unknown:
        reasons = " and ".join(deciding.unknown)
        return Sentence(f"By how much is open: `{deciding.text}` is unknown at ", instant, f", {reasons}.")
    limits_text = _between(deciding, units)
    clause = f"By how much is uncertain: the robustness of `{deciding.text}` lies {limits_text} at "
    return Sentence(clause, instant, ".")


_DEAD_ENDS = {
    "X": "the log has no next sample",
    "WX": "the log has no next sample",
    "Y": "there is no sample before",
    "forall": "no object is in its group",
    "exists": "no object is in its group",
}


def _dead_end(step: WitnessStep, first_ns: int) -> Sentence:
    text = shortened_formula(step.text)
    if step.operator in ("true", "false"):
        return Sentence(f"What decides is the constant `{text}`.")
    reason = _DEAD_ENDS.get(step.operator, "no sample lies in its window")
    if step.leaves_out:
        member = "object in its group" if step.operator in ("forall", "exists") else "sample in its window"
        reason = f"no {member} has a rate"
    return Sentence(f"What decides is `{text}` at ", Instant(step.time_ns, first_ns), f": {reason}.")
