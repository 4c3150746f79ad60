"""What a user reads when a specification is wrong, or odd."""

from __future__ import annotations

import sys
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from cli.program import run
from spatial_replay import (
    Footprint,
    Sample,
    SpecificationError,
    Trace,
    UsageError,
    evaluate,
    load_specification,
    parse_specification,
)
from spatial_replay.spec import check_names
from spatial_replay.spec.diagnostics import MAX_FAULTS


def faults_of(text: str) -> list[str]:
    with pytest.raises(SpecificationError) as caught:
        parse_specification(text, filename="x.spatial")
    return [str(diagnosis) for diagnosis in caught.value.diagnoses]


DEFINITIONS = """region goal = box(0, 0, 1, 1)
group reds = red1, red2
group everyone = all
const near = 3
const wait = 2s
def f(a, e) = a closeto[e] goal
spec earlier = a ovlp goal
spec template(ego) = ego ovlp goal
"""


@pytest.mark.parametrize(
    ("statement", "where", "message", "hint"),
    [
        ("spec s = a closeto[0,1] b", "closeto", "takes 1 parameter, not 2", "decimals have a point: 0.1"),
        ("spec s = a closeto(5) b", "5", "'5' cannot stand here", "square brackets: closeto[5]"),
        ("spec s = a closeto 5 b", "5", "'5' cannot stand here", "square brackets: closeto[5]"),
        ("spec s = F[0,5]s a ovlp b", "a", "'s' cannot stand here", "each number has its unit: [0s, 5s]"),
        ("spec s = robot_1/base ovlp b", "ovlp", "needs an object", 'in quotes: "robot_1/base"'),
        ("G (a-group ovlp b)", "G", "expected a statement", 'is written in quotes: "a-group"'),
        ("spec s = F[5s] a ovlp b", "]", "']' cannot stand here", "both of its ends: F[0, 5s]"),
        ("spec s = F<=5s a ovlp b", "<=", "'<=' cannot stand here", "both of its ends: F[0, 5s]"),
        ("spec s = G[>=2s] a ovlp b", ">=", "'>=' cannot stand here", "both of its ends: G[2s, inf]"),
        ("spec s = F[0..5] a ovlp b", ".5", "'.5' cannot stand here", "both of its ends: F[0, 5]"),
        ("spec s = F(0,5) a ovlp b", ",", "',' cannot stand here", "both of its ends: F[0, 5]"),
        ("spec s = F{0,5} (a ovlp b)", "{", "the character '{'", "square brackets: F[0, 5s]"),
        ("spec s = ev_[0,5] (a ovlp b)", "ev_", "'ev_' is not an operator", "is written F"),
        ("spec s = [] (a ovlp b)", "[]", "'[]' is not an operator", "as in G (a ovlp b)"),
        ("spec s = <> a ovlp b", "<>", "'<>' is not an operator", "as in F (a ovlp b)"),
        ("spec s = Finally (a ovlp b)", "Finally", "'Finally' is not an operator", "as in F (a ovlp b)"),
        ("spec s = globally a ovlp b", "globally", "'globally' is not an operator", "as in G (a ovlp b)"),
        ("spec s = never a ovlp b", "never", "'never' is not an operator", "as in G not (a ovlp b)"),
        ("spec s = G (previously earlier)", "previously", "'previously' is not an operator", "is written Y"),
        ("spec s = GF earlier", "GF", "'GF' is not an operator", "is written G F"),
        ("spec s = P (a ovlp b)", "P", "'P' is not an operator", "is written O"),
        ("def s := a ovlp b", ":", "'s' has no parameters", "named by spec s = ..."),
        ("s = =", "s", "expected a statement", "named by spec NAME = ..."),
        ("s := a ovlp b", "s", "expected a statement", "named by spec s = a ovlp b"),
        ("a ovlp b", "a", "expected a statement", "named by spec NAME = ..."),
        ("spec s = a ovlp b iff c ovlp d", "iff", "'iff' is not an operator", "is written <->"),
        ("spec s = a ovlp b unless c ovlp d", "unless", "'unless' is not an operator", "is written W"),
        ("spec s = a ovlp b /\\ c ovlp d", "/\\", "is not part of the language", "write and, or &"),
        ("spec s = a ovlp b <=> c ovlp d", "<=>", "is not part of the language", "write <->"),
        ("spec s = ¬ (a ovlp b)", "¬", "the character '¬'", "write not, or !"),
        ("spec s = a dist b ≤ 3", "≤", "the character '≤'", "write <="),
        ("spec s = a dist b <= 10 cm", "cm", "'cm' is no unit here", "write 0.1 if those are metres"),
        ("spec s = speed(a) <= 3 km/h", "km", "'km' is no unit here", "write 0.8333 if those are metres"),
        ("spec s = a D b <= 3", "D", "unknown relation 'D'", "write a dist b"),
        ("spec s = a ovlp circle(0, 0, 1)", "circle", "cannot stand here", "goal = circle((x, y), r)"),
        ("spec s = a ovlp rect(0, 0, 1, 1)", "(", "cannot stand here", "goal = box(xmin, ymin, xmax, ymax)"),
        ("spec s = a ovlp box", "box", "expected an object", 'in quotes: "box"'),
        ("group g = [a, b]", "[", "'[' cannot stand here", "without brackets: group g = a, b"),
        ("region r = polygon(0, 0, 1, 1)", "0", "cannot stand here", "polygon((0, 0), (1, 1))"),
        (
            "spec s = G (earlier ovlp b)",
            "earlier",
            "'earlier' is a spec",
            'spec earlier_holds "earlier" = ...',
        ),
        ("spec s = G (earlier >= 1)", "earlier", "'earlier' is a specification", "rename the definition"),
        ("spec s = G battery >= 1)", ")", "')' closes nothing", "leave it out"),
        ("spec s = G (battery => 1)", " => ", "'=>' means implies", "at least is written >="),
        ("spec s = battery == force", "==", "hardly ever equal", "write abs(battery - force) <= 0.01"),
        ("spec s = x - y == 3", "==", "hardly ever equal", "write abs(x - y - 3) <= 0.01"),
        ("spec s = battery == nera", "==", "hardly ever equal", "did you mean 'near'?"),
        ("spec s = x * y <= 3", "x * y", "a product of two signals", 'SIGNALS = {"NAME": function'),
        ("spec s = 2 / x <= 3", "2 / x", "a quotient of two signals", "given by --plugin"),
        ("spec s = 0 * x <= y", "0", "a factor of 0", "write another factor"),
        ("spec s = x / 0 <= y", "0", "division by zero", ""),
        ("spec s = sqrt(x) <= 3", "sqrt(x)", "'sqrt' is not a function", "a plug-in computes it"),
        ("spec s = min(x, y) >= 3", "min(x, y)", "'min' is not a function", "by itself, joined by and"),
        ("spec s = distance(a, b) > 3", "distance(a, b)", "is not a function", "a dist b"),
        ("spec s = f(a, 1) <= 3", "f(a, 1)", "'f' is a macro", ""),
        ("spec s = abs(x, y) <= 3", "abs(x, y)", "'abs' takes one number", "abs(x - y) <= c"),
        ("spec s = (a ovlp b) + 1 <= x", "(a ovlp b)", "a formula, where a number is", "compare signals"),
        ("spec s = x + goal >= 1", "goal", "'goal' is a region; a signal", "rename"),
        ("spec s = a dist b >= speed(a)", "a dist b", "different units", "a dist b >= 2 * speed(a)"),
        ("spec s = x <= 2 + a dist b + rate(x) - speed(a)", "2", "different units", "by a constant"),
        ("spec s = G (a dist b)", "(a dist b)", "a number, where a formula", "(a dist b) <= 1"),
        ("spec s = x[-3] >= 1", ">=", "a signal has no [-n]", "rate(x) is its change"),
        ("spec s = x >= y + z[-1]", "", "a signal has no [-n]", "rate(x) is its change"),
        ("spec s = G (prev(a ovlp b))", "prev", "'prev' is not an operator", "is written not Y not"),
        ("spec s = Z (a ovlp b)", "Z", "'Z' is not an operator", "is written not Y not"),
        ("spec s = s_next (a ovlp b)", "s_next", "'s_next' is not an operator", "is written X"),
        ("spec s = X[!] (a ovlp b)", "!", "X[!] is no operator", "is written X (...)"),
        ("spec s = earlier and last", "last", "no spec is named 'last'", "it is written WX false"),
        ("spec s = FTP -> earlier", "FTP", "no spec is named 'FTP'", "it is written not Y true"),
        ("spec s = earlier or tt", "tt", "no spec is named 'tt'", "it is written true"),
        ("spec s = LAST V earlier", "V", "'V' is not an operator", "is written R"),
        ("spec s = earlier M (a ovlp b)", "M", "'M' is not an operator", "(q) U (p and q)"),
        ("spec s = earlier T (a ovlp b)", "T", "'T' is not an operator", "not ((not p) S (not q))"),
        ("spec s = x !== 3", "=", "'=' cannot stand here", "it is written !="),
        ("spec s = earlier ^ earlier", "^", "the character '^'", "write xor, or and"),
        ("spec s = F p at q", "at", "'at' cannot stand here", "F (p and q)"),
        ("spec s = G (a ovlp b) at the end", "at", "'at' cannot stand here", "F (p and WX false)"),
        ("spec s = earlier before (a ovlp b)", "before", "cannot stand here", "(not q) U p"),
        ("spec s = p precedes q", "precedes", "cannot stand here", "(not q) U p"),
        ("spec s = exactly once a ovlp b", "once", "cannot stand here", "(not p) U (p and WX (G not p))"),
        ("spec s = a leftof b by 0.1", "by", "cannot stand here", "a leftof enlarge(b, 0.1)"),
        ("spec s = X[1s] (a ovlp b)", "]", "X takes no window", "within 1s is F[0, 1s]"),
        ("spec s = angle(a, b) <= 10", "angle(a, b)", "is not a function", "a oriented[k] b"),
        (
            "spec s = a oriented[10deg] b",
            "10deg",
            "neither a number",
            "1 - cos of their angle: write 0.01519",
        ),
        ("spec s = robot.speed <= 1", ".", "an object has no fields", "speed(robot) <= 1"),
        ("spec s = count(people) <= 2", "count(people)", "is not a function", "a plug-in computes it"),
        ("spec s = x + <= 3", "<=", "expected a signal, a number or a distance", ""),
        ("spec s = 2 <= 3", "2 <= 3", "two constants are compared", "a signal, a distance"),
        ("spec s = x <= 2s + y", "2s", "a duration, where a plain number", "its unit"),
        ("const e = 5 s", "s", "'s' is no unit here", "without the blank: 5s"),
        ("spec s = a dist b <= 0,1", ",", "a comma within a number", "decimals have a point: 0.1"),
        ("spec s = battery >= 20%", "%", "the character '%'", "20 % of a signal from 0 to 1 is 0.2"),
        ("spec moved = a ovlp b", "moved", "'moved' is a relation, so no name for a spec", "another name"),
        ("const F = 3", "F", "'F' is a reserved word, so no name for a const", "another name"),
        ("spec s: G a ovlp b", ":", "':' stands where = is missing", "write spec s = ..."),
        ("spec s = G (force)", "force", "no spec is named 'force'", "such as force >= 1.0"),
        ("spec s = G True", "True", "no spec is named 'True'", "truth values are written true"),
        ("spec s = a inside goal", "inside", "unknown relation 'inside'", "write a enclosedin goal"),
        ("spec s = a not ovlp goal", "not", "cannot stand within a relation", "in front: not a ovlp"),
        ("spec s = a is above goal", "is", "'is' cannot stand here", "leave it out: a above"),
        ("spec s = G a ovlp goal;", ";", "the character ';'", "a statement ends with its line"),
        ("// a comment", "// a comment", "'//' is not part of the language", "a comment begins with #"),
        ("spec s hit = a ovlp b", "hit", "'=' or a title in quotes", 'spec NAME "REQ-12: what must hold" ='),
        ('spec s " " = a ovlp b', '" "', "a title is empty", '"REQ-12: what must hold"'),
        ('const e = "x"', '"x"', "a text, where a number or a duration is expected", 'group NAME = "x"'),
        ("const e = inf", "inf", "'inf' is not a number here", "the upper end of a window"),
        ("const e = wait + near", "wait + near", "a duration and a number cannot be added", "to durations"),
        ("const e = wait * wait", "wait * wait", "cannot be multiplied", "multiplied by numbers"),
        ("const e = near / (3 - near)", "near / (3 - near)", "division by zero", ""),
        ("const e = 9e9s * 9e9", "9e9s * 9e9", "too large", "durations up to 9e9s"),
        ("const e = 5 in [1, 4]", "5", "const 'e': 5 is outside of the range [1, 4]", "or widen the range"),
        ("const e = 5 in [6, 4]", "5", "the range [6, 4] is empty", "the smaller end comes first"),
        ("const e = 5 in [0s, 6s]", "5", "a range from numbers to durations", "like the constant itself"),
        ("spec s = a[3] ovlp b", "3", "look back, so expected '-'", "write [-3]"),
        ("spec s = g (a ovlp b)", "g", "'g' is not an operator", "the operator is written G"),
        ("spec s = a ovlp b and x a ovlp b", "x", "'x' is not an operator", "as in X (a ovlp b)"),
        ("spec s = G closeto(a, b, 0.1)", "closeto", "not a function", "a closeto[0.1] b"),
        ("spec s = ovlp(a, b)", "ovlp", "'ovlp' is not a function", "a ovlp b"),
        ("spec s = battery = 3", "=", "found '='", "equality is written =="),
        ("spec s = a dist b != 3", "!=", "hardly ever exactly a number", "a dist b <= c, a dist b >= c"),
        ("spec s = 1 != a dist b <= 3", "!=", "left of a chained comparison", "write a dist b == c, or"),
        ("spec s = F[0s-5s] a ovlp b", "]", "cannot stand here", "F[0s, 5s]"),
        ("spec s = speed(a) <= 3m/s", "3m", "'3m' is neither a number", "write 3 if those are metres"),
        ("spec s = F[0, 5m] a ovlp b", "5m", "nor a duration", "write 300s"),
        ("spec s = G[0s, inf) a ovlp b", ")", "')' cannot stand here", "both of its ends: G[0s, inf]"),
        ("region r = box(0,5, 0,5, 1, 1)", ",", "',' cannot stand here", "decimals have a point"),
        ("region r = circle((0, 0))", ")", "')' cannot stand here", "it is written circle((x, y), r)"),
        ("group g = {a, b}", "{", "'{' cannot stand here", "without brackets: group g = a, b"),
        ("spec my-spec = a ovlp b", "-", "'-' cannot stand in a name", "letters, digits and _"),
        ("Spec s = a ovlp b", "Spec", "expected a statement", "have their own case: write spec"),
        ("spec s = force == true", "true", "'true' cannot stand here", "a flag is a number: force == 1"),
        ('spec s = mode is "AUTO"', "is", "'is' cannot stand here", 'compared as mode == "AUTO"'),
        ("spec s = a dist b => 1", " => ", "'=>' means implies", "at least is written >="),
        ("spec s = a dist b =< 1", "=", "'=' cannot stand here", "it is written <="),
        ("spec s = a dist b > = 1", "=", "'=' cannot stand here", "it is written >="),
        ('spec s = a "dist" b >= 1', '"dist"', "'dist' cannot stand here", "without quotes: a dist b"),
        ("spec s = for all x in reds: x ovlp b", "all", "cannot stand here", "write forall x in GROUP"),
        ("spec s = every x in reds: x ovlp b", "x", "cannot stand here", "write forall x in GROUP"),
        ("spec s = overlap(a, b)", "overlap", "no macro is named 'overlap'", "a ovlp b"),
        ("spec s = until(a ovlp b, a ovlp c)", "ovlp", "'until' is not a function", "(p) U (q)"),
        ("spec s = cup.x < 3", ".", "an object has no fields", "cup leftof b"),
        ("spec s = a dist b <= 5cm", "5cm", "'5cm' is neither a number", "write 0.05 if"),
        ("spec s = F[0, 5min] a ovlp b", "5min", "nor a duration", "write 300s"),
        ("spec s = /a/b ovlp c", "/", "expected a formula", "is written in quotes"),
        ("spec s = a closto b", "closto", "unknown relation 'closto'", "did you mean 'closeto'?"),
        ("spec s = a closeto b", "closeto", "takes 1 parameter, not 0", "write a closeto[e] b"),
        ("spec s = a prec b", "prec", "takes 1 parameter, not 0", "write a prec[x] b"),
        ("spec s = a ovlp[3] b", "ovlp", "takes no parameter", "write a ovlp b"),
        ("spec s = a closeto[1, 2] b", "closeto", "not 2", "write a closeto[e] b"),
        ("spec s = a prec[w] b", "w", "an axis is expected", "x, y or z"),
        ("spec s = a closeto[nera] b", "nera", "unknown constant 'nera'", "did you mean 'near'?"),
        ("spec s = a closeto[wait] b", "wait", "a duration", "unit"),
        ("spec s = a closeto[goal] b", "goal", "'goal' is a region", ""),
        ("spec s = a ovlp F b", "F", "cannot stand inside a relation", '"F"'),
        ("spec s = G ovlp b", "ovlp", "needs an object", '"G"'),
        ("spec s = a ovlp S", "S", "found 'S'", '"S"'),
        ("spec s = a ovlp 12", "12", "found '12'", '"12"'),
        ("spec s = F[5, 2] a ovlp b", "[5, 2]", "is empty", ""),
        ("spec s = F[0, 2.5] a ovlp b", "[0, 2.5]", "decimal numbers", "write F[0s, 2.5s] for seconds"),
        (
            "spec s = G[0.0, 5.0] a ovlp b",
            "[0.0, 5.0]",
            "needs its unit",
            "write G[0, 5] for samples, G[0s, 5s]",
        ),
        ("spec s = always[0.5:5] a ovlp b", "[0.5:5]", "in this spelling", "write G[0.5s, 5s] for seconds"),
        (
            "const w = 1.5\nspec s = G[0, w] a ovlp b",
            "[0, w]",
            "decimal numbers",
            "write G[0s, 1.5s] for seconds",
        ),
        ("spec s = F[1, 2s] a ovlp b", "[1, 2s]", "from samples to time", "both"),
        ("spec s = F[-1, 2] a ovlp b", "-1", "not a whole number of samples", ""),
        ("spec s = F[inf, inf] a ovlp b", "inf", "cannot begin at inf", ""),
        ("spec s = F[0, 1e-10s] a ovlp b", "1e-10s", "not a usable duration", "nanoseconds"),
        ("spec s = F[0, 3h] a ovlp b", "3h", "neither a number", "s and ms"),
        ("spec s = X[1, 2] a ovlp b", "[1, 2]", "takes no window", ""),
        ("spec s = a[-1][-2] ovlp b", "a[-1][-2]", "a delay of a delayed object", "add"),
        ("spec s = a[-1.5] ovlp b", "1.5", "not a whole number of samples", ""),
        ("spec s = center(a) oriented[1] b", "oriented", "a point has none", "compare single objects"),
        ("spec s = enlarge(a, -1) ovlp b", "-1", "negative radius", ""),
        ("spec s = a moved[-1] b", "moved", "negative radius", ""),
        ("spec s = a oriented[1] goal", "oriented", "a region has none", ""),
        ("spec s = reds oriented[1] a", "oriented", "a group has none", ""),
        ("spec s = a ovlp near", "near", "'near' is a constant", ""),
        ("spec s = earler", "earler", "no spec is named", "did you mean 'earlier'?"),
        ("spec s = later\nspec later = a ovlp b", "later", "is not defined before", "move it down"),
        ("spec s = s", "s", "is not defined before", ""),
        ("spec s = template and earlier", "template", "is a template", "def"),
        ("spec s = template(a)", "template", "is a template", "def"),
        ("spec s = f", "f", "is a macro", "write f(a, e)"),
        ("spec s = f(a)", "f(a)", "takes 2 arguments (a, e), not 1", ""),
        ("spec s = ff(a, 1)", "ff", "no macro is named", "did you mean 'f'?"),
        ("def g(a) = g(a)\nspec s = g(b)", "g(a)", "in terms of itself", ""),
        ("spec s = forall x in goal: x ovlp a", "goal", "runs over a group", ""),
        ("spec s = forall x, x in reds: x ovlp a", "x", "given twice", ""),
        ("spec s = forall x in everyone: F (x ovlp a)", "F (x ovlp a)", "open group", "template"),
        ("spec s = forall x in everyone: x", "x", "a formula is expected", ""),
        ("spec s = (goal except a) ovlp b", "goal", "only a group", ""),
        ("spec s = goal >= 3", "goal", "'goal' is a region; a signal", ""),
        (
            "spec s = 3 >= a dist b >= 1",
            ">=",
            "'>=' cannot stand on the left",
            "write the lesser limit first",
        ),
        ("spec s = 1 <= a dist b >= 3", ">=", "'>=' cannot stand on the right", "c1 <= a dist b <= c2"),
        ("spec s = 3 > a dist b <= 1", ">", "'>' cannot stand on the left", "two comparisons"),
        ("spec s = 1 < a dist b == 3", "==", "'==' cannot stand on the right", "a dist b == c"),
        ("spec s = a ovlp b)", ")", "')' closes nothing", "leave it out"),
        ("spec s = (a ovlp b", "(", "never closed", "')'"),
        ("spec s = a ovlp", "", "ends too early", ""),
        ("spec s = a ovlp @b", "@", "not part of the language", "quotes"),
        ('spec s = a ovlp "b', '"b', "does not end on its line", ""),
        ('spec s = a ovlp "b\\n"', "\\n", "unknown escape", ""),
        ('spec s = a ovlp ""', '""', "a name is empty", ""),
        ("spec near = a ovlp b", "near", "already the name of a constant", ""),
        ("region r = polygon()\nspec s = a ovlp r", "polygon()", "without corners", ""),
        ("region r = box(2, 0, 1, 1)", "box(2, 0, 1, 1)", "xmin, 2, is above", ""),
        ("region r = circle((0, 0), -1)", "circle((0, 0), -1)", "negative radius", ""),
        ("region r = box(0, 0, 1, 1) height (2, 1)", "height (2, 1)", "above its top", ""),
        ("region r = circle((0, 1e999), 1)", "1e999", "too large", ""),
        ("region r = polygon((0, 0), (1, 1), (1, 0), (0, 1))", "polygon", "crosses itself", "order"),
        ("group g = a, goal", "goal", "'goal' is a region", ""),
        ("group g = a, a", "a", "listed twice", ""),
        ("use papr\nspec s = a ovlp b", "papr", "unknown profile", "did you mean 'paper'?"),
        ("const a1 = b1\nconst b1 = a1", "a1", "in terms of itself", ""),
        ("sepc s = a ovlp b", "sepc", "expected a statement", "did you mean 'spec'?"),
        ("spec s(a, b) = a ovlp b", "b", "more than one parameter", ""),
        ("spec s(goal) = goal ovlp b", "goal", "already the name of a region", ""),
    ],
)
def test_a_fault_names_the_place_and_the_remedy(statement: str, where: str, message: str, hint: str) -> None:
    found = faults_of(DEFINITIONS + statement + "\n")
    assert len(found) == 1, found
    head, line, caret, *tail = found[0].splitlines()
    assert message in head
    assert head.startswith("x.spatial:")
    assert hint in "".join(tail)
    marked = line[caret.index("^") : caret.rindex("^") + 1]
    assert marked.startswith(where) if where else caret.index("^") == len(line)


