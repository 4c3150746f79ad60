"""Edits between two versions of a formula: changed declarations, aligned trees, and kinds of edits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from difflib import SequenceMatcher
from functools import partial
from itertools import chain
from types import MappingProxyType
from typing import Any, Final, Literal, NamedTuple, TypeAlias

from lark import Token

from spatial_replay.errors import SpecificationError, UsageError
from spatial_replay.spec.checks import with_numbers
from spatial_replay.spec.diagnostics import Faults, SourceText, Span
from spatial_replay.spec.format import format_bound, format_formula, format_term
from spatial_replay.spec.formula import (
    Atom,
    Boolean,
    DerivedTerm,
    Formula,
    Group,
    Number,
    Outline,
    Quantified,
    RegionName,
    Specification,
    Temporal,
    Truth,
    iter_nodes,
    operands_of,
    operator_of,
)
from spatial_replay.spec.load import parse_specification
from spatial_replay.spec.parser import split_statements
from spatial_replay.spec.relations import RELATION_NAMES
from spatial_replay.spec.tokens import span_of, tokenize
from spatial_replay.spec.walks import (
    base_of,
    changed_leaf,
    iter_atoms,
    iter_terms,
    map_leaves,
    rewritten,
    signals_in,
    without_variables,
)


def unify_regions(
    formulas: Sequence[Formula], regions: Mapping[str, Outline], others: Mapping[str, Outline]
) -> tuple[list[Formula], dict[str, Outline]]:
    """Rename regions in formulas if `others` has another shape of the same name.

    The formulas' texts do not change.

    Returns:
        The formulas, and the regions of both sides by name.
    """
    new_names: dict[str, str] = {}
    all_regions = dict(others)
    for name, outline in regions.items():
        if others.get(name, outline) != outline:
            new_name = f"{name} (before)"
            while new_name in others or new_name in regions:
                new_name += "'"
            new_names[name] = new_name
        all_regions[new_names.get(name, name)] = outline
    if not new_names:
        return list(formulas), all_regions
    rename_term = partial(_rename_regions, regions=new_names)

    def change_atom(atom: Atom) -> Atom:
        expression = map_leaves(atom.expression, partial(changed_leaf, change=rename_term))
        return replace(atom, expression=expression, terms=tuple(map(rename_term, atom.terms)))

    return [rewritten(formula, change_atom) for formula in formulas], all_regions


def _rename_regions(term: Any, regions: Mapping[str, str], *, without_groups: bool = False) -> Any:
    """Return a term with renamed regions; `without_groups` removes the names of groups."""
    if isinstance(term, Group) and without_groups:
        return replace(term, name="")
    if isinstance(term, RegionName):
        return RegionName(regions.get(term.name, term.name))
    if isinstance(term, DerivedTerm):
        return replace(term, term=_rename_regions(term.term, regions, without_groups=without_groups))
    return term


DeclarationKind: TypeAlias = Literal["constant", "region", "group", "definition"]

_KINDS: Final[Mapping[str, DeclarationKind]] = MappingProxyType(
    {
        "CONST": "constant",
        "REGION": "region",
        "GROUP": "group",
        "DEF": "definition",
        "SCALE": "definition",
        "USE": "definition",
    }
)
_MOST_CHANGES: Final = 32
"""Maximum number of changed declarations that are compared. Texts with more changes are unrelated."""


class TextPlace(NamedTuple):
    """Place in a specification file.

    Attributes:
        line: number of the line, from 1.
        text: text of the line, or of the statement that begins on the line.
    """

    filename: str
    line: int
    text: str


class DeclarationChange(NamedTuple):
    """Declaration that differs between two versions; `old` or `new` is None if that version lacks it."""

    kind: DeclarationKind
    name: str
    old: TextPlace | None
    new: TextPlace | None


class _Statement(NamedTuple):
    span: Span
    place: TextPlace
    words: tuple[str, ...]


_Key: TypeAlias = tuple[str, str]
"""First word of a statement, and the name that it declares."""


class TextVersions:
    """Two versions of a text, and mixed versions in which some declarations are exchanged.

    Parsed versions are cached.

    Attributes:
        old, new: specifications with numbers instead of the names of enumerated values.
        changes: declarations that differ by more than blanks and comments, at most `_MOST_CHANGES`.
    """

    def __init__(self, old: Specification, new: Specification, units: Mapping[str, str]) -> None:
        self._units = units
        self.old, self.new = with_numbers(old, units), with_numbers(new, units)
        self._statements = statements_of(old), statements_of(new)
        old_statements, new_statements = self._statements
        # specs are left out, because they are compared node by node
        statement_keys = [
            key for key in dict.fromkeys((*old_statements, *new_statements)) if key[0] != "SPEC"
        ]
        self._changed_keys = [
            key for key in statement_keys if _words(old_statements, key) != _words(new_statements, key)
        ][:_MOST_CHANGES]
        self.changes = tuple(
            DeclarationChange(
                _KINDS[key[0]], key[1], _place(old_statements, key), _place(new_statements, key)
            )
            for key in self._changed_keys
        )
        self._parsed_versions: dict[tuple[bool, frozenset[int]], Specification | None] = {}

    def version(self, changes: Collection[int], *, is_undone: bool) -> Specification | None:
        """Parse the old text with some new declarations; None if this mixed version has errors.

        Args:
            changes: indices of the declarations in the attribute `changes`.
            is_undone: whether the new text with some old declarations is parsed instead.
        """
        mixture = is_undone, frozenset(changes)
        if mixture not in self._parsed_versions:
            exchanged_keys = [self._changed_keys[index] for index in changes]
            # an exchanged declaration may need other declarations of its text
            candidate_texts = (
                self._exchange(exchanged_keys, is_undone, is_strict) for is_strict in (True, False)
            )
            candidates = (self._parse(text, exchanged_keys, is_undone) for text in candidate_texts)
            self._parsed_versions[mixture] = next(
                (candidate for candidate in candidates if candidate is not None), None
            )
        return self._parsed_versions[mixture]

    def edited_lines(
        self, specs: Sequence[tuple[str, str]], spans: tuple[Span | None, Span | None]
    ) -> tuple[TextPlace | None, TextPlace | None]:
        """Return the places of a changed line in the old and in the new text, from the first edited spec.

        A place is None if the text lacks the line. Both places are None if no spec was edited.

        Args:
            specs: names of each spec in the old and in the new text.
            spans: preferred places in the old and in the new text, if several lines changed.
        """
        for spec_names in specs:
            statements = [
                text_statements.get(("SPEC", name))
                for text_statements, name in zip(self._statements, spec_names, strict=True)
            ]
            old_statement, new_statement = statements
            if (
                old_statement is not None
                and new_statement is not None
                and old_statement.words != new_statement.words
            ):
                break
        else:
            return None, None
        old_lines = _lines_of(self.old, old_statement.span, spans[0])
        new_lines = _lines_of(self.new, new_statement.span, spans[1])
        old_words, new_words = (
            [tuple(line.place.text.partition("#")[0].split()) for line in lines]
            for lines in (old_lines, new_lines)
        )
        # autojunk would ignore frequent lines of long texts (https://docs.python.org/3/library/difflib.html)
        opcodes = SequenceMatcher(None, old_words, new_words, autojunk=False).get_opcodes()
        changed_blocks = [
            (old_lines[old_begin:old_end], new_lines[new_begin:new_end])
            for tag, old_begin, old_end, new_begin, new_end in opcodes
            if tag != "equal"
        ]
        return _edited_places(
            max(changed_blocks, key=lambda block: sum(line.is_wanted for line in (*block[0], *block[1])))
        )

    def _exchange(self, exchanged_keys: Collection[_Key], is_undone: bool, is_strict: bool) -> str:
        base_statements, donor_statements = self._statements[::-1] if is_undone else self._statements
        base_file, donor_file = (self.new, self.old) if is_undone else (self.old, self.new)
        replacements: list[tuple[Span, str]] = []
        added_texts = []
        for key in self._changed_keys:
            if key in base_statements and key in donor_statements and key in exchanged_keys:
                replacements.append(
                    (base_statements[key].span, _text(donor_file, donor_statements[key].span))
                )
            elif key not in base_statements and (key in exchanged_keys or not is_strict):
                added_texts.append(_text(donor_file, donor_statements[key].span))
            elif key not in donor_statements and key in exchanged_keys and is_strict:
                replacements.append((base_statements[key].span, ""))
        mixed_text = base_file.source
        for span, replacement in sorted(replacements, reverse=True):
            mixed_text = mixed_text[: span.start] + replacement + mixed_text[span.end :]
        return "\n".join((*added_texts, mixed_text))

    def _parse(self, text: str, exchanged_keys: Iterable[_Key], is_undone: bool) -> Specification | None:
        base_file, donor_file = (self.new, self.old) if is_undone else (self.old, self.new)
        profile = (
            donor_file.profile
            if any(first_word == "USE" for first_word, _ in exchanged_keys)
            else base_file.profile
        )
        with suppress(SpecificationError, UsageError):
            specification = parse_specification(text, filename=base_file.filename, profile=profile)
            atoms = (atom for spec in specification.specs for atom in iter_atoms(spec.formula))
            signal_names = {name for atom in atoms for name in signals_in(atom.expression)}
            # without its declaration, a constant of the other text is parsed as a signal
            if not any(
                first_word == "CONST" and name in signal_names for first_word, name in self._changed_keys
            ):
                return with_numbers(specification, self._units)
        return None


class _Line(NamedTuple):
    """Line of a statement; `is_wanted` marks the line with the preferred place."""

    place: TextPlace
    is_wanted: bool


def _lines_of(file: Specification, statement_span: Span, wanted_span: Span | None) -> list[_Line]:
    first_line, last_line = (
        file.source.count("\n", 0, offset) for offset in (statement_span.start, statement_span.end)
    )
    wanted_line = (
        -1
        if wanted_span is None or wanted_span == Span(0, 0)
        else file.source.count("\n", 0, wanted_span.start)
    )
    lines = file.source.split("\n")
    return [
        _Line(TextPlace(file.filename, line_index + 1, lines[line_index].strip()), line_index == wanted_line)
        for line_index in range(first_line, last_line + 1)
    ]


def _edited_places(
    block: tuple[Sequence[_Line], Sequence[_Line]],
) -> tuple[TextPlace | None, TextPlace | None]:
    """Return the place of the preferred line in each text.

    A text without a preferred line gives its line at the same position in the block, or None.
    """
    wanted_indices = [index for lines in block for index, line in enumerate(lines) if line.is_wanted]
    old_place, new_place = (
        next((line.place for line in lines if line.is_wanted), None)
        or (lines[min(next(iter(wanted_indices), 0), len(lines) - 1)].place if lines else None)
        for lines in block
    )
    return old_place, new_place


def statements_of(file: Specification) -> dict[_Key, _Statement]:
    """Return the statements of a specification's text by first word and declared name."""
    source = SourceText.of(file.source, file.filename)
    faults = Faults(source)
    statements: dict[_Key, _Statement] = {}
    for statement in split_statements(tokenize(file.source, RELATION_NAMES | file.relations, faults), faults):
        first_token, last_token = statement.tokens[0], statement.tokens[-1]
        if first_token.type not in (*_KINDS, "SPEC") or first_token is last_token:
            continue
        span = Span(span_of(first_token).start, span_of(last_token).end)
        place = TextPlace(
            file.filename, source.line_of(span.start), _on_one_line(file.source, statement.tokens)
        )
        name = "profile" if first_token.type == "USE" else str(statement.tokens[1].value)
        token_words = tuple(f"{token.type} {token.value}" for token in statement.tokens)
        statements.setdefault((first_token.type, name), _Statement(span, place, token_words))
    return statements


