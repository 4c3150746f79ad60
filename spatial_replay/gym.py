"""Episodes of gymnasium environments, judged while they run."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from fractions import Fraction
from os import PathLike
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias

import numpy as np

from spatial_replay.annotate.stages import LiveStages
from spatial_replay.errors import NoAutomatonError, UsageError, importing
from spatial_replay.geometry.footprint import Footprint, TrackedObject
from spatial_replay.monitor.monitor import Monitor, Update
from spatial_replay.monitor.verdict import Verdict, final_verdict
from spatial_replay.recording.recorder import Recorder
from spatial_replay.spec.formula import Specification
from spatial_replay.spec.load import require_specification
from spatial_replay.text import listing, nearest_hint
from spatial_replay.trace.trace import Sample

with importing("judging environments takes gymnasium", extra="gym"):
    import gymnasium
    from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
    from gymnasium.vector.utils import iterate

if TYPE_CHECKING:
    _VectorWrapper: TypeAlias = VectorWrapper[Any, Any, Any, Any, Any]
else:
    # the class is not generic in gymnasium 1.1
    _VectorWrapper = VectorWrapper

Objects: TypeAlias = Callable[[Any, dict[str, Any]], Mapping[str, TrackedObject | Footprint]]
"""Function from an observation and its info to objects by name."""
Signals: TypeAlias = Callable[[Any, dict[str, Any]], Mapping[str, float | str]]
"""Function from an observation and its info to signals by name."""
Judged: TypeAlias = dict[str, Any]
"""The `info["judge"]` of a step, see `Judge`."""
LogPath: TypeAlias = Callable[[Judged], str | PathLike[str] | None]
"""Function from the last `info["judge"]` of an episode to the path of its log; None writes no log."""

_UNTIL: Final = ("satisfied", "violated", "settled")
_REWARDS: Final = ("margin", "progress")


class Judge(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment whose episodes are judged by a specification.

    Every reset and every step gives a sample. `info["judge"]` has:

    - `episode`: number of the episode, from 0.
    - `env`: number of the environment; only in a vector.
    - `verdict`: "satisfied", "violated" or "unknown", as if the episode ended with this sample.
    - `success`: whether the verdict is "satisfied".
    - `settled`: whether no later sample can change the verdict.
    - `margin`: robustness of the episode so far; NaN if not determined.
    - `stage`, `owed`, `progress`: see `annotate.stages`; only for a spec with an automaton.
    - `reason`: sentence on the violation; only at the end of an episode with a settled violation.

    A replay of the episode's log gives equal numbers.
    """

    def __new__(cls, env: Any = None, *arguments: Any, **options: Any) -> Any:
        """Return a `VectorJudge` for a vector environment."""
        if isinstance(env, VectorEnv):
            return VectorJudge(env, *arguments, **options)
        return super().__new__(cls)

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        specification: Specification,
        objects: Objects | None = None,
        *,
        rate_hz: float,
        signals: Signals | None = None,
        result: str | None = None,
        until: Literal["satisfied", "violated", "settled"] | None = None,
        reward: Literal["margin", "progress"] | None = None,
        log: LogPath | None = None,
    ) -> None:
        """Wrap an environment, or a vector of them.

        Args:
            objects, signals: functions that return the objects and signals of a sample.
            rate_hz: steps per second. The reset of an episode has the time 0.
            result: name of the spec that judges; by default the last spec that no other spec uses.
            until: settled verdict that terminates an episode.
            reward: "margin" or "progress": the gain of this value since the previous sample replaces the
                environment's reward. A margin that is not finite gains 0, and the next gain is relative to
                the last finite margin.
            log: function that is called at the end of each episode, and returns the path of its log.

        Raises:
            UsageError: a spec or option is unknown, the spec is a template, objects and signals are missing,
                or `until` is given with a vector environment that resets itself.
            NoAutomatonError: `reward="progress"` with a spec without an automaton.
        """
        super().__init__(env)
        self._episodes = _Episodes(
            specification,
            objects,
            rate_hz=rate_hz,
            signals=signals,
            result=result,
            until=until,
            reward=reward,
            log=log,
        )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        """Reset the environment. The observation is the first sample of a new episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        return observation, {**info, "judge": self._episodes.begin(observation, info)}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment, and judge its observation."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        episodes = self._episodes
        judgement = episodes.extend(observation, info, ended=bool(terminated or truncated))
        terminated = bool(terminated or episodes.ends)
        return observation, episodes.gain(reward), terminated, truncated, {**info, "judge": judgement}

    def close(self) -> None:
        """Write the log of an unfinished episode if requested, and close the environment."""
        self._episodes.end()
        super().close()


class VectorJudge(_VectorWrapper):
    """A vector environment whose episodes are judged. `Judge` returns it for a vector environment.

    Values of `info["judge"]` are arrays with masks (`_verdict`, …). A step that ends and resets an episode
    has the values of the episode's last sample in `info["final_info"]["judge"]`.
    """

    def __init__(
        self, env: VectorEnv[Any, Any, Any], specification: Specification, *arguments: Any, **options: Any
    ) -> None:
        """Wrap a vector environment, with the arguments of `Judge`."""
        super().__init__(env)
        self._mode = env.metadata.get("autoreset_mode")
        if not isinstance(self._mode, AutoresetMode):
            raise UsageError(
                f'metadata["autoreset_mode"] of the vector environment is {self._mode!r}; set it to the'
                " gymnasium.vector.AutoresetMode that the environment has"
            )
        if options.get("until") is not None and self._mode is not AutoresetMode.DISABLED:
            raise UsageError(
                "until: a vector environment resets its episodes itself; wrap each environment:"
                " make_vec(…, wrappers=[lambda env: Judge(env, …)])"
            )
        self._episodes = [
            _Episodes(specification, *arguments, env=number, **options) for number in range(env.num_envs)
        ]
        self._has_ended = np.zeros(env.num_envs, np.bool_)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset all environments, or only the environments in the option `reset_mask`."""
        reset_mask = (options or {}).get("reset_mask")
        is_reset = np.ones(self.num_envs, np.bool_) if reset_mask is None else np.array(reset_mask, np.bool_)
        observations, infos = self.env.reset(seed=seed, options=options)
        self._has_ended &= ~is_reset
        infos = dict(infos)
        for env_index, observation in enumerate(iterate(self.env.observation_space, observations)):
            if is_reset[env_index]:
                judgement = self._episodes[env_index].begin(observation, _info_of(infos, env_index))
                infos = self._add_info(infos, {"judge": judgement}, env_index)
        return observations, infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step all environments, and judge their observations."""
        observations, rewards, terminations, truncations, infos = self.env.step(actions)
        is_reset = (
            self._has_ended if self._mode is AutoresetMode.NEXT_STEP else np.zeros_like(self._has_ended)
        )
        self._has_ended = np.logical_or(terminations, truncations)
        # copied, because an environment may reuse its arrays
        rewards, terminations, infos = np.array(rewards), np.array(terminations), dict(infos)
        for env_index, observation in enumerate(iterate(self.env.observation_space, observations)):
            episodes, info = self._episodes[env_index], _info_of(infos, env_index)
            final_values = info.pop("final_obs", None), info.pop("final_info", None)
            if is_reset[env_index]:
                # in the mode NEXT_STEP, the step after an episode's end is a reset, whose action is ignored
                judgement = episodes.begin(observation, info)
            elif self._mode is AutoresetMode.SAME_STEP and self._has_ended[env_index]:
                judgement = episodes.extend(*_last_of(final_values), ended=True)
                infos = self._add_info(infos, {"final_info": {"judge": judgement}}, env_index)
                rewards[env_index] = episodes.gain(rewards[env_index])
                judgement = episodes.begin(observation, info)
            else:
                judgement = episodes.extend(observation, info, ended=self._has_ended[env_index])
                rewards[env_index] = episodes.gain(rewards[env_index])
                terminations[env_index] |= episodes.ends
            infos = self._add_info(infos, {"judge": judgement}, env_index)
        return observations, rewards, terminations, truncations, infos

    def close(self, **options: Any) -> None:
        """Write the logs of unfinished episodes if requested, and close the environments."""
        for episodes in self._episodes:
            episodes.end()
        super().close(**options)


class _Episodes:
    """The episodes of one environment. `Judge` describes the arguments.

    Attributes:
        ends: whether the verdict terminates the episode.
    """

    def __init__(
        self,
        specification: Specification,
        objects: Objects | None = None,
        *,
        rate_hz: float,
        signals: Signals | None = None,
        result: str | None = None,
        until: str | None = None,
        reward: str | None = None,
        log: LogPath | None = None,
        env: int | None = None,
    ) -> None:
        if objects is None and signals is None:
            raise UsageError("no objects and no signals; give objects=, a function of observation and info")
        for name, value, allowed_values in (("until", until, _UNTIL), ("reward", reward, _REWARDS)):
            if value is not None and value not in allowed_values:
                raise UsageError(f"{name} is {value!r}; give {listing(allowed_values)}, or None")
        self._specification = _with_only_result(specification, result)
        self._spec = self._specification.results[-1].name
        self._monitor = Monitor(self._specification, missing_after=1)
        self._stages = _stages(self._specification, rate_hz, is_needed=reward == "progress")
        self._objects, self._signals, self._log = objects, signals, log
        self._until, self._reward = until, reward
        # the fraction equals the written decimal; a double only approximates 29.97
        period_ns = Fraction(10**9) / Fraction(repr(float(rate_hz)))
        # a product of integers takes a tenth of the time of a product with a Fraction
        self._period_ns = int(period_ns) if period_ns.denominator == 1 else period_ns
        self._env_entry: Judged = {} if env is None else {"env": env}
        self._episode = -1
        self._frame = 0
        self._samples: list[Sample] = []
        self._judged: Judged | None = None
        self._remarked: set[str] = set()
        self._gain = 0.0
        self._last_value: float | None = None
        self.ends = False

    def begin(self, observation: Any, info: dict[str, Any]) -> Judged:
        """Begin an episode with its first sample."""
        self.end()
        self._monitor.reset()
        if self._stages is not None:
            self._stages.reset()
        self._episode += 1
        self._frame, self._samples, self._last_value = 0, [], None
        return self.extend(observation, info)

    def extend(self, observation: Any, info: dict[str, Any], *, ended: bool = False) -> Judged:
        """Add a sample, and return its `info["judge"]`.

        Args:
            ended: whether the sample is the last sample of the episode.
        """
        sample = Sample(
            round(self._frame * self._period_ns),
            self._objects(observation, info) if self._objects is not None else {},
            self._signals(observation, info) if self._signals is not None else {},
        )
        self._frame += 1
        if self._log is not None:
            self._samples.append(sample)
        update = self._monitor.update(sample)
        judgement = self._judge(update)
        self._gain = 0.0
        reward_value = judgement[self._reward] if self._reward is not None else math.nan
        if math.isfinite(reward_value):
            if self._last_value is not None:
                self._gain = reward_value - self._last_value
            self._last_value = reward_value
        is_settled = judgement["settled"] and self._until in ("settled", judgement["verdict"])
        self.ends = self._until is not None and is_settled
        self._judged = judgement
        if ended or self.ends:
            if update.violations:
                judgement["reason"] = str(update.violations[0])
            self.end()
        return judgement

    def gain(self, reward: Any) -> Any:
        """Return the reward of the last step: the environment's reward, or the gain."""
        return reward if self._reward is None else self._gain

    def end(self) -> None:
        """End the episode unless it has ended, and write its log if requested."""
        judgement, self._judged = self._judged, None
        path = None if self._log is None or judgement is None else self._log(judgement)
        if path is not None:
            with Recorder(path, specifications=self._specification) as recorder:
                for sample in self._samples:
                    recorder.write(sample)

    def _judge(self, update: Update) -> Judged:
        for remark in update.remarks:
            if remark.message not in self._remarked:
                self._remarked.add(remark.message)
                # level 4 is the caller of `reset` or `step`
                warnings.warn(f"{remark.message}; {remark.hint}", stacklevel=4)
        node_numbers = update.numbers[0]
        if node_numbers is None:
            raise UsageError("the monitor has no numbers")
        margin, _, lower, upper = node_numbers[0].tolist()
        verdict = final_verdict(*self._monitor.interval(self._spec))
        judgement: Judged = {
            **self._env_entry,
            "episode": self._episode,
            "verdict": verdict.value,
            "success": verdict is Verdict.SATISFIED,
            "settled": lower >= 0.0 or upper < 0.0,
            "margin": margin,
        }
        if self._stages is not None:
            stage, progress = self._stages.extend(update.time_ns, node_numbers, self._monitor.leaves)
            judgement |= {"stage": stage.name, "owed": stage.owed, "progress": progress}
        return judgement


