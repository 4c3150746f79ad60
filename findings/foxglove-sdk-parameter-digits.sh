#!/bin/sh
# foxglove-sdk 0.30.3: a number that a client sets arrives one unit of its last place off, in one of twenty.
#
# Guess before the run: a parameter is a double, JSON writes all its digits, so it arrives to the last bit.
# Seen: of 200 numbers between 0 and 100 with 16 or 17 digits, 10 arrive at `on_set_parameters` as a neighbouring double,
# and viewers are answered with that. Numbers with few digits are exact.
# Source: the server's parser of the `setParameters` message; decimals with up to 15 digits are not concerned.
# For whom: a threshold that is set from a tool and stored; equality with the number sent fails, a hash changes.
set -eu

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet foxglove-sdk==0.30.3 websockets==17.4

cat >"$folder/run.py" <<'PY'
import asyncio
import json
import random

import foxglove
import websockets
from foxglove.websocket import Capability, ServerListener


class Listener(ServerListener):
    def __init__(self):
        self.values = {}

    def on_set_parameters(self, client, parameters, request_id=None):
        self.values |= {parameter.name: parameter.get_value() for parameter in parameters}
        return parameters


async def set_parameters(port, numbers):
    """Set parameters, and return the values that the server confirms."""
    listed = [{"name": f"p{index}", "value": number} for index, number in enumerate(numbers)]
    address = f"ws://127.0.0.1:{port}"
    async with websockets.connect(address, subprotocols=["foxglove.sdk.v1"]) as client:
        await client.send(json.dumps({"op": "setParameters", "id": "1", "parameters": listed}))
        while True:
            message = await asyncio.wait_for(client.recv(), 10)
            answer = json.loads(message) if isinstance(message, str) else {}
            if answer.get("op") == "parameterValues":
                return {parameter["name"]: parameter["value"] for parameter in answer["parameters"]}


listener = Listener()
server = foxglove.start_server(
    host="127.0.0.1", port=0, capabilities=[Capability.Parameters], server_listener=listener
)
generator = random.Random(1)
long = [generator.uniform(0, 100) for _ in range(200)]
short = [round(number, 3) for number in long]
for kind, numbers in (("all digits", long), ("three decimals", short)):
    confirmed = asyncio.run(set_parameters(server.port, numbers))
    changed = [index for index, number in enumerate(numbers) if listener.values[f"p{index}"] != number]
    is_same = all(confirmed[f"p{index}"] == listener.values[f"p{index}"] for index in range(200))
    print(f"{kind}: {len(changed)} of {len(numbers)} arrive changed; confirmed as they arrived: {is_same}")
    for index in changed[:1]:
        print(f"  {numbers[index]!r} arrives as {listener.values[f'p{index}']!r}")
server.stop()
PY

"$folder/venv/bin/python" "$folder/run.py" 2>"$folder/errors" | tee "$folder/output"
diff "$folder/output" - <<'EXPECTED'
all digits: 10 of 200 arrive changed; confirmed as they arrived: True
  94.52706955539223 arrives as 94.52706955539225
three decimals: 0 of 200 arrive changed; confirmed as they arrived: True
EXPECTED
echo "foxglove-sdk 0.30.3: as described"
