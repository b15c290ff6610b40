"""Train stable-baselines3's PPO on two different arms at once.

    python examples/07_stable_baselines3.py [STEPS]

Needs `pip install stable-baselines3`. Prints the mean distance to the goal after an episode of the
untrained and of the trained policy: with the default of 30,000 steps, which take half a minute on a
CPU, from about 0.9 m to less than 0.2 m.
"""

import sys
from typing import Any

import numpy as np
from stable_baselines3 import PPO

import morphgen
from morphgen.tasks.gym.sb3 import SB3Vector
from morphgen.tasks.observation import ObservationConfig

# %%
# Robots share one space: observations are padded and masked, actions of missing joints are ignored.
# Channels of kinematics tell the policy what each joint does to the tool: it learns in seconds.
steps = int(sys.argv[1]) if len(sys.argv) > 1 else 30_000
robots = ["arm3-stick", "chain beads=3"]
channels = ObservationConfig(jacobian=True, dls=True)
vector = morphgen.make_env("reach", robots, num_envs=16, sim="kinematic", observe=channels, seed=0)
envs = SB3Vector(vector)


def mean_distance(model: PPO, duration: int = 150) -> float:
    """Return the mean distance between tool and goal [m] after a number of control steps."""
    observation: Any = envs.reset()
    infos: list[dict[str, Any]] = []
    for _ in range(duration):
        actions, _ = model.predict(observation, deterministic=True)
        observation, _, _, infos = envs.step(actions)
    return float(np.mean([info["distance"] for info in infos]))


# %%
model = PPO("MultiInputPolicy", envs, n_steps=32, batch_size=128, n_epochs=4, gamma=0.95, seed=0)
print(f"untrained: {mean_distance(model):.2f} m from the goals")

# %%
model.learn(steps)
print(f"after {model.num_timesteps} steps: {mean_distance(model):.2f} m from the goals")
envs.close()