@pytest.mark.parametrize("text", ["spec s = #people <= 2", "#people <= 2", "spec s = G (#people <= 2)"])
def test_a_number_of_objects_is_no_comment(text: str) -> None:
    (fault,) = faults_of(text)
    assert "# begins a comment" in fault
    assert "a plug-in counts objects" in fault


def test_all_faults_are_reported_together_in_the_order_of_the_text() -> None:
    lines = [f"spec s{number} = a closto b" for number in range(10)]
    found = faults_of("\n".join(lines))
    assert [int(fault.split(":")[1]) for fault in found] == list(range(1, 11))


def test_a_broken_definition_is_one_fault_however_often_it_is_used() -> None:
    text = (
        "spec s = a ovlp\nregion r = box(\ngroup g = ,\nspec t = s and a ovlp r and forall x in g: x ovlp a"
    )
    assert len(faults_of(text)) == 3


def test_a_factor_that_a_macro_is_not_given_is_no_fault() -> None:
    specification = parse_specification("def f(k) = k * x <= y / k\nspec s = x >= y")
    assert [warning.message for warning in specification.warnings] == ["'f' is a macro that nothing uses"]
    assert len(faults_of("const k =\nspec s = k * x <= y")) == 1


def test_a_fault_in_a_macro_names_the_line_that_uses_it() -> None:
    (found,) = faults_of("def f(a) = a[-1] ovlp b\nspec s = f(c[-2])")
    assert "a delay of a delayed object (in 'f', used in line 2)" in found


