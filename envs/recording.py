"""Episodes recorded as they are played, as a Minari data set for offline learning.

Minari needs infos that look alike in every step; ours differ between ``reset`` and ``step``. They are made alike: what
a step reports of its simulation, with NaN where ``reset`` has nothing to report.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from splatsoil.errors import ParameterError, RunError

from .plow_sand import PlowSandEnv

if TYPE_CHECKING:
    from minari import DataCollector


def recorded(env: gym.Env[Any, Any]) -> DataCollector:
    """PlowSand-v0 in Minari's recorder, which remembers every episode that an agent plays.

    Raises:
        ParameterError: another environment, or the extra ``minari`` isn't installed.
    """
    inner = env.unwrapped
    if not isinstance(inner, PlowSandEnv):
        raise ParameterError(f"episodes of PlowSand-v0 are recorded, not of {inner}")
    try:
        import jax  # noqa: F401 (Minari's recorder needs it at the first step)
        from minari import DataCollector, StepDataCallback
    except ImportError as error:
        raise ParameterError("recorded episodes need the extra: pip install 'splatsoil[minari]'") from error
    nothing = dict.fromkeys(inner.problem.space.names, np.nan)

    class Alike(StepDataCallback):
        """Infos of one shape, and of an action what counted: beyond [-1, 1] it is clipped."""

        def __call__(self, env: gym.Env[Any, Any], **step: Any) -> Any:
            data, info = super().__call__(env, **step), step["info"]
            if data["action"] is not None:
                data["action"] = step["obs"]["last_action"]
            data["info"] = {
                **{key: {**nothing, **info.get(key, {})} for key in ("parameters", "truth")},
                "failed": info.get("status") == "failed",
                "seed": int(info.get("seed", -1)),
            }
            return data

    return DataCollector(env, step_data_callback=Alike, record_infos=True, data_format="hdf5")


def write(recorder: DataCollector, dataset_id: str, **about: Any) -> Any:
    """Export what was recorded as the data set that ``minari.load_dataset(dataset_id)`` reads.

    Args:
        recorder: of :func:`recorded`.
        dataset_id: as ``plow-sand/random-v0``.
        about: more for readers, as ``create_dataset`` takes it: algorithm_name, author, description, …

    Raises:
        RunError: a data set of this name is there already, or it can't be written.
    """
    try:
        with warnings.catch_warnings():
            # An author, a link to code: recommended for data sets that are published, and the user's choice.
            warnings.filterwarnings("ignore", "`.*` is set to None", UserWarning)
            return recorder.create_dataset(dataset_id, **about)
    except (ValueError, OSError) as error:
        raise RunError(f"data set {dataset_id}: cannot be written ({error})") from error
