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
    """Rename regions in formulas if `others` has other shapes under their names; texts do not change.

    Returns:
        The formulas, and the regions of both sides by name.
    """
    renamed: dict[str, str] = {}
    joined = dict(others)
    for name, outline in regions.items():
        if others.get(name, outline) != outline:
            new_name = f"{name} (before)"
            while new_name in others or new_name in regions:
                new_name += "'"
            renamed[name] = new_name
        joined[renamed.get(name, name)] = outline
    if not renamed:
        return list(formulas), joined
    change = partial(_rename_regions, regions=renamed)

    def change_atom(atom: Atom) -> Atom:
        expression = map_leaves(atom.expression, partial(changed_leaf, change=change))
        return replace(atom, expression=expression, terms=tuple(map(change, atom.terms)))

    return [rewritten(formula, change_atom) for formula in formulas], joined


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
"""Maximum number of declarations that edits are traced to; more differences mean unrelated texts."""


class TextPlace(NamedTuple):
    """Place in a specification file: a line, from 1, with its text or the statement that begins there."""

    filename: str
    line: int
    text: str


class DeclarationChange(NamedTuple):
    """Declaration that differs between the versions; `old` or `new` is None if that version lacks it."""

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
    """Two versions of a text, and mixed versions with some declarations exchanged.

    Parsed versions are cached for one diff.

    Attributes:
        old, new: specifications with numbers instead of the names of enumerated values.
        changes: declarations that differ by more than blanks and comments; only the first of very many.
    """

    def __init__(self, old: Specification, new: Specification, units: Mapping[str, str]) -> None:
        self._units = units
        self.old, self.new = with_numbers(old, units), with_numbers(new, units)
        self._statements = statements_of(old), statements_of(new)
        old_statements, new_statements = self._statements
        # specs are left out, because they are compared node by node
        keys = [key for key in dict.fromkeys((*old_statements, *new_statements)) if key[0] != "SPEC"]
        self._keys = [key for key in keys if _words(old_statements, key) != _words(new_statements, key)][
            :_MOST_CHANGES
        ]
        self.changes = tuple(
            DeclarationChange(
                _KINDS[key[0]], key[1], _place(old_statements, key), _place(new_statements, key)
            )
            for key in self._keys
        )
        self._known: dict[tuple[bool, frozenset[int]], Specification | None] = {}

    def version(self, changes: Collection[int], *, is_undone: bool) -> Specification | None:
        """Return the old text with some new declarations, parsed; None if it has errors.

        Args:
            changes: indices of the declarations in `changes`.
            is_undone: whether the result is the new text with these old declarations instead.
        """
        version = is_undone, frozenset(changes)
        if version not in self._known:
            keys = [self._keys[number] for number in changes]
            # an exchanged declaration may need others that only its own text has
            texts = (self._exchange(keys, is_undone, is_strict) for is_strict in (True, False))
            versions = (self._parse(text, keys, is_undone) for text in texts)
            self._known[version] = next(
                (specification for specification in versions if specification is not None), None
            )
        return self._known[version]

    def edited_lines(
        self, specs: Sequence[tuple[str, str]], spans: tuple[Span | None, Span | None]
    ) -> tuple[TextPlace | None, TextPlace | None]:
        """Return a changed line of the first edited spec, as its place in the old and in the new text.

        A place is None if its text does not have the line. Both places are None if no spec was edited.

        Args:
            specs: names of each spec in the old and in the new text.
            spans: preferred places in the old and in the new text, if several lines changed.
        """
        for names in specs:
            statements = [of.get(("SPEC", name)) for of, name in zip(self._statements, names, strict=True)]
            old_statement, new_statement = statements
            if (
                old_statement is not None
                and new_statement is not None
                and old_statement.words != new_statement.words
            ):
                break
        else:
            return None, None
        old = _lines_of(self.old, old_statement.span, spans[0])
        new = _lines_of(self.new, new_statement.span, spans[1])
        one_words, other_words = (
            [tuple(line.place.text.partition("#")[0].split()) for line in lines] for lines in (old, new)
        )
        # autojunk would ignore frequent lines of long texts (https://docs.python.org/3/library/difflib.html)
        codes = SequenceMatcher(None, one_words, other_words, autojunk=False).get_opcodes()
        blocks = [(old[a:b], new[c:d]) for kind, a, b, c, d in codes if kind != "equal"]
        return _edited_places(
            max(blocks, key=lambda block: sum(line.is_wanted for line in (*block[0], *block[1])))
        )

    def _exchange(self, keys: Collection[_Key], is_undone: bool, is_strict: bool) -> str:
        base, donor = self._statements[::-1] if is_undone else self._statements
        file, source = (self.new, self.old) if is_undone else (self.old, self.new)
        pieces: list[tuple[Span, str]] = []
        first = []
        for key in self._keys:
            if key in base and key in donor and key in keys:
                pieces.append((base[key].span, _text(source, donor[key].span)))
            elif key not in base and (key in keys or not is_strict):
                first.append(_text(source, donor[key].span))
            elif key not in donor and key in keys and is_strict:
                pieces.append((base[key].span, ""))
        text = file.source
        for span, piece in sorted(pieces, reverse=True):
            text = text[: span.start] + piece + text[span.end :]
        return "\n".join((*first, text))

    def _parse(self, text: str, keys: Iterable[_Key], is_undone: bool) -> Specification | None:
        file, donor = (self.new, self.old) if is_undone else (self.old, self.new)
        profile = donor.profile if any(word == "USE" for word, _ in keys) else file.profile
        with suppress(SpecificationError, UsageError):
            version = parse_specification(text, filename=file.filename, profile=profile)
            atoms = (atom for spec in version.specs for atom in iter_atoms(spec.formula))
            signals = {name for atom in atoms for name in signals_in(atom.expression)}
            # without its declaration, a constant of the other text is parsed as a signal
            if not any(word == "CONST" and name in signals for word, name in self._keys):
                return with_numbers(version, self._units)
        return None


