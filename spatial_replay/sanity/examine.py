"""Faults that are found without a run: a specification cannot be satisfied, or checks nothing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Literal, TypeAlias

from spatial_replay.errors import NoAutomatonError, SpecificationError
from spatial_replay.lazy import Printed
from spatial_replay.monitor.atoms.terms import seam_texts
from spatial_replay.sanity.conditions import FactDiagrams, is_solid, members
from spatial_replay.sanity.examples import Example, shortest_example
from spatial_replay.sanity.shortest_words import (
    Answer,
    Runs,
    Side,
    SpecReading,
    UndecidedError,
    Word,
    WordSearch,
    automaton_of,
    joint,
    loosen,
    reading_of,
)
from spatial_replay.spec.diagnostics import Diagnostic, SourceText, Span
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import (
    Atom,
    Boolean,
    Formula,
    NamedSpec,
    Quantified,
    Specification,
    Temporal,
    iter_nodes,
)
from spatial_replay.spec.load import require_specification
from spatial_replay.spec.walks import is_spatial, iter_formulas, looks_back, other_names, signals_in, terms_of
from spatial_replay.text import json_fields, named_arguments, number_text, plural, shortened_formula

MAX_PAIRS: Final = 300
"""Maximum number of compared pairs of specs."""

MAX_ANTECEDENTS: Final = 40
"""Maximum number of examined antecedents of one spec."""

_SHOWN: Final = 3
"""Maximum number of exclusions in one sentence."""

Kind: TypeAlias = Literal["unsatisfiable", "always true", "idle antecedent", "implied", "contradiction"]


_ENDS: Final[Mapping[str, str]] = MappingProxyType({"unsatisfiable": "satisfied", "always true": "violated"})
"""Impossible verdict by kind of finding."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One fault of a specification.

    Attributes:
        kind: kind of the fault.
        specs: names of the affected specs; for "implied", the implied spec, then the implying spec.
        reason: cause of the fault: "by logic alone", or relations that geometry excludes.
        exclusions: relations that exclude each other in one sample and so cause the fault.
        diagnostic: warning with the place of the fault.
    """

    kind: Kind
    specs: tuple[str, ...]
    reason: str
    exclusions: tuple[tuple[str, ...], ...]
    diagnostic: Diagnostic


@dataclass(frozen=True, slots=True)
class SpecExamination:
    """Examination of one result of a specification.

    Attributes:
        name: name of the spec.
        reason: reason why the spec has no automaton, so that only a looser reading was examined; ""
            with an automaton.
        undecided: undecided questions as sentences.
        unrelated: formulas without laws of geometry, which may hold or fail independently of other formulas:
            quantifiers over open groups, relations to earlier samples.
        satisfied, violated: shortest run with that verdict; None if no such run exists or was found.
    """

    name: str
    reason: str
    undecided: tuple[str, ...]
    unrelated: tuple[str, ...]
    satisfied: Example | None = None
    violated: Example | None = None


@dataclass(frozen=True)
class Examination(Printed):
    """Faults of a specification, and example runs of its specs.

    Attributes:
        findings: faults in text order.
        specs: one examination for each result.
        notes: sentences about skipped checks, and about regions that objects cannot cross.
    """

    findings: tuple[Finding, ...]
    specs: tuple[SpecExamination, ...]
    notes: tuple[str, ...] = ()

    def lines(self, files: Mapping[tuple[str, str], Path] = MappingProxyType({})) -> Iterator[str]:
        """Yield the findings and the shortest runs of each spec as lines of text.

        Args:
            files: files of the runs by spec and verdict.
        """
        for finding in self.findings:
            yield from str(finding.diagnostic).split("\n")
        if self.findings:
            yield ""
        impossible_verdicts = {
            (finding.specs[0], _ENDS[finding.kind]) for finding in self.findings if finding.kind in _ENDS
        }
        for spec in self.specs:
            yield spec.name
            yield from (f"  {line}" for line in _remarks(spec))
            for verdict, example in (("satisfied", spec.satisfied), ("violated", spec.violated)):
                if (spec.name, verdict) in impossible_verdicts:
                    yield f"  {verdict} by no run"
                elif example is not None:
                    yield from (f"  {line}" for line in _example(example, files.get((spec.name, verdict))))
                elif spec.reason:
                    reason = "without an automaton runs are guesses, and none was confirmed"
                    yield f"  {verdict}: no run is shown, since {reason}"
            yield ""
        yield from self.notes
        if self.findings:
            yield f"{plural(len(self.findings), 'finding')} in {plural(len(self.specs), 'result')}"
        else:
            is_complete = not any(spec.reason or spec.undecided for spec in self.specs)
            yield "nothing found" if is_complete else "nothing found in what could be decided"

    @property
    def document(self) -> dict[str, Any]:
        """The findings and examples as values for JSON."""
        return {
            "findings": [_finding(finding) for finding in self.findings],
            "specifications": [
                {
                    **json_fields(spec, "name", "reason", "undecided"),
                    "automaton": not spec.reason,
                    "by_logic_alone": spec.unrelated,
                    "satisfied": example_document(spec.satisfied),
                    "violated": example_document(spec.violated),
                }
                for spec in self.specs
            ],
            "notes": self.notes,
        }


def _remarks(spec: SpecExamination) -> Iterator[str]:
    """Yield sentences about the limits of an examination."""
    if spec.reason:
        yield f"no automaton: {spec.reason}"
        yield "  examined with its bounds and past operators read loosely: what that excludes is excluded"
    for question in spec.undecided:
        yield f"not decided: {question}"
    for text in spec.unrelated:
        yield f"decided by logic alone, since geometry says nothing about it: {text}"


def _example(example: Example, file: Path | None) -> Iterator[str]:
    length_text = plural(len(example.sentences), "sample")
    if example.robustness is None:
        yield f"{example.verdict} by {length_text}, in words only: {example.note}"
    else:
        file_suffix = "" if file is None else f": {file}"
        yield f"{example.verdict} by {length_text}, robustness {number_text(example.robustness)}{file_suffix}"
    for sample_number, sentence in enumerate(example.sentences):
        yield f"  {sample_number}  {sentence}"


def _finding(finding: Finding) -> dict[str, Any]:
    return {
        **json_fields(finding, "kind", "reason", "exclusions"),
        "specifications": finding.specs,
        **json_fields(finding.diagnostic, "message", "hint", "line", "column"),
    }


def example_document(example: Example | None) -> dict[str, Any] | None:
    """Return an example run as values for JSON; None without a run."""
    if example is None:
        return None
    fields = json_fields(example, "robustness", "note")
    return {"samples": example.sentences, "tracks": example.rows, **fields}


@named_arguments
def doctor(specification: Specification, *, examples: bool = True) -> Examination:
    """Find faults of a specification without evaluating a run.

    A spec is reported if no run satisfies it with a margin (a robustness above 0), or no run violates it with
    a margin. Specs that follow from another spec or contradict it are reported, too. Implications are
    reported if their antecedent never holds. The search uses automata and laws of geometry, which exclude
    runs that footprints cannot have.

    Args:
        examples: whether to search for the shortest runs that satisfy and violate each spec.

    Raises:
        UsageError: not a specification.
    """
    require_specification(specification)
    return _Examiner(specification).examination(examples)


def refuse_unsatisfiable(specification: Specification, name: str) -> None:
    """Raise an error if no run satisfies a spec with a margin.

    Raises:
        SpecificationError: no run satisfies the spec with a margin.
    """
    _refuse(specification, [name], [True])


def refuse_constant_results(specification: Specification) -> None:
    """Raise an error for results that no run can satisfy, or violate, with a margin.

    Raises:
        SpecificationError: a result is constant; one error reports all constant results.
    """
    _refuse(specification, [spec.name for spec in specification.results], [False, True])


def _refuse(specification: Specification, names: Sequence[str], outcomes: Sequence[bool]) -> None:
    """Raise an error for specs without a run that has a required outcome.

    Args:
        names: names of the examined specs.
        outcomes: required outcomes: True for a satisfied spec, False for a violated spec.
    """
    examiner = _Examiner(specification)
    specs = [spec for spec in specification.specs if spec.name in names]
    findings = [examiner.why_empty(spec, satisfied) for spec in specs for satisfied in outcomes]
    errors = [replace(finding.diagnostic, severity="error") for finding in findings if finding is not None]
    if errors:
        raise SpecificationError(errors)


def _subject(formula: Formula) -> frozenset[str]:
    """Return the names of the objects, regions and signals in a formula."""
    atoms = [part for part in iter_formulas(formula) if isinstance(part, Atom)]
    numeric_atoms = [atom for atom in atoms if atom.relation in ("signal", "sum")]
    signals = {name for atom in numeric_atoms for name in signals_in(atom.expression)}
    formula_names = {part.name for part in iter_formulas(formula) if part.name is not None}
    return (other_names(formula) - formula_names) | signals


def _parts(spec: NamedSpec, specs: dict[str, NamedSpec]) -> Iterator[NamedSpec]:
    """Yield the named conjuncts of a spec; the spec itself if some conjunct has no name."""
    formula, conjunct_names = spec.formula, list[str]()
    if isinstance(formula, Boolean) and formula.operator in ("and", "spec"):
        conjunct_names = [operand.name or "" for operand in formula.operands]
    if conjunct_names and all(name in specs for name in conjunct_names):
        for name in conjunct_names:
            yield from _parts(specs[name], specs)
    else:
        yield spec


class _Examiner:
    """Examination of one specification; all questions share the exclusions of geometry."""

    def __init__(self, specification: Specification) -> None:
        self._specification = specification
        self._source = SourceText.of(specification.source, specification.filename)
        formulas = [spec.formula for spec in specification.specs]
        self._search = WordSearch(FactDiagrams(formulas, specification.regions))
        self._readings: dict[str, SpecReading] = {}
        self._answers: dict[tuple[str, bool], Answer | None] = {}
        self._findings: list[Finding] = []
        self._undecided: dict[str, list[str]] = {}
        self._notes: list[str] = []

    def examination(self, examples: bool) -> Examination:
        specs = {spec.name: spec for spec in self._specification.specs}
        results = self._specification.results
        parts_by_name = {part.name: part for spec in results for part in _parts(spec, specs)}
        for spec in results:
            self._examine(spec)
            if not self._is_empty(spec, True):
                self._antecedents(spec)
        for part in parts_by_name.values():
            if part.name not in {spec.name for spec in results}:
                self._examine(part)
        self._pairs(tuple(parts_by_name.values()), results)
        self._notes += seam_texts((spec.formula for spec in results), self._specification.regions)
        spec_examinations = tuple(self._describe(spec, examples) for spec in results)
        findings = sorted(
            self._findings, key=lambda finding: (finding.diagnostic.line, finding.diagnostic.column)
        )
        return Examination(tuple(findings), spec_examinations, tuple(self._notes))

    def why_empty(self, part: NamedSpec, satisfied: bool) -> Finding | None:
        """Return the finding that no run satisfies, or violates, a part; None if such a run may exist."""
        if not self._is_empty(part, satisfied):
            return None
        self._examine(part)
        return self._findings[-1]

    def _reading(self, part: NamedSpec) -> SpecReading:
        if part.name not in self._readings:
            self._readings[part.name] = reading_of(self._specification, part.name, part.formula)
        return self._readings[part.name]

    def _answer(self, part: NamedSpec, satisfied: bool) -> Answer | None:
        """Return the answer to the search for a run that satisfies or violates a part; None if undecided."""
        key = part.name, satisfied
        if key not in self._answers:
            reading = self._reading(part)
            runs = reading.satisfying if satisfied else reading.violating
            question = "whether a run satisfies it" if satisfied else "whether a run violates it"
            known_runs = [] if runs is None else [runs]
            self._answers[key] = self._ask(part.name, question, *known_runs, whole_part=(part, satisfied))
        return self._answers[key]

    def _ask(
        self, name: str, question: str, *runs: Runs, whole_part: tuple[NamedSpec, bool] | None = None
    ) -> Answer | None:
        try:
            if runs:
                return self._search.shortest(*runs)
        except UndecidedError:
            # one automaton of the whole part needs no product of automata
            if whole_part is not None and (answer := self._of_whole(*whole_part)) is not None:
                return answer
        self._undecided.setdefault(name, []).append(question)
        return None

    def _of_whole(self, part: NamedSpec, satisfied: bool) -> Answer | None:
        """Return the answer from the automaton of the whole part; None if the automaton gives no answer."""
        try:
            side = Side(automaton_of(self._specification, part.name, part.formula), satisfied)
            if not side.may_agree(side.automaton.initial):
                return Answer(None, by_logic=True)
            return self._search.shortest(((side,),))
        except (NoAutomatonError, UndecidedError):
            return None

    def _is_empty(self, part: NamedSpec, satisfied: bool) -> bool:
        answer = self._answer(part, satisfied)
        return answer is not None and answer.word is None

    def _examine(self, part: NamedSpec) -> None:
        if self._is_empty(part, True):
            message = f"no run satisfies {part.name}"
            self._add(
                "unsatisfiable", (part.name,), part.span, self._answer(part, True), message, _UNSATISFIABLE
            )
        elif self._is_empty(part, False):
            message = f"every run satisfies {part.name}"
            self._add("always true", (part.name,), part.span, self._answer(part, False), message, _ALWAYS)

    def _antecedents(self, part: NamedSpec) -> None:
        satisfying = self._reading(part).satisfying
        nodes = (node for _, _, node in iter_nodes(part.formula))
        # keys are places, because expanded macros and quantifiers repeat an implication
        implications = {
            node.span: node for node in nodes if isinstance(node, Boolean) and node.operator == "->"
        }
        if (implication_count := len(implications)) > MAX_ANTECEDENTS:
            self._notes.append(
                f"of {implication_count} implications of {part.name}, {MAX_ANTECEDENTS} were examined"
            )
        runs_by_implication: dict[Boolean, Runs] = {}
        for node in list(implications.values())[:MAX_ANTECEDENTS]:
            if (holding_runs := self._sometime(part, node.operands[0])) is None:
                continue
            text = shortened_formula(format_formula(node.operands[0]))
            answer_alone = self._ask(part.name, f"whether `{text}` ever holds", holding_runs)
            if answer_alone is not None and answer_alone.word is None:
                self._add_idle(part, node, answer_alone, "")
            elif answer_alone is not None and satisfying is not None:
                runs_by_implication[node] = holding_runs
        if satisfying is None or not runs_by_implication:
            return
        # a run in which all antecedents hold in one sample answers the question for each antecedent
        joint_runs = self._sometime(
            part, Boolean("and", tuple(node.operands[0] for node in runs_by_implication))
        )
        if (
            len(runs_by_implication) > 1
            and joint_runs is not None
            and self._search.is_found(satisfying, joint_runs)
        ):
            return
        for node, holding_runs in runs_by_implication.items():
            text = shortened_formula(format_formula(node.operands[0]))
            question = f"whether `{text}` holds in a run that satisfies it"
            joint_answer = self._ask(part.name, question, satisfying, holding_runs)
            if joint_answer is not None and joint_answer.word is None:
                self._add_idle(part, node, joint_answer, f" in a run that satisfies {part.name}")

    def _add_idle(self, part: NamedSpec, node: Boolean, answer: Answer, where: str) -> None:
        text = shortened_formula(format_formula(node.operands[0]))
        message = f"`{text}` never holds{where}, so this implication checks nothing"
        self._add("idle antecedent", (part.name,), node.span, answer, message, _IDLE)

    def _sometime(self, part: NamedSpec, formula: Formula) -> Runs | None:
        """Return the runs in which a formula holds in some sample; None if the formula has no automaton."""
        eventually = loosen(Temporal("F", (formula,)))
        try:
            return ((Side(automaton_of(self._specification, part.name, eventually)),),)
        except NoAutomatonError:
            return None

    def _pairs(self, parts: Sequence[NamedSpec], results: Sequence[NamedSpec]) -> None:
        """Compare specs that share an object, region or signal; faulty specs are left out."""
        faultless_parts = [
            part for part in parts if not (self._is_empty(part, True) or self._is_empty(part, False))
        ]
        subjects = {part.name: _subject(part.formula) for part in faultless_parts}
        pairs = [
            (first_spec, second_spec)
            for first_spec, second_spec in combinations(faultless_parts, 2)
            if subjects[first_spec.name] & subjects[second_spec.name]
        ]
        if len(pairs) > MAX_PAIRS:
            self._notes.append(f"of {len(pairs)} pairs of specs, {MAX_PAIRS} were compared")
        for first_spec, second_spec in pairs[:MAX_PAIRS]:
            satisfying = [self._reading(part).satisfying for part in (first_spec, second_spec)]
            violating = [self._reading(part).violating for part in (first_spec, second_spec)]
            joint_answer = self._compare(first_spec, "contradicts", second_spec, *satisfying)
            if joint_answer is not None and joint_answer.word is None:
                message = f"no run satisfies both {first_spec.name} and {second_spec.name}"
                self._add(
                    "contradiction",
                    (first_spec.name, second_spec.name),
                    second_spec.span,
                    joint_answer,
                    message,
                    _CONTRADICTION,
                )
                continue
            forward_answer = self._compare(first_spec, "implies", second_spec, satisfying[0], violating[1])
            backward_answer = self._compare(second_spec, "implies", first_spec, satisfying[1], violating[0])
            is_second_implied = forward_answer is not None and forward_answer.word is None
            is_first_implied = backward_answer is not None and backward_answer.word is None
            if is_second_implied and is_first_implied:
                message = f"{second_spec.name} says the same as {first_spec.name}"
                merged_answer = joint(
                    [answer for answer in (forward_answer, backward_answer) if answer is not None]
                )
                self._add(
                    "implied",
                    (second_spec.name, first_spec.name),
                    second_spec.span,
                    merged_answer,
                    message,
                    _SAME,
                )
            elif is_second_implied:
                message = f"{second_spec.name} follows from {first_spec.name}"
                self._add(
                    "implied",
                    (second_spec.name, first_spec.name),
                    second_spec.span,
                    forward_answer,
                    message,
                    _IMPLIED,
                )
            elif is_first_implied:
                message = f"{first_spec.name} follows from {second_spec.name}"
                self._add(
                    "implied",
                    (first_spec.name, second_spec.name),
                    first_spec.span,
                    backward_answer,
                    message,
                    _IMPLIED,
                )

    def _compare(self, first: NamedSpec, verb: str, second: NamedSpec, *runs: Runs | None) -> Answer | None:
        known_runs = [options for options in runs if options is not None]
        if len(known_runs) < len(runs):
            return None
        return self._ask(first.name, f"whether it {verb} {second.name}", *known_runs)

    def _add(
        self, kind: Kind, specs: tuple[str, ...], span: Span, answer: Answer | None, message: str, hint: str
    ) -> None:
        if answer is None:
            return
        reason = reason_of(answer)
        loose_specs = [name for name in specs if name in self._readings and self._readings[name].reason]
        if loose_specs:
            reason += ", however its bounds and past operators are read"
        diagnostic = self._source.diagnostic("warning", span, f"{message}: {reason}", hint)
        self._findings.append(Finding(kind, specs, reason, answer.exclusions, diagnostic))

    def _example(self, spec: NamedSpec, satisfied: bool, word: Word) -> Example | None:
        reading = self._reading(spec)
        runs = reading.satisfying if satisfied else reading.violating
        return shortest_example(
            self._specification,
            spec,
            self._search,
            word,
            satisfied,
            is_exact=not reading.reason,
            another=lambda avoided: self._search.another(len(word), avoided, *([runs] if runs else [])),
        )

    def _describe(self, spec: NamedSpec, examples: bool) -> SpecExamination:
        shortest_runs: list[Example | None] = []
        for satisfied in (True, False):
            answer = self._answer(spec, satisfied)
            word = None if answer is None else answer.word
            shortest_runs.append(
                self._example(spec, satisfied, word) if word is not None and examples else None
            )
        undecided = tuple(self._undecided.get(spec.name, ()))
        return SpecExamination(
            spec.name,
            self._reading(spec).reason,
            undecided,
            tuple(_unrelated_texts(spec.formula)),
            *shortest_runs,
        )


_UNSATISFIABLE: Final = "look for a relation that is the wrong way round, or a threshold that is too strict"
_ALWAYS: Final = "it checks nothing; look at its brackets and operators"
_IDLE: Final = "look for a relation that is the wrong way round, or for missing brackets"
_CONTRADICTION: Final = "one of them is violated in every log"
_IMPLIED: Final = "it adds nothing; leave it out, or make it stricter"
_SAME: Final = "leave one of them out"


def reason_of(answer: Answer) -> str:
    """Return the reason of an answer without a run."""
    if answer.by_logic or not answer.exclusions:
        opposites_text = "".join(
            f"; `{text}` and `{opposite}` are opposites" for text, opposite in answer.opposites[:_SHOWN]
        )
        equals_text = "".join(
            f"; `{text}` has the robustness of `{equal}`" for text, equal in answer.equals[:_SHOWN]
        )
        return f"by logic alone, whatever is measured{opposites_text}{equals_text}"
    texts = [_exclusion_text(exclusion) for exclusion in answer.exclusions[:_SHOWN]]
    hidden_count = len(answer.exclusions) - len(texts)
    return "; ".join(texts) + (f"; and {hidden_count} more" if hidden_count else "")


def _exclusion_text(texts: Sequence[str]) -> str:
    if len(texts) == 1:
        return f"`{texts[0]}` never holds"
    *first_texts, last_text = (f"`{text}`" for text in texts)
    return f"{', '.join(first_texts)} and {last_text} exclude each other"


def _unrelated_texts(formula: Formula) -> Iterator[str]:
    """Yield the formulas without laws of geometry: open quantifiers, open groups, earlier samples."""
    texts: dict[str, None] = {}
    for part in iter_formulas(formula):
        if isinstance(part, Quantified):
            texts[format_formula(part)] = None
        elif isinstance(part, Atom) and is_spatial(part):
            terms = [member for term in terms_of(part.expression) for member in members(term)]
            if any(looks_back(term) or not is_solid(term) for term in terms):
                texts[part.text] = None
    yield from texts
