"""Random specifications: terms, atoms, formulas of every operator, whole texts.

Everything is drawn as text, in the spellings that the language allows, so that a law about values
does not depend on how they are written out. `formulas` gives parsed ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from hypothesis import strategies as st

from spatial_replay import parse_specification
from spatial_replay.spec.formula import Formula

OBJECTS = ("a", "b", "c")
PARAMETER_RELATIONS = ("closeto", "farfrom", "touch", "moved")
PLAIN_RELATIONS = (
    "ovlp", "enclosedin", "partovlp", "leftof", "rightof", "below", "above", "partleftof", "partrightof",
    "partbelow", "partabove",
)  # fmt: skip
TITLES = (' "REQ-12: no one is hit"', ' "id: a: b"', ' "no id: here"', r' "\"quoted\" \\ text"', ' ":  x "')
COMPARISONS = ("<=", "<", ">=", ">", "==")


@dataclass(frozen=True)
class Vocabulary:
    """What drawn formulas may speak of, and how.

    Attributes:
        objects: names of tracked objects.
        classes: classes of open groups; none for no open groups.
        signals: names of numeric signals; none for no comparisons.
        regions, groups: names that the text around defines.
        axes: for the relations along an axis.
        delays: whether terms may be those of an earlier sample.
        rates: whether rates of change are compared, and whether objects are present.
        future, past: whether such operators are drawn.
        times: whether windows may be in seconds.
        quantifiers: whether open quantifiers are drawn (over `all` and `classes`).
        max_depth: operators within one another.
    """

    objects: Sequence[str] = OBJECTS
    classes: Sequence[str] = ()
    signals: Sequence[str] = ()
    regions: Sequence[str] = ()
    groups: Sequence[str] = ()
    axes: Sequence[str] = ("x", "y")
    delays: bool = True
    rates: bool = False
    oriented: bool = False
    future: bool = True
    past: bool = True
    times: bool = True
    quantifiers: bool = False
    max_depth: int = 4


numbers = st.one_of(
    st.integers(0, 9).map(str),
    st.decimals(0, 5, places=2, allow_nan=False).map(str),
    st.floats(0.0, 1e3, allow_nan=False).map(repr),
)


@st.composite
def terms(draw: st.DrawFn, words: Vocabulary) -> str:
    kinds = ["object", "object"]
    kinds += ["delayed"] if words.delays else []
    kinds += ["enlarged", "centre"]
    kinds += ["region"] if words.regions else []
    kinds += ["group", "except"] if words.groups else []
    kinds += ["class", "all except"] if words.classes else []
    tracked = draw(st.sampled_from(words.objects))
    match draw(st.sampled_from(kinds)):
        case "delayed":
            return tracked + draw(st.sampled_from(["[-1]", "[-2]", "[-0.5s]", "[- 250ms]"]))
        case "enlarged":
            return f"enlarge({tracked}, {draw(numbers)})"
        case "centre":
            return f"center({tracked})"
        case "region":
            return draw(st.sampled_from(words.regions))
        case "group":
            return draw(st.sampled_from(words.groups))
        case "except":
            return f"({draw(st.sampled_from(words.groups))} except {tracked})"
        case "class":
            return f'class "{draw(st.sampled_from(words.classes))}"'
        case "all except":
            return f"(all except {tracked})"
    return tracked


def signals(words: Vocabulary) -> st.SearchStrategy[str]:
    return st.sampled_from(words.signals)


def sums(words: Vocabulary) -> st.SearchStrategy[str]:
    """Texts of numbers that are computed from signals, distances and rates of signals."""
    distances = st.tuples(terms(words), terms(words)).map(lambda pair: f"({pair[0]} dist {pair[1]})")
    measured = [signals(words), distances]
    measured += [signals(words).map(lambda name: f"rate({name})")] if words.rates else []
    factors = st.sampled_from(["2", "0.3", "-1.5", "1e3"])
    return st.recursive(
        st.one_of(*measured),
        lambda inner: st.one_of(
            st.tuples(inner, st.sampled_from("+-"), st.one_of(inner, numbers)).map(
                lambda parts: f"({' '.join(parts)})"
            ),
            st.tuples(factors, inner).map(" * ".join),
            st.tuples(inner, factors).map(" / ".join),
            inner.map(lambda text: f"abs({text})"),
            inner.map(lambda text: f"-({text})"),
        ),
        max_leaves=3,
    )


@st.composite
def atoms(draw: st.DrawFn, words: Vocabulary) -> str:
    """The text of a relation or comparison; parameters are always written."""
    kinds = ["plain", "parameter", "dist", "within", "closer", "prec", "between"]
    kinds += ["signal", "sum", "range"] if words.signals else []
    kinds += ["present", "speed", "closing", *(["rate"] if words.signals else [])] if words.rates else []
    kinds += ["oriented"] if words.oriented else []
    first, second = draw(terms(words)), draw(terms(words))
    tracked = draw(st.sampled_from(words.objects))
    match draw(st.sampled_from(kinds)):
        case "parameter":
            return f"{first} {draw(st.sampled_from(PARAMETER_RELATIONS))}[{draw(numbers)}] {second}"
        case "dist":
            return f"{first} dist {second} {draw(st.sampled_from(COMPARISONS))} {draw(numbers)}"
        case "within":
            return f"{draw(numbers)} <= {first} dist {second} < {draw(numbers)}"
        case "closer":
            return f"{first} closer {second} than {draw(terms(words))}"
        case "prec":
            relation = draw(st.sampled_from(["prec", "partprec"]))
            return f"{first} {relation}[{draw(st.sampled_from(words.axes))}] {second}"
        case "between":
            axis = draw(st.sampled_from(words.axes))
            return f"{first} between[{axis}] ({second}, {draw(terms(words))})"
        case "signal":
            comparison = draw(st.sampled_from((*COMPARISONS, "!=")))
            return f"{draw(st.sampled_from(words.signals))} {comparison} {draw(numbers)}"
        case "sum":
            sign = draw(st.sampled_from(COMPARISONS[:-1]))
            measured = f"{draw(signals(words))} - {draw(sums(words))}"
            return f"{measured} {sign} {draw(st.one_of(numbers, sums(words)))}"
        case "range":
            return f"{draw(numbers)} <= {draw(sums(words))} < {draw(sums(words))} + {draw(signals(words))}"
        case "rate":
            signal, comparison = draw(st.sampled_from(words.signals)), draw(st.sampled_from(COMPARISONS))
            return f"rate({signal}) {comparison} {draw(numbers)}"
        case "present":
            return f"present({tracked})"
        case "speed":
            return f"{draw(numbers)} <= speed({tracked}) < {draw(numbers)}"
        case "closing":
            first, second = (draw(terms(replace(words, delays=False))) for _ in range(2))
            return f"speed({first}, {second}) {draw(st.sampled_from(COMPARISONS))} {draw(numbers)}"
        case "oriented":
            one, other = (draw(st.sampled_from(words.objects)) for _ in range(2))
            return f"{one} oriented[{draw(numbers)}] {other}"
    return f"{first} {draw(st.sampled_from(PLAIN_RELATIONS))} {second}"


@st.composite
def bounds(draw: st.DrawFn, words: Vocabulary) -> str:
    """The text of a window; "" for none."""
    kind = draw(st.sampled_from(["none", "samples", "open", *(["times"] if words.times else [])]))
    lower = draw(st.integers(0, 3))
    upper = lower + draw(st.integers(0, 3))
    match kind:
        case "samples":
            return f"[{lower}, {upper}]"
        case "open":
            return f"[{lower},inf]"
        case "times":
            return f"[{lower * 100}ms, {upper / 10}s]"
    return ""


def formula_texts(words: Vocabulary) -> st.SearchStrategy[str]:
    """Texts of formulas, every operand in brackets."""
    return _formulas(words, words.max_depth)


def _formulas(words: Vocabulary, depth: int) -> st.SearchStrategy[str]:
    leaves = st.one_of(atoms(words), atoms(words), atoms(words), st.sampled_from(["true", "false"]))
    if depth <= 1:
        return leaves
    inner = st.deferred(lambda: _formulas(words, depth - 1))
    return st.one_of(leaves, _compound(words, inner, depth))


@st.composite
def _compound(draw: st.DrawFn, words: Vocabulary, inner: st.SearchStrategy[str], depth: int) -> str:
    kinds = ["not", "chain", "pair"]
    kinds += ["next", "future", "until"] if words.future else []
    kinds += ["yesterday", "past", "since"] if words.past else []
    kinds += ["quantifier"] if words.quantifiers else []
    match draw(st.sampled_from(kinds)):
        case "not":
            return f"{draw(st.sampled_from(['not', '!']))} ({draw(inner)})"
        case "chain":
            operator = draw(st.sampled_from(["and", "or", "&", "|"]))
            return f" {operator} ".join(f"({draw(inner)})" for _ in range(draw(st.integers(2, 3))))
        case "pair":
            operator = draw(st.sampled_from(["xor", "->", "<->", "implies"]))
            return f"({draw(inner)}) {operator} ({draw(inner)})"
        case "next":
            return f"{draw(st.sampled_from(['X', 'WX']))} ({draw(inner)})"
        case "future":
            return f"{draw(st.sampled_from('FG'))}{draw(bounds(words))} ({draw(inner)})"
        case "until":
            return f"({draw(inner)}) {draw(st.sampled_from('URW'))}{draw(bounds(words))} ({draw(inner)})"
        case "yesterday":
            return f"Y ({draw(inner)})"
        case "past":
            return f"{draw(st.sampled_from('OH'))}{draw(bounds(words))} ({draw(inner)})"
        case "since":
            return f"({draw(inner)}) S{draw(bounds(words))} ({draw(inner)})"
    group = draw(st.sampled_from(["all", "(all except a)", *(f'class "{name}"' for name in words.classes)]))
    variables = draw(st.sampled_from(["m", "m, n"]))
    over = replace(
        words, objects=(*words.objects, *variables.split(", ")), future=False, past=False, quantifiers=False
    )
    body = draw(_formulas(over, min(depth - 1, 2)))
    return f"{draw(st.sampled_from(['forall', 'exists']))} {variables} in {group}: ({body})"


def formulas(words: Vocabulary | None = None, profile: str = "paper") -> st.SearchStrategy[Formula]:
    """Parsed formulas without a name; `regions` and `groups` must be empty."""

    def parsed(text: str) -> Formula:
        return replace(parse_specification(text, profile=profile).specs[0].formula, name=None)

    return formula_texts(words if words is not None else Vocabulary()).map(parsed)


_FULL = Vocabulary(
    objects=("a", "b", '"/odd name"', '"F"'),
    classes=("person",),
    signals=("battery", '"air temperature"'),
    regions=("goal", "table"),
    groups=("reds", "people", "everyone"),
    axes=("x", "y", "z"),
    rates=True,
    oriented=True,
    quantifiers=True,
    max_depth=3,
)


@st.composite
def specification_texts(draw: st.DrawFn) -> str:
    """Whole texts: definitions of every kind, and specs that use them."""
    profile = draw(st.sampled_from(["", "use paper", "use spatial_spec"]))
    argument = draw(st.sampled_from(_FULL.objects))
    height = draw(st.sampled_from(["", " height (0, near)"]))
    title = draw(st.sampled_from(["", *TITLES]))
    named = replace(_FULL, objects=(*_FULL.objects, "r", "q"), quantifiers=False)
    in_macro = replace(_FULL, objects=(*_FULL.objects, "p"))
    template = replace(_FULL, objects=(*_FULL.objects, "ego"))
    lines = [
        profile,
        "const near = 1.5   # in metres",
        "const settle = 2s",
        draw(st.sampled_from(["", "scale battery = near * 2", "scale lengths = 0.1"])),
        f"region goal = box(-1, {draw(numbers)}, near, 10000){height}",
        f"region table = circle((0, -2.5), {draw(numbers)})",
        "region tri = polygon((0, 0), (4, 1), (1, 4))",
        "group reds = red1, red2, a",
        'group people = class "person"',
        "group everyone = all",
        f"def near_it(p, e) = p closeto[e] b and ({draw(formula_texts(in_macro))})",
        f"spec first = {draw(formula_texts(_FULL))}",
        f"spec each = forall r, q in (reds except a): {draw(formula_texts(named))}",
        f"spec both = F[0, settle] first ->\n    (each or near_it({argument}, near))",
        f"spec ahead(ego){title} = {draw(formula_texts(template))}",
        f"spec again{title} = both",
    ]
    end = draw(st.sampled_from(["\n", "\r\n"]))
    return draw(st.sampled_from(["", "\ufeff"])) + end.join(lines) + end


_SIGNS = 'abFGXUSt()[],:=-<>!&|"\\#.\n\r\t é\x00'
_WORDS = (
    "spec", "def", "group", "region", "const", "use", "paper", "forall", "exists", "in", "all", "class",
    "except", "enlarge", "center", "dist", "closer", "than", "between", "ovlp", "closeto", "prec", "polygon",
    "box", "circle", "height", "->t", "!t", "<->", "1", "2.5", "3s", "inf", "and", "or", "not", "s1",
    "oriented", "true", "<=", "((", "))", "[-1]",
)  # fmt: skip
_PHRASES = ("(a ovlp b)", "spec s1 = ", "\nspec s2 = s1")
_PIECES = st.sampled_from([*_SIGNS, *_WORDS, *_PHRASES])

noise = st.one_of(
    st.text(max_size=80),
    st.lists(_PIECES, max_size=40).map("".join),
    st.lists(_PIECES, max_size=40).map(" ".join),
)
"""Texts that are hardly ever specifications."""
