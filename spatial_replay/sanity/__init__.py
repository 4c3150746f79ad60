"""Sanity checks of specifications by automata and laws of geometry: can a run satisfy or violate them?"""

from __future__ import annotations

from typing import TYPE_CHECKING

from spatial_replay.lazy import lazy_attributes

if TYPE_CHECKING:
    from spatial_replay.sanity.differences import Distinction, distinguish
    from spatial_replay.sanity.examine import doctor, refuse_constant_results, refuse_unsatisfiable

__all__ = ["Distinction", "distinguish", "doctor", "refuse_constant_results", "refuse_unsatisfiable"]

__getattr__, __dir__ = lazy_attributes(globals())