def _on_one_line(source: str, tokens: Sequence[Token]) -> str:
    """Return the text of a statement without line breaks and comments."""
    texts: list[str] = []
    previous_end = span_of(tokens[0]).start
    for token in tokens:
        token_start, token_end = span_of(token)
        gap = source[previous_end:token_start]
        texts += [
            gap if gap.isspace() and "\n" not in gap else " " * bool(gap),
            source[token_start:token_end],
        ]
        previous_end = token_end
    return "".join(texts)


def _words(statements: Mapping[_Key, _Statement], key: _Key) -> tuple[str, ...] | None:
    return statements[key].words if key in statements else None


def _place(statements: Mapping[_Key, _Statement], key: _Key) -> TextPlace | None:
    return statements[key].place if key in statements else None


def _text(file: Specification, span: Span) -> str:
    return file.source[span.start : span.end]


EditKind: TypeAlias = Literal[
    "constant", "region", "group", "definition", "replaced", "added", "removed", "moved", "renamed"
]
"""Kinds of edits.

A "constant" is a number or a window. A "region" or "group" is a declaration. A "definition" changes the
meaning of a macro or relation (`def`, profile, `scale`). A node is "replaced"; an operand of a conjunction or
disjunction is "added" or "removed". A "moved" node has only a new place, a "renamed" node only a new name.
"""