def test_bodies_of_unused_macros_are_checked() -> None:
    (found,) = faults_of("def f(a, e) = a closeto[e] goal and a leftof[3] b\nspec s = a ovlp b")
    assert "'leftof' takes no parameter" in found


@pytest.mark.parametrize(
    "text",
    [
        "(" * 20_000,
        "not " * 20_000 + "a ovlp b",
        "F " * 20_000 + "a ovlp b",
        "a ovlp b -> " * 5_000 + "a ovlp b",
        "enlarge(" * 5_000 + "a",
        "a" + "[-1]" * 5_000 + " ovlp b",
        "x" * 300_000,
        "spec s0 = a ovlp b\n" + "".join(f"spec s{n + 1} = s{n} and s{n}\n" for n in range(60)),
        "spec s0 = a ovlp b\n" + "".join(f"spec s{n + 1} = not s{n}\n" for n in range(300)),
        "def f0(a) = a ovlp b\n" + "".join(f"def f{n + 1}(a) = f{n}(a) and f{n}(a)\n" for n in range(60))
        + "spec s = f60(x)",
        f"group g = {', '.join(f'm{n}' for n in range(300))}\nspec s = forall a, b, c, d in g: a ovlp b",
    ],
    ids=lambda text: text[:12],
)  # fmt: skip
def test_a_text_that_is_too_large_is_refused(text: str) -> None:
    assert (
        "more than" in faults_of(text)[0]
        or "never closed" in faults_of(text)[0]
        or "delay" in faults_of(text)[0]
    )


