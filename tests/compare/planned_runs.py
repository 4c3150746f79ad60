"""A recorded run of the planner that differs from another one in a decision."""

from __future__ import annotations

from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import Writer

from spatial_replay.logs.schemas.PlanDecision_pb2 import PlanDecision


def with_another_decision(log: Path, copy: Path) -> Path:
    """A copy of a planned run whose second decision has another reason, and another map of one object."""
    numbers: dict[int, int] = {}
    with log.open("rb") as stream, copy.open("wb") as output:
        writer = Writer(output)
        writer.start()
        for schema, channel, message in make_reader(stream).iter_messages():
            if channel.id not in numbers:
                assert schema is not None
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                numbers[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schema_id
                )
            payload = message.data
            if channel.topic == "/plan/decision":
                decision = PlanDecision.FromString(payload)
                if decision.number == 1:
                    decision.reason = f"differently: {decision.reason}"
                    decision.considered[0].candidates[0].map_sha256 = b"another"
                payload = decision.SerializeToString()
            times = message.log_time, payload, message.publish_time
            # maps are named by their numbers
            writer.add_message(numbers[channel.id], *times, message.sequence)
        writer.finish()
    return copy