@dataclass(frozen=True, slots=True)
class Edit:
    """One edit of a formula, with all occurrences of the edit.

    Attributes:
        spec: innermost named spec that contains the edit.
        old, new: canonical text of the node before and after; None if it was added or removed.
        old_nodes, new_nodes: ids of the nodes in the two trees.
        old_span, new_span: place of the first node in each text.
        depth: depth of the deepest node; the root has depth 0.
        subject: name of the edited constant, region, group or macro; None for other edits.
        change: edited declaration in both texts; None if the text of a spec was edited.
        old_specs, new_specs: old and new names of the specs whose text may have been edited, innermost
            first. For a move, these are the specs of the old place and of the new place.
    """

    kind: EditKind
    spec: str
    old: str | None
    new: str | None
    old_nodes: tuple[int, ...]
    new_nodes: tuple[int, ...]
    old_span: Span | None
    new_span: Span | None
    depth: int
    subject: str | None = None
    change: DeclarationChange | None = None
    old_specs: tuple[tuple[str, str], ...] = ()
    new_specs: tuple[tuple[str, str], ...] = ()

    def __str__(self) -> str:
        subject_text = f" {self.subject}" if self.subject else ""
        match self.kind:
            case "added":
                return f"added `{self.new}`"
            case "removed":
                return f"removed `{self.old}`"
            case "moved":
                return f"moved `{self.new}`"
            case "renamed":
                return f"renamed {self.old} to {self.new}"
            case "region" | "group" | "definition":
                return f"{self.kind}{subject_text} changed in `{self.old if self.new is None else self.new}`"
        if self.old is None or self.new is None:
            return (
                f"{self.kind}{subject_text}: {f'adds `{self.new}`' if self.new else f'removes `{self.old}`'}"
            )
        return f"{self.kind}{subject_text}: `{self.old}` to `{self.new}`"


