"""Controllers that learn nothing, by their names."""

from __future__ import annotations

from morphgen.rl.references import InverseKinematics, Random, Zero
from morphgen.rl.rollouts import Controller
from morphgen.rl.scripted_push import ScriptedPush
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.free_space import FreeSpace


def reference(name: str, batch: TaskBatch, seed: int) -> Controller:
    """The controller of a name in ``morphgen.rl.names.REFERENCES``, for a batch.

    Raises:
        BenchmarkError: If a robot has hardly a free configuration.
    """
    if name == "ik":
        return InverseKinematics(seed, [FreeSpace(setting.scene) for setting in batch.settings])
    if name == "scripted":
        return ScriptedPush(seed)
    return Random(seed) if name == "random" else Zero()