def test_the_number_of_reported_faults_is_bounded() -> None:
    found = faults_of("\n".join(f"spec s{number} = foo{number}" for number in range(300)))
    assert len(found) == 101
    assert "200 further faults" in found[-1]


def calls_to_parse(text: str) -> int:
    """Functions called to parse a text: its cost, the same on every machine."""
    calls = 0

    def count(frame: FrameType, event: str, argument: object) -> None:
        nonlocal calls
        calls += event in ("call", "c_call")

    previous = sys.getprofile()
    sys.setprofile(count)
    try:
        with suppress(SpecificationError):
            parse_specification(text)
    finally:
        sys.setprofile(previous)
    return calls


@pytest.mark.parametrize("wrong", ["a closetoo{} b", "a ovlp", "a ovlp b c{}"])
def test_a_text_full_of_faults_takes_no_longer_than_a_correct_one(wrong: str) -> None:
    number = 1500
    faulty = "\n".join(f"spec s{each} = " + wrong.format(each) for each in range(number))
    right = "\n".join(f"spec s{each} = a closeto[1] b" for each in range(number))
    parse_specification(right)
    assert calls_to_parse(faulty) < 1.5 * calls_to_parse(right)
    *_, last = faults_of(faulty)
    assert f"{number - MAX_FAULTS} further faults" in last


