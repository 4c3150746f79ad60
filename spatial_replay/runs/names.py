"""Names in specifications, compared with what a simulated world has."""

from __future__ import annotations

from collections.abc import Iterable

from spatial_replay.errors import SpecificationError
from spatial_replay.spec import check_names
from spatial_replay.spec.formula import Specification
from spatial_replay.trace.sample import Sample


def refuse_unknown_names(files: Iterable[Specification], sample: Sample) -> None:
    """That a world has what specifications name.

    Args:
        sample: of the world, which always shows everything that it has.

    Raises:
        SpecificationError: with every name that it does not have.
    """
    objects, signals = sorted(sample.objects), sorted(sample.signals)
    remarks = [remark for file in files for remark in check_names(file, objects, signals, where="world")]
    missing = [remark for remark in remarks if remark.severity == "error"]
    if missing:
        raise SpecificationError(missing)
