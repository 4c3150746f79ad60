"""A server of the Foxglove SDK in a process of its own, which plays a log to whoever subscribes.

    python player.py LOG PORT SPEED TOPIC…

It prints its port, waits until the topics are subscribed to, plays, says "played", and stays until it is
ended. A PORT of 0 is any that is free. Speed 0 is as fast as it goes.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import foxglove

from spatial_replay.bags import open_messages
from spatial_replay.bags.decoders import channel_of


def main() -> None:
    log, port, speed, *topics = sys.argv[1:]
    reader = open_messages(Path(log))
    names = [topic.name for topic in reader.topics() if topic.schema is not None or topic.unreadable is None]
    context = foxglove.Context()
    channels = {}
    for topic in reader.topics():
        if topic.name in names:
            declared = channel_of(topic)
            schema = declared.schema
            assert schema is not None
            described = foxglove.Schema(name=schema.name, encoding=schema.encoding, data=schema.data)
            channels[topic.name] = foxglove.Channel(
                topic.name, schema=described, message_encoding=declared.encoding, context=context
            )
    server = foxglove.start_server(name="player", host="127.0.0.1", port=int(port), context=context)
    sys.stdout.write(f"{server.port}\n")
    sys.stdout.flush()
    while not all(channels[topic].has_sinks() for topic in topics):
        time.sleep(0.002)
    first_ns, began = None, time.monotonic()
    for message in reader.iter_messages(names):
        if first_ns is None:
            first_ns = message.log_time_ns
        if float(speed):
            pause = began + (message.log_time_ns - first_ns) / 1e9 / float(speed) - time.monotonic()
            if pause > 0:
                time.sleep(pause)
        channels[message.topic].log(message.payload, log_time=message.log_time_ns)
    sys.stdout.write("played\n")
    sys.stdout.flush()
    while True:
        time.sleep(60)


if __name__ == "__main__":
    main()