class _Line(NamedTuple):
    """Line of a statement; `is_wanted` marks the line with the preferred place."""

    place: TextPlace
    is_wanted: bool


def _lines_of(file: Specification, statement: Span, span: Span | None) -> list[_Line]:
    first, last = (file.source.count("\n", 0, at) for at in (statement.start, statement.end))
    wanted_line = -1 if span is None or span == Span(0, 0) else file.source.count("\n", 0, span.start)
    lines = file.source.split("\n")
    return [
        _Line(TextPlace(file.filename, number + 1, lines[number].strip()), number == wanted_line)
        for number in range(first, last + 1)
    ]


def _edited_places(
    block: tuple[Sequence[_Line], Sequence[_Line]],
) -> tuple[TextPlace | None, TextPlace | None]:
    """Return the preferred line of each text, or else its line at the same position in the block."""
    wanted_lines = [number for lines in block for number, line in enumerate(lines) if line.is_wanted]
    old, new = (
        next((line.place for line in lines if line.is_wanted), None)
        or (lines[min(next(iter(wanted_lines), 0), len(lines) - 1)].place if lines else None)
        for lines in block
    )
    return old, new


def statements_of(file: Specification) -> dict[_Key, _Statement]:
    """Return the statements of a specification's text by first word and declared name."""
    source = SourceText.of(file.source, file.filename)
    faults = Faults(source)
    statements: dict[_Key, _Statement] = {}
    for group in split_statements(tokenize(file.source, RELATION_NAMES | file.relations, faults), faults):
        first, last = group.tokens[0], group.tokens[-1]
        if first.type not in (*_KINDS, "SPEC") or first is last:
            continue
        span = Span(span_of(first).start, span_of(last).end)
        place = TextPlace(file.filename, source.line_of(span.start), _on_one_line(file.source, group.tokens))
        name = "profile" if first.type == "USE" else str(group.tokens[1].value)
        words = tuple(f"{token.type} {token.value}" for token in group.tokens)
        statements.setdefault((first.type, name), _Statement(span, place, words))
    return statements


