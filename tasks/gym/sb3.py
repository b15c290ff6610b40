"""A task batch as a vector environment of stable-baselines3."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from morphgen.errors import TaskError
from morphgen.tasks.gym.vector import NumpyObservation, TaskVector

Indices = int | Iterable[int] | None


class SB3Vector(VecEnv):
    """A ``VecEnv`` that steps a ``TaskVector``, which it owns.

    Every info has ``distance`` and ``score``; where an episode ended also
    ``terminal_observation``, ``TimeLimit.truncated`` (bootstrap from that observation's value),
    ``is_success`` and ``diverged``.
    """

    def __init__(self, vector: TaskVector) -> None:
        self.vector = vector
        self._actions: NDArray[Any] = np.zeros(0)
        self.render_mode = vector.render_mode
        super().__init__(
            vector.num_envs, vector.single_observation_space, vector.single_action_space
        )

    def reset(self) -> dict[str, NDArray[Any]]:
        """Begin an episode in every environment, with the seed if one was set."""
        observation, _ = self.vector.reset(seed=self._seeds[0], options=self._options[0])
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keep actions for ``step_wait``."""
        self._actions = actions

    def step_wait(
        self,
    ) -> tuple[NumpyObservation, NDArray[Any], NDArray[np.bool_], list[dict[str, Any]]]:
        """Act for one control step."""
        observation, reward, terminated, truncated, step_infos = self.vector.step(self._actions)
        ended = terminated | truncated
        infos: list[dict[str, Any]] = [
            {"distance": distance, "score": score}
            for distance, score in zip(
                step_infos["distance"].tolist(), step_infos["score"].tolist(), strict=True
            )
        ]
        for env in np.flatnonzero(ended):
            infos[env]["terminal_observation"] = step_infos["final_obs"][env]
            infos[env]["TimeLimit.truncated"] = bool(truncated[env])
            infos[env]["is_success"] = bool(step_infos["success"][env])
            infos[env]["diverged"] = bool(step_infos["diverged"][env])
        return observation, reward, ended, infos

    def close(self) -> None:
        """Free the environments."""
        self.vector.close()

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Return an attribute of the ``TaskVector``, which all environments share."""
        value = getattr(self.vector, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:  # noqa: ANN401
        """Set an attribute of the ``TaskVector``."""
        self._require_all(attr_name, indices)
        setattr(self.vector, attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,  # noqa: ANN401
        indices: Indices = None,
        **method_kwargs: Any,  # noqa: ANN401
    ) -> list[Any]:
        """Call a method of the ``TaskVector`` once, for all environments."""
        self._require_all(method_name, indices)
        result = getattr(self.vector, method_name)(*method_args, **method_kwargs)
        return [result] * self.num_envs

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: Indices = None
    ) -> list[bool]:
        """Return False for each environment."""
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return no picture: single environments draw theirs."""
        return [None] * self.num_envs

    def _require_all(self, name: str, indices: Indices) -> None:
        if list(self._get_indices(indices)) != list(range(self.num_envs)):
            raise TaskError(
                f"{name}: environments of a batch share their attributes; leave out indices"
            )
