"""Episodes recorded as they are played, and exported as a Minari data set for offline learning.

Minari's own ``DataCollector`` needs JAX and infos that look alike in every step; ours differ between ``reset`` and
``step``. Here they are made alike: what a step says of its simulation, with NaN where ``reset`` has nothing to say.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from splatsoil.errors import ParameterError, RunError

from .plow_sand import Observation, PlowSandEnv

if TYPE_CHECKING:
    from minari import MinariDataset


@dataclass
class Recorded:
    """One episode of k steps: k + 1 observations and infos, k of everything else."""

    seed: int | None
    observations: list[Observation]
    infos: list[dict[str, Any]]
    actions: list[npt.NDArray[np.float32]] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    terminations: list[bool] = field(default_factory=list)
    truncations: list[bool] = field(default_factory=list)


class EpisodeRecorder(gym.Wrapper[Observation, npt.NDArray[np.float32], Observation, npt.NDArray[np.float32]]):
    """Remembers every episode that an agent plays on PlowSand-v0, whatever agent that is.

    Attributes:
        episodes: those that have at least one step, the one going on included.
    """

    def __init__(self, env: gym.Env[Observation, npt.NDArray[np.float32]]) -> None:
        super().__init__(env)
        if not isinstance(env.unwrapped, PlowSandEnv):
            raise ParameterError(f"an EpisodeRecorder records PlowSand-v0, not {env.unwrapped}")
        self._names = env.unwrapped.problem.space.names
        self._all: list[Recorded] = []

    @property
    def episodes(self) -> tuple[Recorded, ...]:
        """Those with at least one step."""
        return tuple(episode for episode in self._all if episode.actions)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin another episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._all.append(Recorded(seed, [observation], [self._info({})]))
        return observation, info

    def step(self, action: npt.NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """A step, remembered before it is handed on."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        episode = self._all[-1]
        # What counted, not what was asked: an action beyond [-1, 1] is clipped.
        episode.actions.append(observation["last_action"].copy())
        episode.observations.append(observation)
        episode.infos.append(self._info(info))
        episode.rewards.append(float(reward))
        episode.terminations.append(bool(terminated))
        episode.truncations.append(bool(truncated))
        return observation, float(reward), terminated, truncated, info

    def _info(self, info: Mapping[str, Any]) -> dict[str, Any]:
        parameters = info.get("parameters", {})
        return {
            "parameters": {name: float(parameters.get(name, np.nan)) for name in self._names},
            "truth": {name: float(info.get("truth", {}).get(name, np.nan)) for name in self._names},
            "failed": info.get("status") == "failed",
            "seed": int(info.get("seed", -1)),
        }

    def write(self, dataset_id: str, *, algorithm: str = "", **about: Any) -> MinariDataset:
        """Export all episodes as a data set of Minari's, which ``minari.load_dataset(dataset_id)`` reads.

        It is kept in ``$MINARI_DATASETS_PATH``, or ``~/.minari/datasets``. An episode that isn't over is marked as
        truncated. ``recover_environment()`` makes the same world again, unless it was made from a ``problem``.

        Args:
            dataset_id: as ``plow-sand/random-v0``.
            algorithm: what chose the actions.
            about: more for readers, as ``minari.create_dataset_from_buffers`` takes it: author, description, …

        Raises:
            ParameterError: the extra ``minari`` isn't installed, or nothing has been recorded.
            RunError: a data set of this name is there already, or it can't be written.
        """
        try:
            import minari
            from minari.data_collector import EpisodeBuffer
        except ImportError as error:
            raise ParameterError("recorded episodes need the extra: pip install 'splatsoil[minari]'") from error
        episodes = self.episodes
        if not episodes:
            raise ParameterError("nothing to export: no step has been taken since the recorder was made")
        buffers = [
            EpisodeBuffer(
                id=k,
                seed=episode.seed,
                observations=_stacked(episode.observations),
                actions=np.stack(episode.actions),
                rewards=episode.rewards,
                terminations=episode.terminations,
                truncations=[*episode.truncations[:-1], not episode.terminations[-1]],
                infos=_stacked(episode.infos),
            )
            for k, episode in enumerate(episodes)
        ]
        try:
            with warnings.catch_warnings():
                # An author, a link to code: recommended for data sets that are published, and the user's choice.
                warnings.filterwarnings("ignore", "`.*` is set to None", UserWarning)
                return minari.create_dataset_from_buffers(
                    dataset_id,
                    buffers,
                    env=self.env.spec,
                    action_space=self.env.action_space,
                    observation_space=self.env.observation_space,
                    algorithm_name=algorithm or None,
                    data_format="hdf5",
                    **about,
                )
        except (ValueError, OSError) as error:
            raise RunError(f"data set {dataset_id}: cannot be written ({error})") from error


def _stacked(steps: Any) -> dict[str, Any]:
    """Dicts of one shape, one for each step, as one dict of arrays."""
    return {
        key: _stacked([step[key] for step in steps]) if isinstance(first, dict) else np.stack([s[key] for s in steps])
        for key, first in steps[0].items()
    }
