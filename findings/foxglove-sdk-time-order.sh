#!/bin/sh
# foxglove-sdk 0.30.3: a client gets times of `broadcast_time` before messages that were logged earlier.
#
# Guess before the run: one connection is one queue, so a client gets messages and times in the order of the calls.
# Seen: one thread logs message n, then broadcasts time n, 2,000 times. In four runs 680 to 1,007 times arrived before their
# message. Messages among themselves keep their order.
# Source: `data_plane_tx` and `control_plane_tx` of `ConnectedClient` in the server of the Rust SDK are two queues for
# each client: messages take the first, times the second.
# For whom: players and simulators that publish a clock. A viewer that treats a time as "all earlier messages are here"
# draws the sample before; a recorder that stamps what it receives with the last time stamps messages late.
set -eu

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet foxglove-sdk==0.30.3 websockets==17.4

cat >"$folder/run.py" <<'PY'
import asyncio
import json
import struct
import time

import foxglove
import websockets
from foxglove import Channel
from foxglove.websocket import Capability

COUNT = 2000
MESSAGE, TIME = 1, 2


def publish(server, channel):
    for number in range(1, COUNT + 1):
        channel.log({"number": number}, log_time=number)
        server.broadcast_time(number)
        if number % 50 == 0:
            # below the length of the queues, so that the client is not disconnected as too slow
            time.sleep(0.05)


async def receive(client):
    """Return kinds and times in the order in which they arrive."""
    arrivals = []
    while len(arrivals) < 2 * COUNT:
        data = await asyncio.wait_for(client.recv(), 30)
        if isinstance(data, bytes):
            begin = 5 if data[0] == MESSAGE else 1
            arrivals.append((data[0], struct.unpack("<Q", data[begin : begin + 8])[0]))
    return arrivals


async def run():
    server = foxglove.start_server(host="127.0.0.1", port=0, capabilities=[Capability.Time])
    channel = Channel("/number", message_encoding="json")
    address = f"ws://127.0.0.1:{server.port}"
    async with websockets.connect(address, subprotocols=["foxglove.sdk.v1"]) as client:
        advertised = {"op": ""}
        while advertised["op"] != "advertise":
            advertised = json.loads(await client.recv())
        wish = {"id": 1, "channelId": advertised["channels"][0]["id"]}
        await client.send(json.dumps({"op": "subscribe", "subscriptions": [wish]}))
        await asyncio.sleep(1)
        publishing = asyncio.create_task(asyncio.to_thread(publish, server, channel))
        arrivals = await receive(client)
        await publishing
    server.stop()
    places = {arrival: place for place, arrival in enumerate(arrivals)}
    numbers = range(1, COUNT + 1)
    ahead = sum(places[TIME, number] < places[MESSAGE, number] for number in numbers)
    messages = [number for kind, number in arrivals if kind == MESSAGE]
    print(f"{ahead} of {COUNT} times came before their message")
    print("messages among themselves in order:", messages == list(numbers))
    print("some times came before their message:", ahead > 0)


asyncio.run(run())
PY
"$folder/venv/bin/python" "$folder/run.py" | tee "$folder/output"
tail -n 2 "$folder/output" | diff - /dev/fd/3 3<<'EXPECTED'
messages among themselves in order: True
some times came before their message: True
EXPECTED
echo "foxglove-sdk 0.30.3: as described"