# ------------------------------------------------------------------------------------------ warnings


@pytest.mark.parametrize(
    ("text", "messages"),
    [
        ("F (a ovlp b)", []),
        ("F a ovlp b and c ovlp d", ["'F' reaches over 'and'"]),
        ("G F a ovlp b -> c ovlp d", ["'F' reaches over '->'"]),
        ("(F a ovlp b) and c ovlp d", []),
        ("G (O (a ovlp b))", []),
        ("O (a ovlp b)", ["'O' looks back"]),
        ("(G (a ovlp b)) and H (a ovlp b)", ["'H' looks back"]),
        ("not (a ovlp b) and (b ovlp c)", []),
        ("X! (a ovlp b)", ["'X!' is read as 'X not'"]),
        ("G (next (a ovlp b))", ["'next' is read as X"]),
        ("next ovlp b", []),
        ("always (a ovlp b) and (c ovlp d)", ["'G' reaches over 'and'"]),
        ("(a ovlp b) U[1,4] (c ovlp d) && (a ovlp c)", ["the left side of 'U' counts from now"]),
        ("(a ovlp b) U[0,4] (c ovlp d) && (a ovlp c)", []),
        ("(a ovlp b) U[1,4] (c ovlp d)", []),
        ("X !(a ovlp b) or X not (a ovlp b)", ["'X' reaches over 'or'"]),
        ("use spatial_spec\nnot (a ovlp b) and (b ovlp c)", ["'not' over 'and'"]),
        ("use spatial_spec\n(not (a ovlp b)) and (b ovlp c)", []),
        ("use spatial_spec\n(a ovlp b) and (b ovlp c) or (c ovlp d)", ["'and' and 'or' the other way"]),
        ("use spatial_spec\n(a ovlp b) or (b ovlp c) and (c ovlp d)", []),
        ("use spatial_spec\n((a ovlp b) and (b ovlp c) U (c ovlp d))", ["'and' and 'U' the other way"]),
        ("use spatial_spec\n((a ovlp b) U (b ovlp c) and (c ovlp d))", ["'U' and 'and' the other way"]),
        ("use spatial_spec\n(a ovlp b) and (b ovlp c) and (c ovlp d)", []),
        ("G (a dist b == 3)", ["`a dist b == 3` hardly ever holds: its robustness is at most 0"]),
        ("G (mode == 2 -> a dist b >= 3)", []),
        ("const c = 1\nspec s = a ovlp b", ["'c' is a constant that nothing uses"]),
        ("def f(a) = a ovlp b\nspec s = a ovlp b", ["'f' is a macro that nothing uses"]),
        ("region r = box(0, 0, 1, 1)\ngroup g = a\nspec s = g ovlp r", []),
    ],
)
def test_legal_but_misleading_texts_give_warnings(text: str, messages: list[str]) -> None:
    warnings = parse_specification(text).warnings
    assert len(warnings) == len(messages)
    for warning, message in zip(warnings, messages, strict=True):
        assert message in warning.message
        assert warning.severity == "warning"