class Origin(NamedTuple):
    """Nodes that one edit of a specification's text affects, in the old tree and in the new tree.

    Attributes:
        change: edited declaration; None for the text of the specs.
        old, new: ids of the nodes in each tree.
    """

    change: DeclarationChange | None
    old: frozenset[int]
    new: frozenset[int]


@dataclass(frozen=True, slots=True)
class Place:
    """Node of a formula's tree.

    Attributes:
        id: id of the node.
        specs: names of the specs that contain the node, innermost first.
        depth: depth of the node; the root has depth 0.
    """

    node: Formula
    id: int
    specs: tuple[str, ...]
    depth: int

    @property
    def around(self) -> tuple[str, ...]:
        """Names of the specs whose text contains the node. The spec of a named node is left out."""
        return self.specs if self.node.name is None else self.specs[1:] or self.specs

    @property
    def operands(self) -> list[Place]:
        """Places of the operands of the node."""
        places, operand_id = [], self.id + 1
        for operand in operands_of(self.node):
            operand_specs = self.specs if operand.name is None else (operand.name, *self.specs)
            places.append(Place(operand, operand_id, operand_specs, self.depth + 1))
            operand_id += _size(operand)
        return places

    def members(self, operator: str, *, through_names: bool = False) -> list[Place]:
        """Return the operands of a conjunction or disjunction, without nesting of the same operator.

        Args:
            operator: "and" or "or"; operands with this operator are replaced by their operands.
            through_names: whether named specs with this operator are replaced, too.
        """
        member_places: list[Place] = []
        for operand in self.operands:
            inner_operand = operand.bare if through_names else operand
            has_same_operator = operator_of(inner_operand.node) == operator and (
                through_names or inner_operand.node.name is None
            )
            member_places += (
                inner_operand.members(operator, through_names=through_names)
                if has_same_operator
                else [operand]
            )
        return member_places

    @property
    def bare(self) -> Place:
        """The place of the node. It is the place of the inner spec if a spec only repeats another spec."""
        place = self
        while isinstance(place.node, Boolean) and place.node.operator == "spec":
            place = place.operands[0]
        return place


class FoundSite(NamedTuple):
    """Place where two trees differ, and the kind of edit; `parts` are differences in a quantifier's body."""

    kind: EditKind
    old: Place | None
    new: Place | None
    subject: str | None = None
    parts: tuple[FoundSite, ...] = ()

    @property
    def ids(self) -> tuple[range, range]:
        """Ids of the differing nodes in both trees, without operands if only a window or name differs."""
        is_window_change = (
            self.kind == "constant" and self.new is not None and isinstance(self.new.node, Temporal)
        )
        excludes_operands = self.kind == "renamed" or is_window_change
        old_ids, new_ids = (
            range(0)
            if place is None
            else range(place.id, place.id + (1 if excludes_operands else _size(place.node)))
            for place in (self.old, self.new)
        )
        return old_ids, new_ids

    def follows_from(self, origin: Origin) -> bool:
        """Return whether the difference depends on an edit of the texts."""
        return self.kind != "renamed" and not (
            origin.old.isdisjoint(self.ids[0]) and origin.new.isdisjoint(self.ids[1])
        )


def _size(formula: Formula) -> int:
    return sum(1 for _ in iter_nodes(formula))


@dataclass(frozen=True, slots=True)
class Site:
    """Difference of two trees; `site` is its index in the comparison."""

    site: int
    old: Formula | None
    new: Formula | None


@dataclass(frozen=True, slots=True)
class Inner:
    """Node of both trees whose operands may differ; `site` is the index of a changed window, or None."""

    site: int | None
    old: Boolean | Temporal
    new: Boolean | Temporal
    operands: tuple[Merged, ...]


Merged: TypeAlias = "Formula | Site | Inner"


