"""A control step of a batch on a GPU as CUDA graphs: the host launches it in a few calls."""

from __future__ import annotations

import torch

from morphgen.tasks.batch import Step, TaskBatch

WARM_UP = 3
"""Steps before the capture, which load kernels and choose algorithms."""


class StepGraph:
    """Steps a batch on a GPU; what comes before and after the physics is a CUDA graph each.

    A step is a thousand short operations, and to launch them one by one takes longer than they
    run. The results of a call are overwritten by the next one. Episodes go on where they were, but
    a reset with another seed records the graphs anew.
    """

    def __init__(self, batch: TaskBatch) -> None:
        """Record the graphs; ``reset`` of the batch must follow."""
        self._batch = batch
        shape = (batch.num_envs, batch.robot_tables.max_links)
        kind = torch.int64 if batch.action_kind == "discrete" else torch.float32
        self._actions = torch.zeros(shape, dtype=kind, device=batch.device)
        self._diverged = torch.zeros(batch.num_envs, dtype=torch.bool, device=batch.device)
        self._record()

    def __call__(self, actions: torch.Tensor) -> Step:
        """Act for one control step; see ``TaskBatch.step``. The next call overwrites the result.

        actions: Shape (n, L).
        """
        if self._seed != self._batch.seed:
            self._record()
        self._actions.copy_(actions)
        self._act.replay()
        self._diverged.copy_(self._batch.simulation.step(self._before.targets))
        self._finish.replay()
        return self._step

    def _record(self) -> None:
        """Run the step a few times on a stream of its own, and record it; keep the episodes."""
        batch, state = self._batch, self._batch.state_dict()
        self._seed = batch.seed
        stream = torch.cuda.Stream(batch.device)  # type: ignore[no-untyped-call]
        stream.wait_stream(torch.cuda.current_stream(batch.device))
        with torch.cuda.stream(stream):
            batch.reset()
            for _ in range(WARM_UP):
                batch.step(self._actions)
        torch.cuda.current_stream(batch.device).wait_stream(stream)
        self._act, self._finish = torch.cuda.CUDAGraph(), torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._act):
            self._before = batch.act(self._actions)
        with torch.cuda.graph(self._finish, pool=self._act.pool()):
            self._step = batch.finish(self._before, self._diverged)
        batch.load_state_dict(state)


def can_record(batch: TaskBatch) -> bool:
    """Return whether a batch is on a GPU and no channel of its observations reads from it."""
    if batch.device.type != "cuda":
        return False
    return "ik" not in batch.observation_config.kinematic_channels
