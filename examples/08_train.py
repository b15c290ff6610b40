"""Train a policy that comes with morphgen, evaluate it in MuJoCo, and film an episode.

    python examples/08_train.py [STEPS]

Prints the success rates of the trained and of the random policy, the trained one's distance and
score, and the path of the film.
The default of 50,000 steps takes about a minute on a CPU and reaches most goals. `morphgen train`,
`eval` and `play` do the same from the command line.
"""

import sys
from pathlib import Path

import morphgen

# %%
# The folder gets the checkpoint and the metrics; `resume=True` continues an interrupted run.
steps = int(sys.argv[1]) if len(sys.argv) > 1 else 50_000
folder = Path(f"runs/arm3-stick-{steps}")
run = morphgen.train(
    "arm3-stick task=reach",
    sim="kinematic",
    steps=steps,
    out=folder,
    resume=folder.exists(),
    tensorboard=False,
)

# %%
# The kinematic simulator has no contacts, so that the policy is evaluated in MuJoCo.
evaluation = morphgen.evaluate(run.folder, episodes=4, mode="deterministic")
(score,) = evaluation.scores["deterministic"]
print(f"success {score.success:.0%} (random policy: {score.random_success:.0%})")
print(f"final distance {score.distance:.3f} m, score {score.score:.1f}")

# %%
# The environment of an episode has the observations that the policy was trained with.
morphgen.play("reach", "arm3-stick", policy=run.folder, sim="mujoco", out="reach.mp4")
print("film: reach.mp4")