@dataclass(frozen=True, eq=False)
class TreeDiff:
    """Edits between two formulas; empty if meaning and names are equal.

    Attributes:
        units: groups of edits that are applied together: a single edit, or several edits of one node.
    """

    units: tuple[tuple[Edit, ...], ...]
    _merged: Merged = field(repr=False)
    _unit_of_site: Mapping[int, int] = field(repr=False)

    @property
    def edits(self) -> tuple[Edit, ...]:
        """All edits."""
        return tuple(edit for unit in self.units for edit in unit)

    @property
    def effective(self) -> tuple[int, ...]:
        """The indices of the units that change the meaning of the formula; renames do not."""
        return tuple(index for index, unit in enumerate(self.units) if unit[0].kind != "renamed")

    def formula(self, units: Collection[int]) -> Formula:
        """Return the old formula with the edits of some units, given by index."""
        sites = frozenset(site for site, unit in self._unit_of_site.items() if unit in units)
        mixed_formula = _build(self._merged, sites)
        return Truth(True) if mixed_formula is None else mixed_formula


def _build(merged: Merged, applied_sites: frozenset[int]) -> Formula | None:
    if isinstance(merged, Site):
        return merged.new if merged.site in applied_sites else merged.old
    if not isinstance(merged, Inner):
        return merged
    operator_node = merged.new if merged.site in applied_sites else merged.old
    operands = tuple(
        formula for operand in merged.operands if (formula := _build(operand, applied_sites)) is not None
    )
    if operator_node.operator in ("and", "or") and len(operands) < 2:
        return operands[0] if operands else Truth(operator_node.operator == "and")
    return replace(operator_node, operands=operands)


def kind_of(old: Formula, new: Formula) -> tuple[EditKind, str | None]:
    """Return the kind of edit of a node, and the name of an edited region or group."""
    if isinstance(old, Atom) and isinstance(new, Atom) and old.relation == new.relation:
        if old.text == new.text:
            for old_term, new_term in zip(iter_terms([old]), iter_terms([new]), strict=False):
                if old_term != new_term and isinstance(base_of(new_term), RegionName):
                    return "region", format_term(base_of(new_term))
                if old_term != new_term and isinstance(base_of(new_term), Group):
                    return "group", format_term(base_of(new_term))
            return "definition", None
        if _without_numbers(old) == _without_numbers(new):
            return "constant", None
    if isinstance(old, Quantified) and format_formula(old) == format_formula(new):
        return "definition", None
    return "replaced", None


def _without_numbers(atom: Atom) -> Hashable:
    text_parameters = tuple(parameter for parameter in atom.parameters if isinstance(parameter, str))
    # a signal's comparison has the parameters name, sign and limit; the limit can be a text, too
    text_parameters = text_parameters[:2] if atom.relation == "signal" else text_parameters
    if atom.relation == "sum":
        zero = Number(0.0)
        return text_parameters, map_leaves(
            atom.expression, lambda leaf: zero if isinstance(leaf, Number) else leaf
        )
    return (
        text_parameters,
        len(atom.parameters),
        tuple((type(term), format_term(base_of(term))) for term in atom.terms),
    )


def similarity(old: Formula, new: Formula) -> float:
    """Return the fraction of common terms and signals of two nodes, 0 to 1."""
    old_subjects, new_subjects = _subjects(old), _subjects(new)
    return (old_subjects & new_subjects).total() / max((old_subjects | new_subjects).total(), 1)


def _subjects(formula: Formula) -> Counter[str]:
    subjects = Counter(format_term(base_of(term)) for term in iter_terms([formula]))
    atoms = [node for _, _, node in iter_nodes(formula) if isinstance(node, Atom)]
    subjects.update(str(atom.parameters[0]) for atom in atoms if not atom.terms and atom.relation != "sum")
    subjects.update(name for atom in atoms if atom.relation == "sum" for name in signals_in(atom.expression))
    return subjects


def compare_trees(
    old: Formula,
    new: Formula,
    name: str,
    regions: Mapping[str, Outline],
    origins: Sequence[Origin] = (),
    specs: tuple[Collection[str], Collection[str]] = ((), ()),
) -> TreeDiff:
    """Compare two formulas over the same regions (see `unify_regions`).

    Args:
        name: name of the formulas.
        origins: edits of the texts, each with the nodes that depend on it. Other nodes give separate edits.
        specs: names of all specs in the old and in the new text.
    """
    comparison = _Comparison(regions, specs)
    merged = comparison.align(Place(old, 0, (name,), 0), Place(new, 0, (name,), 0))
    return comparison.join_sites(merged, origins)


def changed_nodes(old: Formula, new: Formula, regions: Mapping[str, Outline]) -> frozenset[int]:
    """Return the ids of a new formula's nodes that differ from the old formula, and of their descendants."""
    comparison = _Comparison(regions)
    comparison.align(Place(old, 0, ("",), 0), Place(new, 0, ("",), 0))
    sites = [site for site in comparison.sites if site.kind != "renamed"]
    return frozenset(node_id for site in sites for node_id in site.ids[1])


