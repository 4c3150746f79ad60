"""Decisions on the page of a report, also from incomplete logs."""

from __future__ import annotations

import math

import numpy as np
import pytest
from foxglove_schemas_protobuf.Grid_pb2 import Grid

from spatial_replay.logs.schemas.PlanDecision_pb2 import (
    PlanCandidate,
    PlanCause,
    PlanDecision,
    PlanEdge,
    PlanMap,
    PlanTarget,
)
from spatial_replay.report.panels import MOST_CELLS, Packing, ReportedDecisions, decisions_value, json_text


def grid(time_ns: int = 0, *, rows: int = 2, columns: int = 3, value: float = 1.0) -> Grid:
    message = Grid(column_count=columns, row_stride=4 * columns, cell_stride=4)
    message.timestamp.FromNanoseconds(time_ns)
    message.cell_size.x = message.cell_size.y = 0.5
    message.fields.add(name="robustness", offset=0)
    message.data = np.full((rows, columns), value, "<f4").tobytes()
    return message


def decision(time_ns: int, *maps: PlanMap, target: PlanTarget | None = None) -> PlanDecision:
    candidate = PlanCandidate(object="cup", best=-math.inf, rejected="no way", maps=maps, target=target)
    return PlanDecision(
        time_ns=time_ns,
        number=0,
        kind=PlanDecision.KIND_NO_PATH,
        considered=[
            PlanEdge(path=[0, 1], candidates=[candidate], pruned="no object can do it (cup: no way)")
        ],
        target=target,
    )


def value_of(reported: PlanDecision, *grids: Grid) -> dict:
    maker = ReportedDecisions()
    maker.add_decision(reported.SerializeToString())
    for number, each in enumerate(grids):
        maker.add_map(number, each.SerializeToString())
    value = decisions_value(maker, ReportedDecisions(), 0, Packing())
    assert json_text(value)
    return dict(value)


def test_failed_attempts_are_listed() -> None:
    (reported,) = value_of(decision(10**9, PlanMap(number=0)), grid(10**9))["decisions"]
    assert (reported["time"], reported["kind"], reported["target"]) == (1.0, "no path", None)
    (edge,) = reported["edges"]
    assert (edge["path"], edge["aim"], edge["pruned"]) == ([0, 1], False, "no object can do it")
    assert edge["candidates"][0]["best"] is None
    assert [(each["title"], each["edge"], each["candidate"]) for each in reported["maps"]] == [("cup", 0, 0)]


def test_the_best_robustness_is_never_below_that_of_the_target() -> None:
    planned = decision(0)
    candidate = planned.considered[0].candidates[0]
    candidate.rejected, candidate.best = "", 0.03
    # refined between the centres of cells
    candidate.target.CopyFrom(PlanTarget(object="cup", robustness=0.031))
    candidate.causes.add(
        kind=PlanCause.KIND_CONSTRAINT, words="on the way, keep `cup dist (jug) >= 1`", cells=3
    )
    candidate.causes.add(kind=PlanCause.KIND_CONSTRAINT, words="on the way, `b` not before `a`", cells=2)
    candidate.conjuncts.add(text="not (cup leftof jug)", words="avoid `cup leftof jug`", limits=5)
    (edge,) = value_of(planned)["decisions"][0]["edges"]
    (value,) = edge["candidates"]
    assert value["best"] == value["target"]["robustness"] == 0.031
    assert (value["cells"], value["bars"]) == (
        10,
        [
            {"kind": "limited by", "words": ["avoid ", "cup leftof jug", ""], "cells": 5},
            {"kind": "blocked", "words": ["on the way, keep ", "cup dist (jug) >= 1", ""], "cells": 3},
            {"kind": "blocked", "words": ["on the way, ", "b", " not before ", "a", ""], "cells": 2},
        ],
    )


def test_later_motions_are_listed() -> None:
    planned = decision(0)
    planned.considered[0].motions.extend(PlanTarget(object=name, x=0.5) for name in ("cup", "jug", "cup"))
    planned.considered[0].joint = True
    ((edge,),) = (each["edges"] for each in value_of(planned)["decisions"])
    assert edge["later"] == ["jug to (0.5, 0)", "cup to (0.5, 0)"]
    assert edge["once"] == " once all 3 motions are done"


