"""What a text means: statements, names, groups, macros, quantifiers, templates, windows."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import spatial_replay.spec
from spatial_replay import (
    MissingFileError,
    SpecificationError,
    UsageError,
    load_specification,
    parse_specification,
)
from spatial_replay.spec import check_names, format_formula, format_specification, object_names
from spatial_replay.spec.formula import (
    ANY_CLASS,
    Atom,
    Boolean,
    Bound,
    Centre,
    Constant,
    Earlier,
    Enlarged,
    Expression,
    Formula,
    Group,
    Quantified,
    RegionName,
    SignedDistance,
    Temporal,
    Term,
    TrackedName,
    Truth,
    Variable,
    minimum,
)


def formula_of(text: str, **options: str) -> Formula:
    return parse_specification(text, **options).specs[-1].formula


def atom_of(text: str, **options: str) -> Atom:
    formula = formula_of(text, **options)
    assert isinstance(formula, Atom)
    return formula


def test_the_example_of_the_reference_has_its_structure() -> None:
    specification = parse_specification(
        """# blocks
use spatial_spec
const near = 70
region redGoal = polygon((50,120), (250,120), (250,350), (50,350))
region shelf = box(0, 0, 1, 0.3) height (1.2, 1.6)
group reds = red1, red2
def passes_below(a, b) = a closeto[near] b -> a below b
spec reach = F (forall r in reds: r enclosedin redGoal)
spec passage = (G passes_below(red1, blue1)) and (G passes_below(red2, blue1))
spec blocks = reach and passage
"""
    )
    reach, passage, blocks = specification.specs
    assert [spec.name for spec in specification.results] == ["blocks"]
    assert isinstance(blocks.formula, Boolean)
    assert blocks.formula.operands == (reach.formula, passage.formula)
    assert format_formula(reach.formula) == "F ((red1 enclosedin redGoal) and (red2 enclosedin redGoal))"
    assert "G ((red2 closeto[70] blue1) -> (red2 below blue1))" in format_formula(passage.formula)
    assert specification.regions["shelf"].height == (1.2, 1.6)
    assert specification.profile == "spatial_spec"


@pytest.mark.parametrize(
    "text",
    [
        "F (a ovlp b)\nand\n\n(c ovlp d)",
        "use paper\nF\n(a ovlp b) # reach\nand (c\novlp d)",
        "spec s =\n  F[0,\n 5]\n a ovlp b and\n c ovlp d",
        "spec s = F (a ovlp b)\n# a remark\n\n  and (c ovlp d)",
        "\ufeffspec s = forall x in all:\r\n  x ovlp a\r\n",
    ],
)
def test_a_statement_continues_after_a_line_that_cannot_end_it(text: str) -> None:
    assert len(parse_specification(text).specs) == 1


def test_a_statement_ends_with_its_line() -> None:
    specification = parse_specification("spec s = a ovlp b\nspec t = c ovlp d")
    assert [spec.name for spec in specification.specs] == ["s", "t"]
    with pytest.raises(SpecificationError, match="expected a statement"):
        parse_specification("spec s = a ovlp b\n(c ovlp d)")


def test_chains_are_one_node_and_brackets_another() -> None:
    flat = formula_of("(a ovlp b) and (b ovlp c) and (c ovlp d)")
    nested = formula_of("((a ovlp b) and (b ovlp c)) and (c ovlp d)")
    assert isinstance(flat, Boolean) and len(flat.operands) == 3
    assert isinstance(nested, Boolean) and len(nested.operands) == 2


def test_a_spec_that_repeats_another_is_a_node_above_it() -> None:
    specification = parse_specification("spec s = a ovlp b\nspec t = (s)")
    first, second = specification.specs
    assert second.formula == Boolean("spec", (first.formula,), name="t")


def test_quantifiers_over_named_groups_are_their_instances() -> None:
    group = "group g = a, b\ngroup one = a\n"
    assert formula_of(group + "spec s = forall x in g: x ovlp c") == formula_of(
        "spec s = a ovlp c and b ovlp c"
    )
    assert formula_of(group + "spec s = exists x, y in g: x leftof y") == formula_of(
        "spec s = a leftof b or b leftof a"
    )
    assert formula_of(group + "spec s = forall x in one: x ovlp c") == formula_of("spec s = a ovlp c")
    assert formula_of(group + "spec s = forall x in (one except a): x ovlp c") == Truth(True, name="s")
    assert formula_of(group + "spec s = exists x, y in one: x ovlp y") == Truth(False, name="s")


def test_quantifiers_over_open_groups_bind_a_variable() -> None:
    formula = formula_of('exists m in (class "Cup" except a)[-2]: m ovlp b')
    assert isinstance(formula, Quantified) and isinstance(formula.body, Atom)
    assert formula.group == Earlier(Group("", class_name="Cup", excluded=(TrackedName("a"),)), samples=2)
    assert formula.body.terms == (Variable("m"), TrackedName("b"))


def test_macros_do_not_capture_their_arguments() -> None:
    formula = formula_of(
        'def near(a) = exists m in all: a closeto[1] m\nspec s = forall m in all: near(m) and near("m")'
    )
    assert isinstance(formula, Quantified) and isinstance(formula.body, Boolean)
    inner = formula.body.operands[0]
    assert isinstance(inner, Quantified) and isinstance(inner.body, Atom)
    outer, bound = inner.body.terms
    assert outer == Variable(formula.variables[0]) and bound == Variable(inner.variables[0])
    assert outer != bound


def test_groups_stand_for_their_members() -> None:
    text = 'group g = a, b\ngroup people = class "person"\ngroup everyone = all\nspec s = {} ovlp c'
    for written, term in {
        "g": Group("g", ("a", "b")),
        "people[-3]": Earlier(Group("people", class_name="person"), samples=3),
        "(everyone except c)": Group("everyone", class_name=ANY_CLASS, excluded=(TrackedName("c"),)),
        "enlarge(g, 2)[-1s]": Enlarged(Earlier(Group("g", ("a", "b")), duration_ns=10**9), 2.0),
        "center(a)[-2]": Centre(Earlier(TrackedName("a"), samples=2)),
        "center(enlarge(center(a), 1))": Centre(TrackedName("a")),
        "enlarge(center(g), 1)": Enlarged(Centre(Group("g", ("a", "b"))), 1.0),
    }.items():
        assert atom_of(text.format(written)).terms[0] == term


@pytest.mark.parametrize(
    ("window", "bound"),
    [
        ("[0, 5]", Bound(0, 5, "samples")),
        ("[0.5s, 2s]", Bound(500_000_000, 2_000_000_000, "ns")),
        ("[0, 500ms]", Bound(0, 500_000_000, "ns")),
        ("[2s, inf]", Bound(2_000_000_000, None, "ns")),
        ("[0, inf]", Bound(0, None, "samples")),
        ("[3, 3]", Bound(3, 3, "samples")),
        ("[1e-9s, 1e2ms]", Bound(1, 100_000_000, "ns")),
    ],
)
def test_windows_are_read_in_samples_or_nanoseconds(window: str, bound: Bound) -> None:
    for text in (f"F{window} a ovlp b", f"a ovlp b S{window} c ovlp d"):
        formula = formula_of(text)
        assert isinstance(formula, Temporal) and formula.bound == bound


def test_constants_stand_for_numbers_and_durations_and_can_be_replaced() -> None:
    text = "const e = far\nconst far = 2.5\nconst wait = 2s\nspec s = F[0, wait] a[-wait] closeto[e] b"
    expected = "F[0s, 2s] (a[-2s] closeto[{}] b)"
    assert format_formula(parse_specification(text).specs[0].formula) == expected.format("2.5")
    replaced = parse_specification(text, constants={"far": 7}).specs[0].formula
    assert format_formula(replaced) == expected.format("7")
    with pytest.raises(UsageError, match="did you mean 'far'"):
        parse_specification(text, constants={"fra": 7})
    slower = parse_specification(text, constants={"wait": "500ms"}).specs[0].formula
    assert format_formula(slower) == "F[0s, 0.5s] (a[-0.5s] closeto[2.5] b)"
    for value in ("2", "2 s", "s", "1e400s", "nans", float("nan"), 10**400, True, None):
        with pytest.raises(UsageError, match="'wait'"):
            parse_specification(text, constants={"wait": value})  # type: ignore[dict-item]


def test_a_specification_lists_its_constants() -> None:
    text = "const e = far\nconst far = 2.5\nconst wait = 2s\nspec s = F[0, wait] a closeto[e] b"
    constants = parse_specification(text, constants={"far": 7}).constants
    assert constants == {
        "e": Constant(7.0, is_computed=True),
        "far": Constant(7.0),
        "wait": Constant(2.0, 2_000_000_000),
    }


@pytest.mark.parametrize(
    ("written", "value"),
    [
        ("near * 2", "6"),
        ("near + 1 - 2", "2"),
        ("near - 1 * 2", "1"),
        ("(near - 1) * 2", "4"),
        ("-near + 10", "7"),
        ("0.1 * 30", "3"),
        ("wait / 500ms", "4"),
        ("(wait + 1s) / wait", "1.5"),
    ],
)
def test_arithmetic_stands_wherever_a_constant_may(written: str, value: str) -> None:
    head = "const near = 3\nconst wait = 2s\n"
    text = f"{head}const e = {written}\nspec s = (a closeto[{written}] b) and (a closeto[e] b)"
    formula = parse_specification(text).specs[0].formula
    assert format_formula(formula) == f"(a closeto[{value}] b) and (a closeto[{value}] b)"
    text = (
        f"{head}def near_it(x, e) = enlarge(x, e + 1 - 1) dist b <= {written}\nspec s = near_it(a, {written})"
    )
    formula = parse_specification(text).specs[0].formula
    assert format_formula(formula) == f"enlarge(a, {value}) dist b <= {value}"


def test_durations_are_computed_in_windows_and_delays() -> None:
    text = "const wait = 2s\nspec s = F[wait / 4, wait * 1.5] (a[-(wait + 1s)] closeto[1 + 1] b[-wait-1s])"
    formula = parse_specification(text).specs[0].formula
    assert format_formula(formula) == "F[0.5s, 3s] (a[-3s] closeto[2] b[-3s])"
    chained = parse_specification("const n = 2\nspec s = n * 2 <= a dist b < (n + 1) * 2").specs[0].formula
    assert format_formula(chained) == "4 <= a dist b < 6"


def test_a_value_given_for_a_constant_has_its_unit_and_keeps_its_range() -> None:
    text = "const near = 70 in [40, 100]  # pixels\nconst wait = 2s\nspec s = F[0s, wait] a closeto[near] b"
    changed = parse_specification(text, constants={"near": "80", "wait": "500ms"})
    assert changed.source == text.replace("70", "80").replace("2s", "0.5s")
    assert format_formula(changed.specs[0].formula) == "F[0s, 0.5s] (a closeto[80] b)"
    assert changed.constants["near"] == Constant(80.0, None, (40.0, 100.0))
    with pytest.raises(UsageError, match="'near' cannot be '2s': it is a number, 70 in the text"):
        parse_specification(text, constants={"near": "2s"})
    with pytest.raises(UsageError, match="'wait' cannot be 2: it is a duration, 2s in the text"):
        parse_specification(text, constants={"wait": 2})
    with pytest.raises(SpecificationError, match=r"170 is outside of the range \[40, 100\]"):
        parse_specification(text, constants={"near": 170})


@pytest.mark.parametrize(
    ("written", "meaning"),
    [
        ("always (a ovlp b)", "G (a ovlp b)"),
        ("always[0s:5s] a ovlp b", "G[0s, 5s] (a ovlp b)"),
        ("eventually[0s, 2s] next a ovlp b", "F[0s, 2s] (X (a ovlp b))"),
        ("(a ovlp b) until (c ovlp d)", "(a ovlp b) U (c ovlp d)"),
        ("a closeto[3] b until[0s, 3s] c ovlp d", "(a closeto[3] b) U[0s, 3s] (c ovlp d)"),
        ("once (a ovlp b) since historically a ovlp b", "O ((a ovlp b) S (H (a ovlp b)))"),
        ("a ovlp b && c ovlp d || NOT e ovlp f", "(a ovlp b and c ovlp d) or (not e ovlp f)"),
        ("a ovlp b AND c ovlp d => e ovlp f", "(a ovlp b and c ovlp d) -> e ovlp f"),
    ],
)
def test_spellings_of_other_tools_are_read_where_they_are_clear(written: str, meaning: str) -> None:
    assert parse_specification(written) == parse_specification(meaning)


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("always ovlp until and next ovlp always", ["always", "until", "next"]),
        ("always always ovlp until until until ovlp next", ["always", "until", "next"]),
        ("always[-1] ovlp until[-2] and AND ovlp f", ["always", "until", "AND", "f"]),
        ("use paper\nnext ovlp once", ["next", "once"]),
        ("group g = always, until\nspec s = G (g ovlp scale)", ["always", "until", "scale"]),
        ("def next(a) = a ovlp x\nspec s = next(f) and next(g)", ["f", "x", "g"]),
        ('eventually ("until" ovlp "always")', ["until", "always"]),
    ],
)
def test_objects_may_be_called_like_words_of_other_tools(text: str, names: list[str]) -> None:
    assert list(object_names(parse_specification(text))) == names


def test_specs_may_be_called_like_words_of_other_tools() -> None:
    text = "spec always = a ovlp b\nspec s = always and (always until always)"
    formula = parse_specification(text).specs[1].formula
    assert format_formula(formula) == "(a ovlp b) and ((a ovlp b) U (a ovlp b))"


def test_relations_can_be_added_in_python() -> None:
    def near_but_apart(a: Term, b: Term, most: float, least: float = 0.5) -> Expression:
        return minimum(SignedDistance(a, b) - least, most - SignedDistance(a, b))

    relations = {"near_but_apart": near_but_apart}
    specification = parse_specification("a near_but_apart[3] b", relations=relations)
    atom = specification.specs[0].formula
    assert isinstance(atom, Atom)
    assert atom.text == "a near_but_apart[3, 0.5] b"
    assert atom.expression == near_but_apart(TrackedName("a"), TrackedName("b"), 3.0)
    for wrong in ({"ovlp": near_but_apart}, {"until": lambda a: a}, {"a b": near_but_apart}):
        with pytest.raises(UsageError, match="relations: "):
            parse_specification("a ovlp b", relations=wrong)


def test_quoted_names_may_hold_any_character() -> None:
    atom = atom_of('"/robot1/base \\"link\\" \\\\" ovlp "F"')
    assert atom.terms == (TrackedName('/robot1/base "link" \\'), TrackedName("F"))
    assert atom_of(atom.text).terms == atom.terms


def test_regions_hide_objects_of_their_name() -> None:
    assert atom_of("region g = box(0, 0, 1, 1)\nspec s = a ovlp g").terms[1] == RegionName("g")


def test_nodes_know_where_they_come_from() -> None:
    text = "def f(a) = a ovlp b\nspec s = F (f(c) and x ovlp y)"
    specification = parse_specification(text)
    formula = specification.specs[0].formula
    assert isinstance(formula, Temporal)
    both = formula.operands[0]
    assert isinstance(both, Boolean)
    places = [specification.source[each.span.start : each.span.end] for each in both.operands]
    assert places == ["f(c)", "x ovlp y"]


def test_files_are_read_and_missing_ones_reported(tmp_path: Path) -> None:
    path = tmp_path / "reach.spatial"
    path.write_bytes("\ufeffspec s = a ovlp b\r\n".encode())
    assert load_specification(path).filename == "reach.spatial"
    with pytest.raises(MissingFileError, match="nothing"):
        load_specification(tmp_path / "nothing.spatial")
    path.write_bytes(b"spec s = a\n  ovlp \xff")
    with pytest.raises(SpecificationError, match=re.escape("reach.spatial:2:8")):
        load_specification(path)


@pytest.mark.parametrize("name", spatial_replay.spec.__all__)
def test_the_package_exports_every_name_of_the_language(name: str) -> None:
    assert callable(getattr(spatial_replay.spec, name))
    assert name in dir(spatial_replay.spec)


def test_the_package_has_no_other_names() -> None:
    with pytest.raises(AttributeError, match="no attribute 'parse_everything'"):
        _ = spatial_replay.spec.parse_everything


# ------------------------------------------------------------------------------------------------ titles


@pytest.mark.parametrize(
    ("text", "identifier", "title"),
    [
        ("spec calm = a ovlp b", None, None),
        ('spec calm "REQ-12: no one is hit" = a ovlp b', "REQ-12", "no one is hit"),
        ('spec calm "no one is hit" = a ovlp b', None, "no one is hit"),
        ('spec calm "REQ-12" = a ovlp b', None, "REQ-12"),
        ('spec calm "in short: no one is hit" = a ovlp b', None, "in short: no one is hit"),
        ('spec calm "R-1: first: then" = a ovlp b', "R-1", "first: then"),
        ('spec calm(ego) "REQ-12: no one is hit" = ego ovlp b', "REQ-12", "no one is hit"),
    ],
)
def test_a_spec_has_the_id_of_its_requirement_and_a_title(
    text: str, identifier: str | None, title: str | None
) -> None:
    specification = parse_specification(text)
    spec = specification.specs[0]
    assert (spec.id, spec.title) == (identifier, title)
    again = parse_specification(format_specification(specification)).specs[0]
    assert (again.id, again.title) == (identifier, title)


def test_a_title_names_no_object() -> None:
    specification = parse_specification('spec calm "cup" = G (cup ovlp plate)')
    (diagnosis,) = check_names(specification, ["plate"], [])
    assert diagnosis.column == len('spec calm "cup" = G (') + 1


def test_a_class_in_the_place_of_an_object_gets_the_spelling_of_a_class() -> None:
    specification = parse_specification("G (person dist robot >= 1)")
    (diagnosis,) = check_names(specification, ["robot"], [], classes=["Person"])
    assert 'write class "Person" for all of them' in diagnosis.hint


def test_center_is_a_name_unless_a_bracket_follows() -> None:
    text = "F (cup leftof center and center dist cup <= 0.2 and (center above cup))"
    assert set(object_names(parse_specification(text))) == {"cup", "center"}
    written = format_formula(formula_of(text))
    assert '"center"' not in written and formula_of(written) == formula_of(text)
    inner = atom_of("center(center) enclosedin center")
    assert inner.terms == (Centre(TrackedName("center")), TrackedName("center"))
    called = parse_specification("def center(a) = a leftof b\nspec s = center(cup)")
    assert object_names(called) == ("b", "cup")
