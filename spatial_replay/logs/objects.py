"""Traces to and from the messages of /spatial/objects."""

from spatial_replay.logs.decoding import decode_objects
from spatial_replay.logs.encoding import encode_objects

__all__ = ["decode_objects", "encode_objects"]