def test_maps_of_several_orientations_say_which() -> None:
    maps = [PlanMap(number=0, turn=0.0), PlanMap(number=1, turn=math.pi / 2)]
    (reported,) = value_of(decision(0, *maps), grid(), grid())["decisions"]
    assert [each["title"] for each in reported["maps"]] == ["cup, turned by 0°", "cup, turned by 90°"]


def test_maps_without_a_decision_belong_to_the_one_of_their_time() -> None:
    (reported,) = value_of(decision(5), grid(4), grid(5))["decisions"]
    assert [(each["title"], each["edge"]) for each in reported["maps"]] == [("", None)]


def test_an_unreadable_decision_is_left_out() -> None:
    maker = ReportedDecisions()
    maker.add_decision(b"\xff\xff")
    maker.add_map(0, b"\xff\xff")
    assert decisions_value(maker, ReportedDecisions(), 0, Packing()) == {"decisions": [], "maps_left_out": 0}


def test_a_map_whose_sizes_do_not_fit_is_not_drawn() -> None:
    crooked = [grid() for _ in range(5)]
    crooked[0].row_stride = 5
    crooked[1].cell_stride = 0
    crooked[2].fields[0].name = "height"
    crooked[3].cell_size.x = math.nan
    crooked[4].column_count = 0
    named = [PlanMap(number=number) for number in range(5)]
    value = value_of(decision(0, *named), *crooked)
    assert value["decisions"][0]["maps"] == []
    assert value["maps_left_out"] == 0


def test_a_target_without_a_place_is_listed_and_not_drawn() -> None:
    target = PlanTarget(object="cup", x=math.nan, y=0.0, turn=0.0, waypoints=[math.inf, 0.0], robustness=1.0)
    (reported,) = value_of(decision(0, target=target))["decisions"]
    assert reported["target"]["words"] == "(nan, 0)"
    assert (reported["target"]["at"], reported["target"]["way"]) == (None, [])


def test_no_more_cells_are_kept_than_there_is_room_for() -> None:
    side = math.isqrt(MOST_CELLS // 2)
    grids = [grid(rows=side, columns=side) for _ in range(3)]
    value = value_of(decision(0, *(PlanMap(number=number) for number in range(3))), *grids)
    assert len(value["decisions"][0]["maps"]) == 2
    assert value["maps_left_out"] == 1


def several(time_ns: int, first: int, chosen: int) -> PlanDecision:
    """A decision with three candidates, each with a map, of which one is chosen."""
    targets = [PlanTarget(object=f"cup{place}", robustness=1.0) for place in range(3)]
    candidates = [
        PlanCandidate(
            object=f"cup{place}", maps=[PlanMap(number=first + place)], chosen=place == chosen, target=each
        )
        for place, each in enumerate(targets)
    ]
    return PlanDecision(
        time_ns=time_ns,
        number=first,
        kind=PlanDecision.KIND_EXECUTE,
        considered=[PlanEdge(path=[0, 1], candidates=candidates)],
        target=targets[chosen],
    )


@pytest.mark.parametrize(("most_cells", "shown"), [(36, 6), (24, 4), (18, 3), (12, 2), (11, 1), (5, 0)])
def test_where_room_is_short_the_maps_of_what_was_chosen_stay(most_cells: int, shown: int) -> None:
    maker = ReportedDecisions()
    for reported in (several(0, 0, 1), several(10**9, 3, 2)):
        maker.add_decision(reported.SerializeToString())
    for number in range(6):
        maker.add_map(number, grid().SerializeToString())
    value = decisions_value(maker, ReportedDecisions(), 0, Packing(), most_cells)
    kept = [[(each["title"], each["chosen"]) for each in reported["maps"]] for reported in value["decisions"]]
    chosen = [[title for title, is_chosen in maps if is_chosen] for maps in kept]
    assert chosen == [["cup1"] if shown else [], ["cup2"] if shown > 1 else []]
    assert sum(map(len, kept)) == shown
    assert value["maps_left_out"] == 6 - shown


def test_the_only_map_of_a_decisions_time_is_the_chosen_one() -> None:
    target = PlanTarget(object="cup", robustness=1.0)
    (reported,) = value_of(decision(5, target=target), grid(5))["decisions"]
    assert [each["chosen"] for each in reported["maps"]] == [True]
    (reported,) = value_of(decision(5, target=target), grid(5), grid(5))["decisions"]
    assert [each["chosen"] for each in reported["maps"]] == [False, False]