def _with_only_result(specification: Specification, result: str | None) -> Specification:
    """Return a specification whose only result is the spec that judges."""
    require_specification(specification)
    names = [spec.name for spec in specification.results]
    name = names[-1] if result is None else result
    if name not in names:
        hint = nearest_hint(name, names) or f"results are {listing(names)}"
        raise UsageError(f"result is {name!r}, and no result has this name; {hint}")
    specs = tuple(spec for spec in specification.specs if not spec.is_result or spec.name == name)
    return replace(specification, specs=specs)


def _stages(specification: Specification, rate_hz: float, *, is_needed: bool) -> LiveStages | None:
    """Return the stages of the only result; None for a spec without an automaton."""
    try:
        return LiveStages(specification, specification.results[-1], rate_hz=rate_hz)
    except NoAutomatonError:
        if is_needed:
            raise
        return None


def _last_of(final_values: tuple[Any, Any]) -> tuple[Any, dict[str, Any]]:
    """Return the last observation and info of an episode that was reset in the same step."""
    observation, info = final_values
    if observation is None:
        raise UsageError(
            'the vector environment has no info["final_obs"]: the last observation of an episode is lost; use'
            " the autoreset mode NEXT_STEP"
        )
    return observation, {} if info is None else info


def _info_of(infos: Mapping[str, Any], env_index: int) -> dict[str, Any]:
    """Return the info of one environment in a vector, without values that masks exclude."""
    info: dict[str, Any] = {}
    for key, values in infos.items():
        mask = infos.get(f"_{key}")
        is_mask = key.startswith("_") and key[1:] in infos
        if is_mask or (mask is not None and not mask[env_index]):
            continue
        if isinstance(values, dict):
            info[key] = _info_of(values, env_index)
        else:
            # without a mask, a value may apply to all environments
            info[key] = values[env_index] if mask is not None or np.ndim(values) else values
    return info
