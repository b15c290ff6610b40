"""Train a policy that comes with morphgen, evaluate it in MuJoCo, and film an episode.

    python examples/08_train.py [STEPS]

Prints the success rates of the trained and of the random policy, the trained one's distance and
score, and the path of the film.
The default of 50,000 steps takes about a minute on a CPU and reaches most goals. `morphgen train`,
`eval` and `play` do the same from the command line.
"""

import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from morphgen.rl.agents import preset_of
from morphgen.rl.config import configs_of, parse_agent
from morphgen.rl.evaluation import eval_config_of, evaluate_run
from morphgen.rl.inference import FPS, make_env_and_controller, play, read_controller
from morphgen.rl.runs.checkpoint import RunConfig
from morphgen.rl.runs.robot_source import robot_source
from morphgen.rl.runs.training import ExecutionConfig, train
from morphgen.tasks.render.renderer import write_video

# %%
# A run is described by its robots, its agent and the hyperparameters of PPO.
steps = int(sys.argv[1]) if len(sys.argv) > 1 else 50_000
agent = parse_agent("me-graph")
preset = preset_of(None, agent.agent)
agent = replace(agent, switches={**preset.switches, **agent.switches})
source = robot_source("arm3-stick", "reach")
policy, ppo = configs_of(agent, ["reach"], preset.constants, steps)
config = RunConfig(source, policy, ppo, sim="kinematic", num_envs=preset.num_envs)

# %%
# The folder gets the checkpoint and the metrics; `resume=True` continues an interrupted run.
folder = Path(f"runs/arm3-stick-{steps}")
train(folder, config, resume=folder.exists(), execution=ExecutionConfig(tensorboard=False))

# %%
# The kinematic simulator has no contacts, so that the policy is evaluated in MuJoCo.
(score,) = evaluate_run(folder, "train", eval_config_of(config, episodes=4), "deterministic")
print(f"success {score.success:.0%} (random policy: {score.random_success:.0%})")
print(f"final distance {score.distance:.3f} m, score {score.score:.1f}")

# %%
# A policy needs the observations that it was trained with: this call makes such an
# environment.
controller = read_controller(str(folder), "reach")
env, act = make_env_and_controller(
    controller, "arm3-stick", 0, sim="mujoco", render_mode="rgb_array"
)
with closing(env):
    write_video(play(env, act, 1, 0, lambda episode: None), Path("reach.mp4"), FPS)
print("film: reach.mp4")
