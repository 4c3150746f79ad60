"""Formulas from the literature on LTL over finite runs, at several sizes, and what they mean word by word.

The families are those of Geldenhuys and Hansen, Cichoń et al., Tabakov and Vardi, Sickert and others, as
tools for LTL collect them; templates of Declare, conjoined along a chain of propositions; and random
conjunctions of cases of Lily and of a load balancer (Zhu et al., 2017; De Giacomo and Favorito, 2021).
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from functools import cache

from spatial_replay.spec import format_formula
from spatial_replay.spec.formula import Formula, Temporal, Truth, expand, operands_of, operator_of


def p(name: object) -> str:
    return f"(p{name} >= 0)"


def both(*parts: str) -> str:
    return "(" + " and ".join(parts) + ")"


def either(*parts: str) -> str:
    return "(" + " or ".join(parts) + ")"


def nested(join: Callable[[str, str], str], parts: Sequence[str]) -> str:
    *rest, text = parts
    for each in reversed(rest):
        text = join(each, text)
    return text


def ahead(count: int, text: str) -> str:
    return f"({'X ' * count}{text})"


def numbered(count: int) -> list[str]:
    return [p(number) for number in range(count)]


FAMILIES: dict[str, Callable[[int], str]] = {
    "all at some time": lambda n: both(*(f"(F {each})" for each in numbered(n))),
    "all again and again": lambda n: both(*(f"(G F {each})" for each in numbered(n))),
    "one to the end": lambda n: either(*(f"(F G {each})" for each in numbered(n))),
    "fairness implies fairness": lambda n: f"({both(*(f'(G F {p(k)})' for k in range(n)))} -> G F {p(n)})",
    "some time or always": lambda n: both(*(f"((F {p(k)}) or G {p(k + 1)})" for k in range(n))),
    "again or to the end": lambda n: both(*(f"((G F {p(k)}) or F G {p(k + 1)})" for k in range(n))),
    "until to the right": lambda n: nested(lambda one, two: f"({one} U {two})", numbered(n + 1)),
    "one after the other": lambda n: nested(lambda one, two: f"(F ({one} and X {two}))", numbered(n + 1)),
    "counter": lambda n: both(
        f"(G ({p(0)} -> {both(*(ahead(k, f'(not {p(0)})') for k in range(1, n + 1)), ahead(n + 1, p(0)))}))",
        f"(G (({p(0)} and not {p(1)}) -> {ahead(n, p(1))}))",
    ),
    "arbiter": lambda n: both(
        *(f"(G ({p(k)} -> F {p(n + k)}))" for k in range(n)),
        *(f"(G (not ({p(n + k)} and {p(n + j)})))" for k in range(n) for j in range(k)),
    ),
    "response": lambda n: both(*(f"(G ({p(2 * k)} -> F {p(2 * k + 1)}))" for k in range(n))),
    # G binds to the end, so this is what `G (…) and G (…)` means
    "response within response": lambda n: nested(
        lambda one, two: f"(G ({one} and {two}))", [f"(G ({p(2 * k)} -> F {p(2 * k + 1)}))" for k in range(n)]
    ),
    "alternate response": lambda n: both(
        *(f"(G ({p(k)} -> X ((not {p(k)}) U {p(k + 1)})))" for k in range(n))
    ),
    "chain response": lambda n: both(*(f"(G ({p(k)} -> X {p(k + 1)}))" for k in range(n))),
    "coexistence": lambda n: both(*(f"((F {p(k)}) <-> F {p(k + 1)})" for k in range(n))),
    "succession": lambda n: both(
        *(both(f"(G ({p(k)} -> F {p(k + 1)}))", f"((not {p(k + 1)}) W {p(k)})") for k in range(n))
    ),
    "not twice": lambda n: both(*(f"(not F ({each} and X F {each}))" for each in numbered(n))),
}

_CASES: tuple[Callable[[Callable[[], str]], str], ...] = (
    lambda new: f"(G ({new()} -> {(lambda x: both(*(ahead(k, x) for k in (1, 2, 3))))(new())}))",
    lambda new: (lambda x: f"(G ({x} -> X not {x}))")(new()),
    lambda new: f"((G F {new()}) -> G F {new()})",
    lambda new: (lambda r, a: both(f"(G ({r} -> F {a}))", f"((not {a}) W {r})"))(new(), new()),
    lambda new: (lambda r, a: f"(G ((not X {a}) or {r}))")(new(), new()),
    lambda new: (lambda r, a: f"(not F G ({r} and not X {a}))")(new(), new()),
    lambda new: (lambda r, a: both(f"(G ({r} -> F {a}))", f"(G ((not {r}) -> F not {a}))"))(new(), new()),
    lambda new: (lambda r, a, c: both(f"(G ({r} -> X {a}))", f"(G ({c} -> X ((not {a}) U {r})))"))(
        new(), new(), new()
    ),
)


def random_conjunction(length: int, seed: int) -> str:
    """Cases over propositions drawn from 60: all of one kind for even seeds, of any for odd ones."""
    rng = random.Random(f"{length} {seed}")
    one = _CASES[seed // 2 % len(_CASES)]
    kinds = [rng.choice(_CASES) if seed % 2 else one for _ in range(length)]
    return both(*(kind(lambda: p(rng.randrange(60))) for kind in kinds))


def holds(formula: Formula, word: Sequence[Sequence[bool]], numbers: Mapping[str, int]) -> bool:
    """Whether a word satisfies a formula, by the definition of LTL over finite runs.

    Args:
        numbers: of the propositions, by their text; they are in a word in this order.
    """

    @cache
    def at(key: int, k: int) -> bool:
        formula = known[key]
        if format_formula(formula) in numbers:
            return word[k][numbers[format_formula(formula)]]
        formula = expand(formula)
        if isinstance(formula, Truth):
            return formula.value
        operands = operands_of(formula)
        rest = range(k, len(word))
        match operator_of(formula):
            case "not":
                return not of(operands[0], k)
            case "and":
                return all(of(each, k) for each in operands)
            case "or":
                return any(of(each, k) for each in operands)
            case "X":
                return k + 1 < len(word) and of(operands[0], k + 1)
            case "F":
                return any(of(operands[0], j) for j in rest)
            case "G":
                return all(of(operands[0], j) for j in rest)
            case "U":
                return any(of(operands[1], j) and all(of(operands[0], i) for i in range(k, j)) for j in rest)
        raise ValueError(operator_of(formula))

    known: dict[int, Formula] = {}

    def of(formula: Formula, k: int) -> bool:
        assert not isinstance(formula, Temporal) or formula.bound is None
        if id(formula) not in known:
            known[id(formula)] = formula
        return at(id(formula), k)

    return of(formula, 0)
