"""A server of the Foxglove SDK in a process of its own, which plays a part of a log once it is listened to.

    python player.py LOG PORT SPEED FROM TO TOPIC…

It prints its port (0 takes any that is free), waits until the topics are subscribed to, plays what was logged
from FROM to TO seconds after the first message, prints "played", and stays until it is ended.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import foxglove

from spatial_replay.bags.decoders import channel_of
from spatial_replay.bags.open import open_messages


def say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def main() -> None:
    log, port, speed, begin, end, *topics = sys.argv[1:]
    reader = open_messages(Path(log))
    context = foxglove.Context()
    channels = {}
    for topic in reader.topics():
        declared = channel_of(topic)
        schema = declared.schema
        if schema is not None:
            described = foxglove.Schema(name=schema.name, encoding=schema.encoding, data=schema.data)
            channels[topic.name] = foxglove.Channel(
                topic.name, schema=described, message_encoding=declared.encoding, context=context
            )
    server = foxglove.start_server(name="player", host="127.0.0.1", port=int(port), context=context)
    say(str(server.port))
    while not all(channels[topic].has_sinks() for topic in topics):
        time.sleep(0.002)
    messages = list(reader.iter_messages(channels))
    first_ns = messages[0].log_time_ns
    span_ns = first_ns + round(float(begin) * 1e9), first_ns + round(float(end) * 1e9)
    began = time.monotonic()
    for message in messages:
        if span_ns[0] <= message.log_time_ns < span_ns[1]:
            due = began + (message.log_time_ns - span_ns[0]) / 1e9 / float(speed)
            time.sleep(max(0.0, due - time.monotonic()))
            channels[message.topic].log(message.payload, log_time=message.log_time_ns)
    say("played")
    while True:
        time.sleep(60)


if __name__ == "__main__":
    main()