def _on_one_line(source: str, tokens: Sequence[Token]) -> str:
    """Return the text of a statement without line breaks and comments."""
    pieces: list[str] = []
    at = span_of(tokens[0]).start
    for token in tokens:
        start, end = span_of(token)
        gap = source[at:start]
        pieces += [gap if gap.isspace() and "\n" not in gap else " " * bool(gap), source[start:end]]
        at = end
    return "".join(pieces)


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
disjunction is "added" or "removed". An edit of the place alone is "moved", of the name alone "renamed".
"""


@dataclass(frozen=True, slots=True)
class Edit:
    """One edit of a formula with all its occurrences.

    Attributes:
        spec: innermost named spec that contains the edit.
        old, new: canonical text of the node before and after; None if it was added or removed.
        old_nodes, new_nodes: ids of the nodes in the two trees.
        old_span, new_span: place of the first node in each text.
        depth: depth of the deepest node; the root has depth 0.
        subject: name of the edited constant, region, group or macro; None for other edits.
        change: edited declaration in both texts; None if the text of a spec was edited.
        old_specs, new_specs: specs whose text may have been edited, innermost first, each with its names in
            both texts. For a move, these are the specs of the old place and of the new place.
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
        about = f" {self.subject}" if self.subject else ""
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
                return f"{self.kind}{about} changed in `{self.old if self.new is None else self.new}`"
        if self.old is None or self.new is None:
            return f"{self.kind}{about}: {f'adds `{self.new}`' if self.new else f'removes `{self.old}`'}"
        return f"{self.kind}{about}: `{self.old}` to `{self.new}`"


class Origin(NamedTuple):
    """Nodes of two trees that depend on one edit of their texts.

    Attributes:
        change: edited declaration; None for the text of the specs.
        old, new: ids of the nodes in each tree.
    """

    change: DeclarationChange | None
    old: frozenset[int]
    new: frozenset[int]


@dataclass(frozen=True, slots=True)
class Place:
    """Node with its id, the names of its specs, innermost first, and its depth."""

    node: Formula
    id: int
    specs: tuple[str, ...]
    depth: int

    @property
    def around(self) -> tuple[str, ...]:
        """Names of the specs whose text contains the node; a named node is not in its own spec."""
        return self.specs if self.node.name is None else self.specs[1:] or self.specs

    @property
    def operands(self) -> list[Place]:
        """Places of the operands of the node."""
        places, identifier = [], self.id + 1
        for operand in operands_of(self.node):
            specs = self.specs if operand.name is None else (operand.name, *self.specs)
            places.append(Place(operand, identifier, specs, self.depth + 1))
            identifier += _size(operand)
        return places

    def members(self, operator: str, *, through_names: bool = False) -> list[Place]:
        """Return the operands of a conjunction or disjunction; nested ones are replaced by their operands.

        Args:
            through_names: whether named specs are replaced by their operands, too.
        """
        places: list[Place] = []
        for place in self.operands:
            inner = place.bare if through_names else place
            is_more = operator_of(inner.node) == operator and (through_names or inner.node.name is None)
            places += inner.members(operator, through_names=through_names) if is_more else [place]
        return places

    @property
    def bare(self) -> Place:
        """The node; a spec that only repeats another spec is replaced by that one."""
        place = self
        while isinstance(place.node, Boolean) and place.node.operator == "spec":
            place = place.operands[0]
        return place


class FoundSite(NamedTuple):
    """Place where the trees differ, with its kind of edit; `parts` are differences within a quantifier."""

    kind: EditKind
    old: Place | None
    new: Place | None
    subject: str | None = None
    parts: tuple[FoundSite, ...] = ()

    @property
    def ids(self) -> tuple[range, range]:
        """The ids of the nodes that differ; after a change of window or name, operands are left out."""
        is_window = self.kind == "constant" and self.new is not None and isinstance(self.new.node, Temporal)
        is_alone = self.kind == "renamed" or is_window
        old, new = (
            range(0) if place is None else range(place.id, place.id + (1 if is_alone else _size(place.node)))
            for place in (self.old, self.new)
        )
        return old, new

    def follows_from(self, origin: Origin) -> bool:
        """Return whether the difference depends on an edit of the texts."""
        return self.kind != "renamed" and not (
            origin.old.isdisjoint(self.ids[0]) and origin.new.isdisjoint(self.ids[1])
        )


def _size(formula: Formula) -> int:
    return sum(1 for _ in iter_nodes(formula))


@dataclass(frozen=True, slots=True)
class Site:
    """Place where the trees differ, by its index."""

    site: int
    old: Formula | None
    new: Formula | None


@dataclass(frozen=True, slots=True)
class Inner:
    """Node of both trees whose operands may differ; if `site` is given, its window differs, too."""

    site: int | None
    old: Boolean | Temporal
    new: Boolean | Temporal
    operands: tuple[Merged, ...]


