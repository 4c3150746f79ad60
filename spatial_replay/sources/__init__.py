"""Open logs of any format, or list their contents.

Modules are imported at the first use of their names.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from spatial_replay.lazy import lazy_attributes

if TYPE_CHECKING:
    from spatial_replay.sources.open_log import open_source, read_trace
    from spatial_replay.sources.overview import messages_in, overview_of, survey

__all__ = ["messages_in", "open_source", "overview_of", "read_trace", "survey"]

__getattr__, __dir__ = lazy_attributes(globals())
