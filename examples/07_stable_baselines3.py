"""Train stable-baselines3's PPO on two different arms at once.

    python examples/07_stable_baselines3.py [STEPS]

Needs `pip install stable-baselines3`. Prints the mean distance to the goal after an episode of the
untrained and of the trained policy. The default of 100,000 steps takes a few minutes on a CPU.
"""

import sys
from typing import Any

import numpy as np
from stable_baselines3 import PPO

import morphgen
from morphgen.tasks.sb3 import SB3Vector

# %%
# Robots share one space: observations are padded and masked, actions of missing joints are ignored.
steps = int(sys.argv[1]) if len(sys.argv) > 1 else 100_000
robots = ["arm3-stick", "chain beads=3"]
envs = SB3Vector(morphgen.make_env("reach", robots, num_envs=16, sim="kinematic", seed=0))


def mean_distance(model: PPO, duration: int = 150) -> float:
    """Return the mean distance between tool and goal [m] after a number of control steps."""
    observation: Any = envs.reset()
    infos: list[dict[str, Any]] = []
    for _ in range(duration):
        actions, _ = model.predict(observation, deterministic=True)
        observation, _, _, infos = envs.step(actions)
    return float(np.mean([info["distance"] for info in infos]))


# %%
model = PPO("MultiInputPolicy", envs, n_steps=32, batch_size=128, n_epochs=4, seed=0)
print(f"untrained: {mean_distance(model):.2f} m from the goals")

# %%
model.learn(steps)
print(f"after {model.num_timesteps} steps: {mean_distance(model):.2f} m from the goals")
envs.close()