Merged: TypeAlias = "Formula | Site | Inner"


@dataclass(frozen=True, eq=False)
class TreeDiff:
    """Edits between two formulas; empty if their meaning and names are the same.

    Attributes:
        units: groups of edits that are applied together: a single edit, or several that share a node.
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
        return tuple(number for number, unit in enumerate(self.units) if unit[0].kind != "renamed")

    def formula(self, units: Collection[int]) -> Formula:
        """Return the old formula with some units of edits applied: those with the given indices."""
        sites = frozenset(site for site, unit in self._unit_of_site.items() if unit in units)
        built = _build(self._merged, sites)
        return Truth(True) if built is None else built


def _build(merged: Merged, chosen: frozenset[int]) -> Formula | None:
    if isinstance(merged, Site):
        return merged.new if merged.site in chosen else merged.old
    if not isinstance(merged, Inner):
        return merged
    head = merged.new if merged.site in chosen else merged.old
    operands = tuple(
        formula for operand in merged.operands if (formula := _build(operand, chosen)) is not None
    )
    if head.operator in ("and", "or") and len(operands) < 2:
        return operands[0] if operands else Truth(head.operator == "and")
    return replace(head, operands=operands)


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
    texts = tuple(parameter for parameter in atom.parameters if isinstance(parameter, str))
    # a signal's comparison has the parameters name, sign and limit; the limit can be a text, too
    texts = texts[:2] if atom.relation == "signal" else texts
    if atom.relation == "sum":
        zero = Number(0.0)
        return texts, map_leaves(atom.expression, lambda leaf: zero if isinstance(leaf, Number) else leaf)
    return texts, len(atom.parameters), tuple((type(term), format_term(base_of(term))) for term in atom.terms)


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
        origins: edits of the texts with the nodes that depend on them; other nodes have their own edits.
        specs: names of all specs in the old and in the new text.
    """
    comparison = _Comparison(regions, specs)
    merged = comparison.align(Place(old, 0, (name,), 0), Place(new, 0, (name,), 0))
    return comparison.join_sites(merged, origins)


def changed_nodes(old: Formula, new: Formula, regions: Mapping[str, Outline]) -> frozenset[int]:
    """Return the ids of the nodes of a new formula that differ from an old one, descendants included."""
    comparison = _Comparison(regions)
    comparison.align(Place(old, 0, ("",), 0), Place(new, 0, ("",), 0))
    sites = [site for site in comparison.sites if site.kind != "renamed"]
    return frozenset(number for site in sites for number in site.ids[1])


