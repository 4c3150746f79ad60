"""A log served live: the latencies of a viewer on the same machine."""

from __future__ import annotations

import itertools
import json
import os
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

import spatial_replay as sr
from spatial_replay.annotate.standing import StandingEncoder
from spatial_replay.logs.source import MemorySource
from spatial_replay.logs.topics import CURVES_TOPIC, SCENE
from spatial_replay.replay.loaded_log import LoadedLog
from spatial_replay.serve.server import open_server
from spatial_replay.trace.trace import Trace

SAMPLES = 100_000
WINDOWS = ("0,600", "0,10000", "0s,1s")
"""Windows of an inner operator; a change costs the same for each."""
OUTER = ("0,5", "0s,0.2s")
"""Windows of an outer operator, which is evaluated at each pending position."""
FLAT = (
    "G O F[0,60] {a}",
    "G ({a} -> {b} U[0.5s,2s] {c})",
    "G ({a} -> (F[0s,2s] {b}) or (F[0s,3s] {c}))",
    "G ({a} -> G[0,600] F[0,600] {b})",
    "G ({a} S[0,60] F[0,60] {b})",
    "G ({b} S F[0,600] {c})",
    "G ({a} S[0,600] F[0,600] {b})",
    "G ((F[0,600] {a}) <-> (F[0,600] {b}))",
    "G ((F[0,600] {a}) -> (F[0,600] {b}))",
    "G ((F[0,6000] {a}) xor {b})",
    "(G ({a} -> F[0,600] {b})) U (F[0,600] {c})",
)
"""Further formulas for which the cost of a change does not depend on the width of windows."""
OPEN = (
    "G ({a} -> F[0,60] ({b} and F[0,60] {c}))",
    "G ({a} -> F ({b} and G[0,60] {c}))",
    "G[0,50000] ({a} -> F ({b} and F[0,60] {c}))",
    "G ({a} -> O[0,60] ({b} and F[0,60] {c}))",
)
"""Formulas with more state per pending position."""
DEEP = (
    "G ({a} -> F[0,600] G[0,600] {b})",
    "G ({a} -> F[0s,10s] ({b} and F[0s,10s] {c}))",
    "G ({a} -> F[0,30] ({b} and F[0,30] ({c} and F[0,30] ({a} and G[0,10] {b}))))",
)
"""The slowest of these formulas."""
WIDE = (
    "G ({a} -> F[0,6000] G[0,6000] {b})",
    "G ({a} -> F[0,6000] ({b} and F[0,6000] {c}))",
    "G ({a} -> F[0,5000] ({b} and F[0,60] {c}))",
    "G ({a} -> F[0,100] ({b} and F[0,100] ({c} and G[0,100] {a})))",
    "G ({a} -> F[0,600] ({b} and F[0,600] ({c} and G[0,600] {a})))",
    "G ({a} -> F ({b} and F[0,600] {c}))",
    "G ({a} -> {b} U[0,600] ({c} and F[0,600] {a}))",
    "G ({a} -> X F[0,600] ({b} and X F[0,600] {c}))",
    "G ({a} -> H[0,60] F[0,60] {b})",
    "G ({a} S ({b} and F[0,60] {c}))",
    "G ({a} -> F[0,600] ({b} U[0,600] {c}))",
    "G ({a} -> {b} U[0,600] G[0,600] {c})",
    "G[0,50000] ({a} -> F[0,6000] ({b} and F[0,6000] {c}))",
    "G ({a} -> O[0,600] ({b} and F[0,600] {c}))",
)
"""Slower formulas."""
LONGEST = (
    "G ({a} -> F[0,6000] ({b} and F[0,6000] ({c} and F[0,6000] {a})))",
    "G ({a} -> F[600,1200] ({b} and F[0,600] {c}))",
    "G ({a} S[0,600] ({b} and F[0,600] {c}))",
    "G ({a} -> {b} U ({c} and F[0,600] {a}))",
    "G[0,50000] ({a} -> F ({b} and F[0,600] {c}))",
    "G ({a} -> O[0,6000] ({b} and F[0,6000] {c}))",
)
"""Formulas with higher costs, without a limit."""
FALLING = (OPEN[0], DEEP[1], WIDE[1], WIDE[3], WIDE[4], WIDE[6])
"""Formulas for a run that worsens with every sample, so that all pending positions matter; no limit."""
CHANGES = 9
PATIENCE_S = 60.0


