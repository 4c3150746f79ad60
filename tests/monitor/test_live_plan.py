"""Plans that are packed into two arrays for the kernels of a monitor."""

import numpy as np

from spatial_replay.monitor.atoms.live import PackedPlan, PlanArrays, PlanExtent, plan_at

REALS = {
    "region_radius",
    "region_vertices",
    "region_heights",
    "enlargement",
    "closest_enlargement",
    "constants",
}


def test_a_kernel_finds_each_array_of_a_plan_by_its_name():
    names = PlanArrays._fields
    kinds = [np.float64 if name in REALS else np.int64 for name in names]
    # no two arrays have a number in common
    numbers = [100 * place + np.arange(40 - place) for place in range(1, len(names) + 1)]
    arrays = PlanArrays(*(values.astype(kind) for values, kind in zip(numbers, kinds, strict=True)))
    extent = PlanExtent(samples=2, regions=3, places=4, signals=5, coded=6)
    packed = PackedPlan.of(extent, arrays)
    places = plan_at.interpreted_form()(packed.whole)

    assert places[: len(extent)] == extent
    for name, array in arrays._asdict().items():
        begin = getattr(places, name)
        column = packed.real if name in REALS else packed.whole
        assert column[begin : begin + array.size].tolist() == array.tolist(), name
        if f"{name}_end" in places._fields:
            assert getattr(places, f"{name}_end") == begin + array.size, name
    assert (places.parts, places.operands, places.groups) == (
        len(arrays.region_radius),
        len(arrays.enlargement),
        len(arrays.is_group),
    )
