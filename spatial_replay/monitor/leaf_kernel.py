"""The instructions that leaves are made of, run over columns of samples.

Each instruction writes one column in every channel (see `run`): what it computes from earlier columns, or
reads from measurements, signals and constants.
"""

from __future__ import annotations

import numpy as np

from spatial_replay.compiled import long_kernel
from spatial_replay.geometry.arrays import Flags, Floats, Integers

# instructions: operation, a, b, c
CONSTANT, MEASURED, SIGNAL = 0, 1, 2  # number a of its kind
ADD, NEGATE, LEAST, GREATEST = 3, 4, 5, 6  # numbers; not a number where an operand is not
HOLDS = 7  # a number as an interval: all of the reals where it is not a number
AND, OR, XOR, IFF = 8, 9, 10, 11  # intervals
AND_MEMBER, OR_MEMBER = 12, 13  # a, and b where members c is 1, anything where it is -1

TILE = 128
"""How many samples are taken at a time, so that their columns stay in the processor's cache."""


@long_kernel
def run_instructions(
    code: Integers,
    constants: Floats,
    values: Floats,
    spreads: Floats,
    signals: Floats,
    members: Flags,
    outputs: Integers,
    leaves: Floats,
) -> None:
    """Run the instructions over all samples; leaf j is what instruction outputs[j] gives."""
    channels, _, samples = leaves.shape
    columns = np.empty((code.shape[0], channels, min(TILE, samples)))
    for t in range(0, samples, TILE):
        count = min(TILE, samples - t)
        for i in range(code.shape[0]):
            op, a, b, c = code[i, 0], code[i, 1], code[i, 2], code[i, 3]
            for channel in range(channels):
                mirror = channel ^ 1 if channels > 1 else channel
                target = columns[i, channel]
                first, second = columns[a, channel], columns[b, channel]
                for k in range(count):
                    if op == CONSTANT:
                        target[k] = constants[a]
                    elif op == MEASURED:
                        target[k] = values[a, t + k]
                        if channel == 2:
                            target[k] -= spreads[a, t + k]
                        elif channel == 3:
                            target[k] += spreads[a, t + k]
                    elif op == SIGNAL:
                        target[k] = signals[a, t + k]
                    elif op == ADD:
                        target[k] = first[k] + second[k]
                    elif op == NEGATE:
                        target[k] = -columns[a, mirror, k]
                    elif op in (LEAST, GREATEST):
                        if np.isnan(first[k]) or np.isnan(second[k]):
                            target[k] = np.nan
                        elif op == LEAST:
                            target[k] = min(first[k], second[k])
                        else:
                            target[k] = max(first[k], second[k])
                    elif op == HOLDS:
                        target[k] = first[k]
                        if np.isnan(first[k]) or np.isnan(columns[a, mirror, k]):
                            target[k] = np.inf if channel % 2 else -np.inf
                    elif op == AND:
                        target[k] = min(first[k], second[k])
                    elif op == OR:
                        target[k] = max(first[k], second[k])
                    elif op == XOR:
                        target[k] = max(
                            min(first[k], -columns[b, mirror, k]), min(-columns[a, mirror, k], second[k])
                        )
                    elif op == IFF:
                        target[k] = min(
                            max(-columns[a, mirror, k], second[k]), max(-columns[b, mirror, k], first[k])
                        )
                    else:
                        value = second[k]
                        if members[c, t + k] < 0:
                            value = np.inf if channel % 2 else -np.inf
                        if members[c, t + k] == 0:
                            target[k] = first[k]
                        elif op == AND_MEMBER:
                            target[k] = min(first[k], value)
                        else:
                            target[k] = max(first[k], value)
        for j in range(len(outputs)):
            for channel in range(channels):
                for k in range(count):
                    leaves[channel, j, t + k] = columns[outputs[j], channel, k]