class Viewer:
    """A viewer that waits for messages of one topic at a time."""

    def __init__(self, connection: ClientConnection) -> None:
        self._connection = connection
        self._channels: dict[str, int] = {}
        self._values = itertools.count(20)
        while not self._channels:
            match json.loads(connection.recv(PATIENCE_S)):
                case {"op": "advertise", "channels": channels}:
                    self._channels = {each["topic"]: each["id"] for each in channels}

    def subscribe(self, topic: str) -> None:
        number = self._channels[topic]
        self._send(op="subscribe", subscriptions=[{"id": number, "channelId": number}])

    def unsubscribe(self, topic: str) -> None:
        self._send(op="unsubscribe", subscriptionIds=[self._channels[topic]])

    def change(self, topic: str) -> None:
        """Give the constant `near` a new value, and wait for the next message of a topic."""
        value = float(next(self._values))
        self._send(op="setParameters", parameters=[{"name": "near", "value": value, "type": "float64"}])
        self.wait_for(topic)

    def ask(self) -> None:
        """Request the parameters, and wait for the response."""
        self._send(op="getParameters", parameterNames=[], id="asked")
        while True:
            received = self._connection.recv(PATIENCE_S)
            if isinstance(received, str) and json.loads(received).get("id") == "asked":
                return

    def wait_for(self, topic: str) -> None:
        head = struct.pack("<BI", 1, self._channels[topic])
        while True:
            received = self._connection.recv(PATIENCE_S)
            if isinstance(received, bytes) and received.startswith(head):
                return

    def _send(self, **request: Any) -> None:
        self._connection.send(json.dumps(request))


def bench_serve(measure: Any) -> None:
    """The block-pushing specification over its camera recording, repeated up to 100,000 samples."""
    data = _data()
    if not data.is_dir():
        return
    text = json.loads((data / "expected.json").read_text())["blocks_moving_passage"]["spec"]
    with viewing(_trace(data), text.replace("closeto ", "closeto[near] ")) as viewer:

        def look() -> None:
            viewer.subscribe(SCENE)
            viewer.wait_for(SCENE)
            viewer.unsubscribe(SCENE)

        measure("subscribe to first scene", lambda _: look(), unit="viewer", limit_s=0.1)
        viewer.subscribe(CURVES_TOPIC)
        viewer.wait_for(CURVES_TOPIC)
        measure("change to curves of all", lambda _: viewer.change(CURVES_TOPIC), unit="change", limit_s=0.1)
        viewer.subscribe(SCENE)
        viewer.wait_for(SCENE)
        measure("change to scene", lambda _: viewer.change(SCENE), unit="change")


def bench_serve_windows(measure: Any) -> None:
    """A window below another temporal operator, over the same samples."""
    data = _data()
    if not data.is_dir():
        return
    for window in WINDOWS:
        text = _response(window)
        with viewing(_trace(data), text) as viewer:
            viewer.subscribe(CURVES_TOPIC)
            viewer.wait_for(CURVES_TOPIC)
            measure(
                f"change, window [{window}]",
                lambda _: viewer.change(CURVES_TOPIC),
                unit="change",
                runs=3,
                limit_s=0.1,
            )


def bench_what_if(bench: Any) -> None:
    """Time from a constant to all curves, against numpy over as many numbers; and time of all cores."""
    data = _data()
    if not data.is_dir():
        return
    trace = _trace(data)
    blocks = json.loads((data / "expected.json").read_text())["blocks_moving_passage"]["spec"]
    cases = [("block pushing", blocks.replace("closeto ", "closeto[near] "), 25.0)]
    # parsing and encoding of curves weigh more for few numbers
    cases += [(f"window [{window}]", _response(window), 90.0) for window in WINDOWS]
    cases += [(f"a window below one [{outer}]", _nested(outer), 200.0) for outer in OUTER]
    cases += [(text.format_map(_NAMES), _spec(text), 200.0) for text in FLAT]
    cases += [(text.format_map(_NAMES), _spec(text), 200.0) for text in OPEN]
    cases += [(text.format_map(_NAMES), _spec(text), 250.0) for text in DEEP]
    cases += [(text.format_map(_NAMES), _spec(text), 250.0) for text in WIDE]
    for name, text, most in cases:
        _measure_changes(bench, name, trace, text, most)


def bench_what_if_longest(bench: Any) -> None:
    """The same for wide windows with many pending positions."""
    data = _data()
    if data.is_dir():
        trace = _trace(data)
        for text in LONGEST:
            _measure_changes(bench, text.format_map(_NAMES), trace, _spec(text), None)


def bench_what_if_falling(bench: Any) -> None:
    """The same for falling signals, for which every pending position may become the worst."""
    rng, falling = np.random.default_rng(3), np.linspace(0.0, -1000.0, SAMPLES)
    x, y, z = (falling + rng.normal(size=(3, SAMPLES))).tolist()
    trace = sr.Trace.from_samples(
        sr.Sample(index * 33_333_333, {}, {"x": x[index], "y": y[index], "z": z[index]})
        for index in range(SAMPLES)
    )
    atoms = {"a": "(x <= near)", "b": "(y >= near)", "c": "(z >= 0)"}
    for text in FALLING:
        _measure_changes(
            bench, text.format_map(_NAMES), trace, f"spec passed = {text.format_map(atoms)}", None
        )