class _Comparison:
    """Alignment of two trees. Meanings have numbers, so equal nodes are found quickly."""

    def __init__(
        self, regions: Mapping[str, Outline], specs: tuple[Collection[str], Collection[str]] = ((), ())
    ) -> None:
        name_by_outline: dict[Outline, str] = {}
        first_names = {name: name_by_outline.setdefault(outline, name) for name, outline in regions.items()}
        self._unify_term = partial(_rename_regions, regions=first_names, without_groups=True)
        self._specs = specs
        self._renamed_specs: set[tuple[str | None, str | None]] = set()
        self._meaning_numbers: dict[Hashable, int] = {}
        self._known_meanings: dict[int, tuple[Formula, int]] = {}
        self.sites: list[FoundSite] = []

    def meaning(self, node: Formula) -> int:
        """Return a number that is the same for nodes of equal meaning.

        Names, and the order of a commutative operator's operands, do not change the number.
        """
        cache_entry = self._known_meanings.get(id(node))
        if cache_entry is None:
            cache_entry = self._known_meanings[id(node)] = (node, self._meaning(node))
        return cache_entry[1]

    def _meaning(self, node: Formula) -> int:
        meaning_key: Hashable
        match node:
            case Truth():
                meaning_key = node.value
            case Atom():
                meaning_key = map_leaves(node.expression, partial(changed_leaf, change=self._unify_term))
            case Quantified():
                group = self._unify_term(node.group)
                meaning_key = (
                    node.quantifier,
                    len(node.variables),
                    group,
                    self.meaning(without_variables(node)),
                )
            case Boolean(operator="spec"):
                return self.meaning(node.operands[0])
            case Boolean(operator="and" | "or" as operator):
                # brackets around operands of the same operator do not change the meaning
                members = Place(node, 0, ("",), 0).members(operator, through_names=True)
                meaning_key = (operator, tuple(sorted(self.meaning(member.node) for member in members)))
            case Boolean(operator="xor" | "<->"):
                meaning_key = (node.operator, tuple(sorted(map(self.meaning, node.operands))))
            case Boolean():
                meaning_key = (node.operator, tuple(map(self.meaning, node.operands)))
            case Temporal():
                meaning_key = (node.operator, node.bound, tuple(map(self.meaning, node.operands)))
        return self._meaning_numbers.setdefault(meaning_key, len(self._meaning_numbers))

    def align(self, old: Place, new: Place) -> Merged:
        """Compare two corresponding nodes."""
        spec_names = old.node.name, new.node.name
        is_renamed = spec_names[0] != spec_names[1] and None not in spec_names
        has_equal_meaning = self.meaning(old.node) == self.meaning(new.node)
        if (
            is_renamed
            and not has_equal_meaning
            and (spec_names[0] in self._specs[1] or spec_names[1] in self._specs[0])
        ):
            # the reference changed to another spec; neither spec was edited
            return self._site(FoundSite("replaced", old, new))
        if is_renamed:
            self._renamed_specs.add(spec_names)
            self.sites.append(FoundSite("renamed", old, new))
        if has_equal_meaning:
            self._align_names(old, new)
            return new.node
        old, new = old.bare, new.bare
        match old.node, new.node:
            case Boolean(operator="and" | "or" as operator), Boolean(operator=new_operator) if (
                operator == new_operator
            ):
                return self._match(old.node, old.members(operator), new.node, new.members(operator))
            # operands were added to a formula or, in the next case, all but one were removed
            case _, Boolean(operator="and" | "or" as operator) if self._is_among(old, new.members(operator)):
                return self._match(new.node, [old], new.node, new.members(operator))
            case Boolean(operator="and" | "or" as operator), _ if self._is_among(new, old.members(operator)):
                return self._match(old.node, old.members(operator), old.node, [new])
            case Boolean(), Boolean() if old.node.operator == new.node.operator:
                return Inner(None, old.node, new.node, self._pairwise(old, new))
            case Temporal(), Temporal() if old.node.operator == new.node.operator:
                window_site = None
                if old.node.bound != new.node.bound:
                    window_site = self._site(FoundSite("constant", old, new)).site
                return Inner(window_site, old.node, new.node, self._pairwise(old, new))
            case Quantified(), Quantified() if _ranges_alike(old.node, new.node):
                edit_kind, subject = kind_of(old.node, new.node)
                return self._site(FoundSite(edit_kind, old, new, subject, self._parts(old, new)))
        edit_kind, subject = kind_of(old.node, new.node)
        return self._site(FoundSite(edit_kind, old, new, subject))

    def _parts(self, old: Place, new: Place) -> tuple[FoundSite, ...]:
        """Return the differences of two quantifiers' bodies. A quantifier and its body have the same id."""
        site_count = len(self.sites)
        bodies = [
            Place(place.node.body, place.id, place.specs, place.depth + 1)
            for place in (old, new)
            if isinstance(place.node, Quantified)
        ]
        self.align(bodies[0], bodies[1])
        body_sites, self.sites = self.sites[site_count:], self.sites[:site_count]

        def inside(place: Place | None, quantifier_place: Place) -> Place | None:
            return None if place is None else replace(place, id=quantifier_place.id)

        flat_sites = chain(*(site.parts or (site,) for site in body_sites))
        return tuple(
            site._replace(old=inside(site.old, old), new=inside(site.new, new)) for site in flat_sites
        )

    def join_sites(self, merged: Merged, origins: Sequence[Origin]) -> TreeDiff:
        """Join the sites of each edit, and return the edits."""
        declaration_origins = [origin for origin in origins if origin.change is not None]
        declaration_units: list[tuple[set[int], list[int]]] = []
        other_sites: list[int] = []
        for site_index, site in enumerate(self.sites):
            origin_indices = {
                index for index, origin in enumerate(declaration_origins) if site.follows_from(origin)
            }
            if not origin_indices:
                other_sites.append(site_index)
                continue
            # declarations that share a node form one unit
            overlapping_units = [unit for unit in declaration_units if unit[0] & origin_indices]
            declaration_units = [unit for unit in declaration_units if not unit[0] & origin_indices]
            declaration_units.append(
                (
                    origin_indices.union(*(unit[0] for unit in overlapping_units)),
                    [*chain(*(unit[1] for unit in overlapping_units)), site_index],
                )
            )
        units = [(min(sites), sites, sorted(origin_indices)) for origin_indices, sites in declaration_units]
        groups = self._join([self.sites[site_index] for site_index in other_sites])
        units += [
            (other_sites[sites[0]], [other_sites[site_index] for site_index in sites], []) for sites in groups
        ]
        units.sort()
        unit_of_site = {site: unit for unit, (_, sites, _) in enumerate(units) for site in sites}
        text_origins = [origin for origin in origins if origin.change is None]
        return TreeDiff(
            tuple(
                tuple(
                    self._unit(sites, [declaration_origins[index] for index in origin_indices], text_origins)
                )
                for _, sites, origin_indices in units
            ),
            merged,
            unit_of_site,
        )

    def _join(self, sites: Sequence[FoundSite]) -> Iterable[list[int]]:
        """Group sites by the edit of a spec's text, and return the indices of each group."""
        removed_meanings, added_meanings = (
            {
                self.meaning(place.node)
                for site in sites
                for place in (site.old, site.new)
                if place is not None and site.kind == kind
            }
            for kind in ("removed", "added")
        )
        sites_by_edit: dict[Hashable, list[int]] = {}
        for site_index, site in enumerate(sites):
            places = site.old, site.new
            meanings = [None if place is None else self.meaning(place.node) for place in places]
            known_meanings = {meaning for meaning in meanings if meaning is not None}
            spans = tuple(None if place is None else place.node.span for place in places)
            specs = self._specs_of(site.old, site.new)[:1]
            edit_key: Hashable = ("place", site.kind == "renamed", specs, *spans)
            if site.kind in ("added", "removed") and known_meanings <= removed_meanings & added_meanings:
                edit_key = ("moved", *known_meanings)
            elif Span(0, 0) in spans:
                edit_key = (site.kind, specs, *(_place_text(place, site.kind) for place in places), *meanings)
            sites_by_edit.setdefault(edit_key, []).append(site_index)
        return sites_by_edit.values()

    def _specs_of(self, old: Place | None, new: Place | None) -> tuple[tuple[str, str], ...]:
        """Return the old and new names of the specs whose text contains both places, innermost first."""
        if old is None or new is None:
            return tuple((name, name) for place in (old, new) if place is not None for name in place.around)
        name_pairs = [(old_name, new_name) for new_name in new.specs for old_name in old.specs]
        return tuple(
            name_pair
            for name_pair in name_pairs
            if name_pair[0] == name_pair[1] or name_pair in self._renamed_specs
        )

    def _unit(
        self,
        site_indices: Sequence[int],
        declaration_origins: Sequence[Origin],
        text_origins: Sequence[Origin],
    ) -> Iterator[Edit]:
        """Yield the edits of a unit: edits of declarations, then edits of the specs' text."""
        unit_sites = [self.sites[site] for site in site_indices]
        for origin in declaration_origins:
            if origin.change is not None:
                edit = self._edit([site for site in unit_sites if site.follows_from(origin)])
                yield replace(edit, kind=origin.change.kind, subject=origin.change.name, change=origin.change)
        if declaration_origins:
            text_sites = [
                site for site in unit_sites if any(site.follows_from(origin) for origin in text_origins)
            ]
        else:
            text_sites = list(chain(*(site.parts or (site,) for site in unit_sites)))
        for edit_indices in self._join(text_sites):
            yield self._edit([text_sites[index] for index in edit_indices])

    def _edit(self, sites: Sequence[FoundSite]) -> Edit:
        old_places = [site.old for site in sites if site.old is not None]
        new_places = [site.new for site in sites if site.new is not None]
        kinds = {site.kind for site in sites}
        kind: EditKind = "moved" if kinds == {"added", "removed"} else sites[0].kind
        first_old_place, first_new_place = next(iter(old_places), None), next(iter(new_places), None)
        if kind == "moved":
            specs = self._specs_of(first_old_place, None), self._specs_of(None, first_new_place)
        else:
            specs = (self._specs_of(first_old_place, first_new_place),) * 2
        return Edit(
            kind,
            specs[1][0][1],
            _place_text(first_old_place, kind),
            _place_text(first_new_place, kind),
            tuple(dict.fromkeys(place.id for place in old_places)),
            tuple(dict.fromkeys(place.id for place in new_places)),
            None if first_old_place is None else first_old_place.node.span,
            None if first_new_place is None else first_new_place.node.span,
            max(place.depth for place in (*old_places, *new_places)),
            sites[0].subject,
            old_specs=specs[0],
            new_specs=specs[1],
        )

    def _site(self, site: FoundSite) -> Site:
        self.sites.append(site)
        old, new = (None if place is None else place.node for place in (site.old, site.new))
        return Site(len(self.sites) - 1, old, new)

    def _align_names(self, old: Place, new: Place) -> None:
        """Add a site for each renamed node within equal nodes."""
        for old_operand, new_operand in zip(old.operands, new.operands, strict=False):
            if self.meaning(old_operand.node) == self.meaning(new_operand.node):
                if old_operand.node.name != new_operand.node.name and None not in (
                    old_operand.node.name,
                    new_operand.node.name,
                ):
                    self.sites.append(FoundSite("renamed", old_operand, new_operand))
                self._align_names(old_operand, new_operand)

    def _pairwise(self, old: Place, new: Place) -> tuple[Merged, ...]:
        return tuple([self.align(*pair) for pair in zip(old.operands, new.operands, strict=True)])

    def _is_among(self, place: Place, operands: Sequence[Place]) -> bool:
        return any(self.meaning(place.node) == self.meaning(operand.node) for operand in operands)

    def _match(
        self, old_node: Any, old_places: Sequence[Place], new_node: Any, new_places: Sequence[Place]
    ) -> Inner:
        """Match the operands of two conjunctions or disjunctions: by meaning, by name, then by similarity."""
        partner_indices: dict[int, int] = {}
        matched_indices: set[int] = set()

        def match(fits: Any) -> None:
            for new_index, new in enumerate(new_places):
                for old_index, old in enumerate(old_places if new_index not in partner_indices else ()):
                    if old_index not in matched_indices and fits(old, new):
                        partner_indices[new_index] = old_index
                        matched_indices.add(old_index)
                        break

        match(lambda old, new: self.meaning(old.node) == self.meaning(new.node))
        match(lambda old, new: old.node.name is not None and old.node.name == new.node.name)
        # the most similar pairs first, so that they get each other as partners
        for least_similarity in (1.0, 0.5, 0.01):
            match(
                lambda old, new, least_similarity=least_similarity: _is_alike(
                    old, new, least_similarity, by_operator=True
                )
            )
        match(lambda old, new: _is_alike(old, new, 0.5, by_operator=False))
        operands: list[Merged] = [
            self.align(old_places[partner_indices[new_index]], new)
            if new_index in partner_indices
            else self._site(FoundSite("added", None, new))
            for new_index, new in enumerate(new_places)
        ]
        unmatched_places = [
            old for old_index, old in enumerate(old_places) if old_index not in matched_indices
        ]
        operands += [self._site(FoundSite("removed", old, None)) for old in unmatched_places]
        return Inner(None, old_node, new_node, tuple(operands))


def _is_alike(old: Place, new: Place, least_similarity: float, *, by_operator: bool) -> bool:
    """Return whether two nodes are similar enough. With `by_operator`, they need the same operator, too."""
    old_node, new_node = old.bare.node, new.bare.node
    return (not by_operator or operator_of(old_node) == operator_of(new_node)) and similarity(
        old_node, new_node
    ) >= least_similarity


def _ranges_alike(old: Quantified, new: Quantified) -> bool:
    """Return whether two quantifiers differ only in their bodies."""
    return (old.quantifier, old.variables, old.group) == (new.quantifier, new.variables, new.group)


def _place_text(place: Place | None, kind: EditKind) -> str | None:
    if place is None:
        return None
    if kind == "renamed":
        return place.node.name
    if kind == "constant" and isinstance(place.node, Temporal):
        # the operands are unchanged, or have their own edits
        return f"{place.node.operator}{format_bound(place.node.bound)} …"
    return format_formula(place.node)