class _Comparison:
    """Alignment of two trees; meanings are numbered, so that equal nodes are found quickly."""

    def __init__(
        self, regions: Mapping[str, Outline], specs: tuple[Collection[str], Collection[str]] = ((), ())
    ) -> None:
        first: dict[Outline, str] = {}
        shapes = {name: first.setdefault(outline, name) for name, outline in regions.items()}
        self._alike = partial(_rename_regions, regions=shapes, without_groups=True)
        self._specs = specs
        self._renamed: set[tuple[str | None, str | None]] = set()
        self._numbers: dict[Hashable, int] = {}
        self._known: dict[int, tuple[Formula, int]] = {}
        self.sites: list[FoundSite] = []

    def meaning(self, node: Formula) -> int:
        """Return a number that is the same for nodes of equal meaning.

        Names, and the order of operands of commutative operators, do not matter.
        """
        entry = self._known.get(id(node))
        if entry is None:
            entry = self._known[id(node)] = (node, self._meaning(node))
        return entry[1]

    def _meaning(self, node: Formula) -> int:
        key: Hashable
        match node:
            case Truth():
                key = node.value
            case Atom():
                key = map_leaves(node.expression, partial(changed_leaf, change=self._alike))
            case Quantified():
                group = self._alike(node.group)
                key = (node.quantifier, len(node.variables), group, self.meaning(without_variables(node)))
            case Boolean(operator="spec"):
                return self.meaning(node.operands[0])
            case Boolean(operator="and" | "or" as operator):
                # brackets around operands of the same operator do not change the meaning
                members = Place(node, 0, ("",), 0).members(operator, through_names=True)
                key = (operator, tuple(sorted(self.meaning(member.node) for member in members)))
            case Boolean(operator="xor" | "<->"):
                key = (node.operator, tuple(sorted(map(self.meaning, node.operands))))
            case Boolean():
                key = (node.operator, tuple(map(self.meaning, node.operands)))
            case Temporal():
                key = (node.operator, node.bound, tuple(map(self.meaning, node.operands)))
        return self._numbers.setdefault(key, len(self._numbers))

    def align(self, old: Place, new: Place) -> Merged:
        """Compare two corresponding nodes."""
        names = old.node.name, new.node.name
        is_renamed = names[0] != names[1] and None not in names
        is_equal = self.meaning(old.node) == self.meaning(new.node)
        if is_renamed and not is_equal and (names[0] in self._specs[1] or names[1] in self._specs[0]):
            # the reference changed to another spec; neither spec was edited
            return self._site(FoundSite("replaced", old, new))
        if is_renamed:
            self._renamed.add(names)
            self.sites.append(FoundSite("renamed", old, new))
        if is_equal:
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
                site = None
                if old.node.bound != new.node.bound:
                    site = self._site(FoundSite("constant", old, new)).site
                return Inner(site, old.node, new.node, self._pairwise(old, new))
            case Quantified(), Quantified() if _ranges_alike(old.node, new.node):
                kind, subject = kind_of(old.node, new.node)
                return self._site(FoundSite(kind, old, new, subject, self._parts(old, new)))
        kind, subject = kind_of(old.node, new.node)
        return self._site(FoundSite(kind, old, new, subject))

    def _parts(self, old: Place, new: Place) -> tuple[FoundSite, ...]:
        """Return the differences of two quantifiers' bodies, each of which is evaluated as one node."""
        count = len(self.sites)
        bodies = [
            Place(place.node.body, place.id, place.specs, place.depth + 1)
            for place in (old, new)
            if isinstance(place.node, Quantified)
        ]
        self.align(bodies[0], bodies[1])
        inner, self.sites = self.sites[count:], self.sites[:count]

        def inside(place: Place | None, whole: Place) -> Place | None:
            return None if place is None else replace(place, id=whole.id)

        parts = chain(*(site.parts or (site,) for site in inner))
        return tuple(site._replace(old=inside(site.old, old), new=inside(site.new, new)) for site in parts)

    def join_sites(self, merged: Merged, origins: Sequence[Origin]) -> TreeDiff:
        """Join the sites of each edit, and return the edits."""
        declared = [origin for origin in origins if origin.change is not None]
        shared: list[tuple[set[int], list[int]]] = []
        rest: list[int] = []
        for number, site in enumerate(self.sites):
            followed = {index for index, origin in enumerate(declared) if site.follows_from(origin)}
            if not followed:
                rest.append(number)
                continue
            # declarations that share a node form one unit
            joined = [unit for unit in shared if unit[0] & followed]
            shared = [unit for unit in shared if not unit[0] & followed]
            shared.append(
                (
                    followed.union(*(unit[0] for unit in joined)),
                    [*chain(*(unit[1] for unit in joined)), number],
                )
            )
        units = [(min(sites), sites, sorted(followed)) for followed, sites in shared]
        joined_rest = self._join([self.sites[number] for number in rest])
        units += [(rest[sites[0]], [rest[number] for number in sites], []) for sites in joined_rest]
        units.sort()
        numbers = {site: unit for unit, (_, sites, _) in enumerate(units) for site in sites}
        text = [origin for origin in origins if origin.change is None]
        return TreeDiff(
            tuple(
                tuple(self._unit(sites, [declared[index] for index in followed], text))
                for _, sites, followed in units
            ),
            merged,
            numbers,
        )

    def _join(self, sites: Sequence[FoundSite]) -> Iterable[list[int]]:
        """Return the indices of sites, grouped by the edit of the specs' text that they depend on."""
        removed, added = (
            {
                self.meaning(place.node)
                for site in sites
                for place in (site.old, site.new)
                if place is not None and site.kind == kind
            }
            for kind in ("removed", "added")
        )
        joined: dict[Hashable, list[int]] = {}
        for number, site in enumerate(sites):
            places = site.old, site.new
            meanings = [None if place is None else self.meaning(place.node) for place in places]
            known_meanings = {meaning for meaning in meanings if meaning is not None}
            spans = tuple(None if place is None else place.node.span for place in places)
            specs = self._specs_of(site.old, site.new)[:1]
            key: Hashable = ("place", site.kind == "renamed", specs, *spans)
            if site.kind in ("added", "removed") and known_meanings <= removed & added:
                key = ("moved", *known_meanings)
            elif Span(0, 0) in spans:
                key = (site.kind, specs, *(_place_text(place, site.kind) for place in places), *meanings)
            joined.setdefault(key, []).append(number)
        return joined.values()

    def _specs_of(self, old: Place | None, new: Place | None) -> tuple[tuple[str, str], ...]:
        """Return the specs whose text contains both places, innermost first, by old and new name."""
        if old is None or new is None:
            return tuple((name, name) for place in (old, new) if place is not None for name in place.around)
        pairs = [(old_name, new_name) for new_name in new.specs for old_name in old.specs]
        return tuple(pair for pair in pairs if pair[0] == pair[1] or pair in self._renamed)

    def _unit(
        self, sites: Sequence[int], declared: Sequence[Origin], text: Sequence[Origin]
    ) -> Iterator[Edit]:
        """Yield the edits of a unit: first those of declarations, then those of the specs' text."""
        unit_sites = [self.sites[site] for site in sites]
        for origin in declared:
            if origin.change is not None:
                edit = self._edit([site for site in unit_sites if site.follows_from(origin)])
                yield replace(edit, kind=origin.change.kind, subject=origin.change.name, change=origin.change)
        if declared:
            text_sites = [site for site in unit_sites if any(site.follows_from(origin) for origin in text)]
        else:
            text_sites = list(chain(*(site.parts or (site,) for site in unit_sites)))
        for numbers in self._join(text_sites):
            yield self._edit([text_sites[number] for number in numbers])

    def _edit(self, sites: Sequence[FoundSite]) -> Edit:
        olds = [site.old for site in sites if site.old is not None]
        news = [site.new for site in sites if site.new is not None]
        kinds = {site.kind for site in sites}
        kind: EditKind = "moved" if kinds == {"added", "removed"} else sites[0].kind
        first_old, first_new = next(iter(olds), None), next(iter(news), None)
        if kind == "moved":
            specs = self._specs_of(first_old, None), self._specs_of(None, first_new)
        else:
            specs = (self._specs_of(first_old, first_new),) * 2
        return Edit(
            kind,
            specs[1][0][1],
            _place_text(first_old, kind),
            _place_text(first_new, kind),
            tuple(dict.fromkeys(place.id for place in olds)),
            tuple(dict.fromkeys(place.id for place in news)),
            None if first_old is None else first_old.node.span,
            None if first_new is None else first_new.node.span,
            max(place.depth for place in (*olds, *news)),
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

    def _match(self, old_node: Any, olds: Sequence[Place], new_node: Any, news: Sequence[Place]) -> Inner:
        """Match the operands of a conjunction or disjunction: by meaning, then by name, then similar ones."""
        partner: dict[int, int] = {}
        matched_indices: set[int] = set()

        def match(fits: Any) -> None:
            for number, new in enumerate(news):
                for index, old in enumerate(olds if number not in partner else ()):
                    if index not in matched_indices and fits(old, new):
                        partner[number] = index
                        matched_indices.add(index)
                        break

        match(lambda old, new: self.meaning(old.node) == self.meaning(new.node))
        match(lambda old, new: old.node.name is not None and old.node.name == new.node.name)
        # the most similar pairs first, so that they get each other as partners
        for least in (1.0, 0.5, 0.01):
            match(lambda old, new, least=least: _is_alike(old, new, least, by_operator=True))
        match(lambda old, new: _is_alike(old, new, 0.5, by_operator=False))
        operands: list[Merged] = [
            self.align(olds[partner[number]], new)
            if number in partner
            else self._site(FoundSite("added", None, new))
            for number, new in enumerate(news)
        ]
        left = [old for index, old in enumerate(olds) if index not in matched_indices]
        operands += [self._site(FoundSite("removed", old, None)) for old in left]
        return Inner(None, old_node, new_node, tuple(operands))


def _is_alike(old: Place, new: Place, least: float, *, by_operator: bool) -> bool:
    """Return whether two nodes are similar enough, and on request whether they have the same operator."""
    old_node, new_node = old.bare.node, new.bare.node
    return (not by_operator or operator_of(old_node) == operator_of(new_node)) and similarity(
        old_node, new_node
    ) >= least


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