def _measure_changes(bench: Any, name: str, trace: Trace, text: str, most: float | None) -> None:
    """Measure changes of a constant.

    Args:
        most: limit as a multiple of a numpy pass; None for no limit.
    """
    loaded = LoadedLog(MemorySource(trace), [sr.parse_specification(f"const near = 70\n{text}")])
    numbers = np.concatenate([each.series for each in loaded.evaluate().stretches])
    values = (float(20 + change) for change in range(CHANGES))
    times = np.array([_spent(partial(_curves_with, loaded, value)) for value in values])
    passes = np.array([_spent(partial(numbers.min, axis=2)) for _ in range(CHANGES)])
    waited, spent = times.T.tolist()
    bench.quantile(f"{name}: a change", waited, 0.5, unit="change", limit_s=0.05 if most else None)
    bench.quantile(f"{name}: processor time", spent, 0.5, unit="change")
    if most:
        bench.ratio(f"{name}, to numpy's", float(np.median(waited) / np.median(passes[:, 0])), most)


def _curves_with(loaded: LoadedLog, near: float) -> bytes:
    return loaded.evaluate({"near": near}).curves


def _spent(run: Callable[[], object]) -> tuple[float, float]:
    """Return the wall time and the processor time of all cores for a run, in seconds."""
    start_s, spent_s = time.perf_counter(), time.process_time()
    run()
    return time.perf_counter() - start_s, time.process_time() - spent_s


_NAMES = {"a": "a", "b": "b", "c": "c"}


def _spec(text: str) -> str:
    atoms = {"a": "red1 closeto[near] blue1", "b": "red1 below blue1", "c": "red1 leftof blue1"}
    return f"spec passed = {text.format_map(atoms)}"


def _nested(outer: str) -> str:
    unit = "s" if "s" in outer else ""
    inner = f"0{unit},{2 if unit else 60}{unit}"
    return f"spec passed = G (red1 closeto[near] blue1 -> F[{outer}] G[{inner}] red1 below blue1)"


def _response(window: str) -> str:
    return f"spec passed = G (red1 closeto[near] blue1 -> F[{window}] red1 below blue1)"


def bench_serve_relay(measure: Any) -> None:
    """A request and its response through the relay, which reads every frame of an older viewer."""
    trace = sr.Trace.from_samples(
        sr.Sample(index * 10**8, {"a": sr.Footprint.box(index, 0, index + 1, 1)}) for index in range(10)
    )
    for protocol in ("foxglove.sdk.v1", "foxglove.websocket.v1"):
        with viewing(trace, "spec there = F a closeto[near] a", protocol) as viewer:
            measure(f"question, {protocol}", lambda _: viewer.ask(), unit="question", limit_s=0.05)


def bench_standing(measure: Any) -> None:
    """Messages of standing: one and eight results over the camera recording, at most 50 per second."""
    data = _data()
    if not data.is_dir():
        return
    trace = sr.read_trace(data / "blocks_moving_passage.jsonl.gz")
    for count in (1, 8):
        text = "\n".join(f"spec s{index} = G red1 farfrom[{-index}] blue1" for index in range(count))
        evaluated = LoadedLog(MemorySource(trace), [sr.parse_specification(text)]).evaluate()
        trees, (samples, blocks) = evaluated.evaluation.trees, evaluated.part(0, len(trace))
        written, of_none = [tree.written(text) for tree in trees], [""] * count
        measure(
            f"standing of {count}",
            partial(_encode, samples.times_ns, blocks, of_none),
            prepare=partial(StandingEncoder, trees, [None] * count, written, {}),
            unit="sample",
            per=len(trace),
        )


def _encode(times_ns: Any, blocks: Any, over: list[str], encoder: StandingEncoder) -> object:
    return encoder.encode(times_ns, blocks, over)


@contextmanager
def viewing(trace: Trace, text: str, protocol: str = "foxglove.sdk.v1") -> Iterator[Viewer]:
    """Yield a viewer of a log and a specification with the constant `near`."""
    loaded = LoadedLog(MemorySource(trace), [sr.parse_specification(f"const near = 70\n{text}")])
    with (
        open_server(loaded.evaluate(), port=0) as server,
        connect(server.address, subprotocols=[Subprotocol(protocol)], max_size=None) as connection,
    ):
        yield Viewer(connection)


def _data() -> Path:
    return Path(os.environ.get("SPATIAL_REPLAY_DATA", "")) / "paper"


def _trace(data: Path) -> Trace:
    return _long(sr.read_trace(data / "blocks_moving_passage.jsonl.gz"))


def _long(trace: Trace) -> Trace:
    """Return the trace, repeated."""
    step_ns = int(np.median(np.diff(trace.times_ns)))
    length_ns = int(trace.times_ns[-1] - trace.times_ns[0]) + step_ns
    repeated = [
        replace(trace, times_ns=trace.times_ns + index * length_ns)
        for index in range(SAMPLES // len(trace) + 1)
    ]
    return Trace.concatenate(repeated).slice(0, SAMPLES)