def test_an_evaluation_and_a_replay_warn_of_spellings_that_another_tool_reads_otherwise(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = "always (a ovlp b) and (next (a ovlp b))"
    cube = Footprint.box(0, 0, 1, 1)
    trace = Trace.from_samples([Sample(0, {"a": cube, "b": cube})])
    remarks = evaluate(parse_specification(text), trace).remarks
    assert "in rtamt it ends in front of 'and'" in remarks[0].hint
    assert "write WX for that" in remarks[1].hint
    log = tmp_path / "run.jsonl"
    log.write_text('{"time_ns": 0, "objects": [{"name": "a", "polygon": [[0, 0], [1, 0], [1, 1]]}]}\n')
    run(["replay", str(log), "--spec", text])
    assert "in rtamt it ends in front of 'and'" in capsys.readouterr().err


def test_names_are_compared_with_those_of_a_log() -> None:
    specification = parse_specification(
        "region goal = box(0, 0, 1, 1)\ngroup g = cup, plat\nspec s = F (g ovlp goal) and G (batery >= 3)"
    )
    found = check_names(specification, ["cup", "plate", "goal"], ["battery"])
    assert [(each.severity, each.line) for each in found] == [("warning", 1), ("error", 2), ("error", 3)]
    assert [each.hint for each in found[1:]] == [
        "did you mean 'plate'? its objects are cup, plate, goal",
        "did you mean 'battery'? its signals are battery",
    ]


def test_a_misspelt_constant_in_a_sum_is_named() -> None:
    specification = parse_specification("const limit = 2\nspec s = G (load - limt <= limit)")
    (remark,) = check_names(specification, [], ["load"])
    assert remark.hint == "did you mean 'limit'? its signals are load"


@pytest.mark.parametrize("given", [3, None, b"a ovlp b"])
def test_anything_but_a_text_is_a_usage_error(given: Any) -> None:
    with pytest.raises(UsageError, match=r"text is .*; give the text as a str") as caught:
        parse_specification(given)
    assert repr(given) in str(caught.value)


def test_anything_but_a_path_is_a_usage_error() -> None:
    path: Any = 3
    with pytest.raises(UsageError, match=r"path is 3; give the path of a file"):
        load_specification(path)


def test_an_unknown_profile_in_a_call_is_a_usage_error() -> None:
    with pytest.raises(UsageError, match="paper, spatial_spec"):
        parse_specification("a ovlp b", profile="other")
