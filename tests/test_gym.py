"""Episodes of gymnasium environments, judged while they happen."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv

import spatial_replay as sr
from spatial_replay.annotate.stages import stages
from spatial_replay.gym import Judge

_REACH = sr.parse_specification(
    """
spec near = hand dist cup <= 0.1
spec calm = effort <= 0.3
spec lifted = z >= 0.2
spec task = (G calm) and F (near and F (G[0, 0.2s] lifted))
"""
)
_LIFT = sr.parse_specification(
    """
spec near = hand dist cup <= 0.1
spec lifted = z >= 0.2
spec task = F (near and F (G[0, 0.2s] lifted))
"""
)
_RATE_HZ = 10.0


class Line(gymnasium.Env[np.ndarray, int]):
    """A hand on a line that goes to a cup, and lifts it once it is there; `length` steps an episode.

    An action is a step of the hand, and its effort. Every third step reports no effort.
    """

    observation_space = gymnasium.spaces.Box(-10.0, 10.0, (2,), np.float64)
    action_space = gymnasium.spaces.Discrete(3)

    def __init__(self, length: int = 12, cup: float = 1.0) -> None:
        self._length, self._cup = length, cup

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self._steps, self._state = 0, np.array([self.np_random.uniform(0.0, 0.4), 0.0])
        return self._state.copy(), {"cup": self._cup, "effort": 0.0}

    def step(self, action: int) -> Any:
        self._steps += 1
        if abs(self._state[0] - self._cup) <= 0.2:
            self._state[1] += 0.15
        else:
            self._state[0] += 0.25 * action
        info: dict[str, Any] = {"cup": self._cup}
        if self._steps % 3:
            info["effort"] = 0.2 * float(action)
        return self._state.copy(), float(action), False, self._steps >= self._length, info


def _objects(observation: np.ndarray, info: dict[str, Any]) -> dict[str, sr.Footprint]:
    return {
        "hand": sr.Footprint.disc(float(observation[0]), 0.0, 0.02),
        "cup": sr.Footprint.disc(float(info["cup"]), 0.0, 0.05),
    }


def _signals(observation: np.ndarray, info: dict[str, Any]) -> dict[str, float]:
    return {"z": float(observation[1]), "effort": float(info.get("effort", math.nan))}


def _judged(env: Any, specification: sr.Specification = _REACH, **options: Any) -> Any:
    return Judge(env, specification, _objects, signals=_signals, rate_hz=_RATE_HZ, **options)


def _episode(env: Any, action: int = 1, seed: int = 3) -> list[tuple[float, bool, bool, dict[str, Any]]]:
    """Return reward, ends and judgement of each sample of an episode; the first is that of the reset."""
    _, info = env.reset(seed=seed)
    rows = [(0.0, False, False, info["judge"])]
    while not (rows[-1][1] or rows[-1][2]):
        _, reward, terminated, truncated, info = env.step(action)
        rows.append((reward, terminated, truncated, info["judge"]))
    return rows


def _same(one: Any, other: Any) -> bool:
    return one == other or (one != one and other != other)


@pytest.mark.parametrize("specification", [_REACH, _LIFT])
@pytest.mark.parametrize("action", [0, 1, 2])
def test_every_step_has_the_numbers_of_a_replay_of_its_log(
    tmp_path: Path, specification: sr.Specification, action: int
) -> None:
    env = _judged(Line(), specification, log=lambda judge: tmp_path / f"{judge['episode']}.mcap")
    rows = [row[-1] for row in _episode(env, action)]
    trace = sr.read_trace(tmp_path / "0.mcap")
    assert trace.times_ns.tolist() == [100_000_000 * number for number in range(len(rows))]
    evaluation = sr.evaluate(specification, trace)
    run, root = stages(evaluation, "task", rate_hz=_RATE_HZ), evaluation.result("task").nodes[0]
    for number, row in enumerate(rows):
        prefix = sr.evaluate(specification, trace.slice(0, number + 1)).result("task")
        assert _same(row["margin"], prefix.robustness)
        assert row["verdict"] == prefix.verdict
        assert row["settled"] == (root.lower[number] >= 0.0 or root.upper[number] < 0.0)
        assert (row["stage"], row["owed"]) == (run[number].name, run[number].owed)
        assert row["progress"] == run.progress[number]


def test_an_episode_ends_with_its_verdict_and_says_why() -> None:
    rows = _episode(_judged(Line(), until="settled"), action=2)
    *_, (_, terminated, truncated, judge) = rows
    assert len(rows) == 2
    assert (terminated, truncated) == (True, False)
    assert (judge["verdict"], judge["success"], judge["settled"]) == ("violated", False, True)
    assert judge["reason"] == "effort is 0.1 too high: `effort <= 0.3` fails by 0.1 at 0.100 s"
    # its other settled verdict does not end it, and no verdict does by default
    assert len(_episode(_judged(Line(), until="satisfied"), action=2)) == 13
    assert len(_episode(_judged(Line()), action=2)) == 13


def test_a_reward_is_the_gain_of_a_step() -> None:
    for reward in ("margin", "progress"):
        rows = _episode(_judged(Line(), _LIFT, reward=reward))
        levels = [judge[reward] for *_, judge in rows]
        known = [level for level in levels if math.isfinite(level)]
        assert sum(row[0] for row in rows) == pytest.approx(known[-1] - known[0])
        assert known[-1] > known[0]


def _single(seed: int, action: int, length: int, count: int, **options: Any) -> list[dict[str, Any]]:
    """Return the judgements of some episodes of one environment, the first of them with a seed."""
    env = _judged(Line(length), **options)
    rows = [row[-1] for number in range(count) for row in _episode(env, action, None if number else seed)]
    return [dict(row) for row in rows]


def _judge_of(infos: dict[str, Any], number: int) -> dict[str, Any] | None:
    """Return `info["judge"]` of one environment of a vector."""
    if "judge" not in infos or not infos["_judge"][number]:
        return None
    judge = infos["judge"]
    keys = [key for key in judge if f"_{key}" in judge and judge[f"_{key}"][number]]
    return {key: judge[key][number] for key in keys if key != "env"}


def _judgements(env: VectorEnv[Any, Any, Any], steps: int) -> list[list[dict[str, Any]]]:
    """Return the judgements of each environment of a vector, those of the last samples of episodes, too."""
    rows: list[list[dict[str, Any]]] = [[] for _ in range(env.num_envs)]
    _, infos = env.reset(seed=3)
    for step in range(steps + 1):
        if step:
            _, _, _, _, infos = env.step(np.array([1, 2, 1]))
        for number in range(env.num_envs):
            for part in (infos.get("final_info", {}), infos):
                judge = _judge_of(part, number)
                if judge is not None:
                    rows[number].append(judge)
    env.close()
    return rows


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_a_vector_has_the_numbers_of_its_environments(mode: AutoresetMode) -> None:
    lengths = (5, 7, 6)
    envs = [partial(Line, length) for length in lengths]
    steps = 16
    outside = _judgements(_judged(SyncVectorEnv(envs, autoreset_mode=mode)), steps)
    inside = _judgements(
        SyncVectorEnv([lambda env=env: _judged(env()) for env in envs], autoreset_mode=mode), steps
    )
    for number, length in enumerate(lengths):
        expected = _single(3 + number, (1, 2, 1)[number], length, 3)
        # in the same step, an episode has its last sample and the next one its first
        assert len(outside[number]) >= 16
        for rows in (outside[number], inside[number]):
            for row, single in zip(rows, expected, strict=False):
                assert row.keys() == single.keys()
                assert all(_same(row[key], single[key]) for key in row), (row, single)


def test_environments_in_processes_are_judged() -> None:
    envs = AsyncVectorEnv([partial(Line, length) for length in (5, 7, 6)])
    assert _judgements(_judged(envs), 6)[1][-1]["verdict"] == "violated"


def test_only_the_environments_that_are_reset_begin_again(tmp_path: Path) -> None:
    envs = SyncVectorEnv([Line, Line, Line], autoreset_mode=AutoresetMode.DISABLED)
    env = _judged(
        envs,
        until="violated",
        log=lambda judge: None if judge["success"] else tmp_path / f"{judge['env']}-{judge['episode']}.mcap",
    )
    env.reset(seed=3)
    _, _, terminations, _, infos = env.step(np.array([1, 2, 1]))
    assert terminations.tolist() == [False, True, False]
    assert [path.name for path in tmp_path.iterdir()] == ["1-0.mcap"]
    _, infos = env.reset(options={"reset_mask": terminations})
    assert infos["judge"]["episode"].tolist() == [0, 1, 0]
    assert infos["_judge"].tolist() == [False, True, False]
    env.step(np.array([1, 1, 1]))
    env.close()
    lengths = {path.stem: len(sr.read_trace(path)) for path in tmp_path.iterdir()}
    assert lengths == {"0-0": 3, "1-0": 2, "1-1": 2, "2-0": 3}


def test_a_name_that_the_environment_never_has_is_warned_of_once() -> None:
    env = Judge(Line(), sr.parse_specification("F (hand dist cupp <= 1)"), _objects, rate_hz=_RATE_HZ)
    with pytest.warns(UserWarning, match="'cupp'.*did you mean 'cup'") as remarks:
        _episode(env)
        _episode(env)
    assert len(remarks) == 1


def test_arguments_that_do_not_fit_are_refused_with_the_remedy() -> None:
    vector = SyncVectorEnv([Line, Line])
    with pytest.raises(sr.UsageError, match=r"until: a vector environment resets .*wrappers=\["):
        _judged(vector, until="settled")
    with pytest.raises(sr.UsageError, match="give objects="):
        Judge(Line(), _REACH, rate_hz=_RATE_HZ)
    with pytest.raises(sr.UsageError, match="reward is 'robustness'; give margin, progress"):
        _judged(Line(), reward="robustness")
    with pytest.raises(sr.UsageError, match="'tusk', and no result has this name; did you mean 'task'"):
        _judged(Line(), result="tusk")
    with pytest.raises(sr.NoAutomatonError, match="past"):
        _judged(Line(), sr.parse_specification("F (O (effort >= 1))"), reward="progress")
