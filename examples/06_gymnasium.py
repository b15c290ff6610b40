"""Step one robot with Gymnasium, then several different robots in one vector environment.

Prints the spaces, the result of an episode of random actions, and the distances to their goals of
three robots that follow the Jacobian controller, a baseline that does not learn.
"""

import morphgen
from morphgen.rl.baselines import BASELINES

# %%
# Name the robot in any way that the command line knows. An action is a step of each joint.
env = morphgen.make_env("reach", "arm=ur5 ee=plane", sim="mujoco")
observation, info = env.reset(seed=0)
print(env.action_space, {name: entry.shape for name, entry in observation.items()})

# %%
# The loop of any Gymnasium environment. Episodes end by themselves, after 6 s.
env.action_space.seed(0)
terminated = truncated = False
while not (terminated or truncated):
    action = env.action_space.sample()
    observation, reward, terminated, truncated, info = env.step(action)
print(f"random actions: {info['distance']:.2f} m from the goal, success: {info['success']}")
env.close()

# %%
# Environment i has robot i modulo their number. All robots share one observation space.
robots = ["ur5-stick", "panda-stick", "arm3-stick"]
envs = morphgen.make_env("reach", robots, num_envs=6, sim="mujoco", seed=0)
observations, infos = envs.reset(seed=0)
print({name: entry.shape for name, entry in observations.items()})

# %%
# Baselines act on the batch of tensors below the vector environment.
controller = BASELINES["jacobian"].make(0)
for _ in range(150):
    actions = controller.act(envs.batch).numpy()[:, envs.action_links]
    observations, rewards, terminations, truncations, infos = envs.step(actions)
print("jacobian controller:", infos["distance"].round(3), "m from the goals")
envs.close()
