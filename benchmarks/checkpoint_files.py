"""Name the checkpoint of each stored training as a file of a release; nothing is fetched.

    python benchmarks/checkpoint_files.py

Checkpoints are not in the repository. A release of the printed version would have them as files of
these names, a run of ``se`` as a zip with one for each robot, to evaluate with
``morphgen eval FILE --split SPLIT --on test``; those of 0.1 and 0.2 are no longer read. So far no
release has any: the commands of results/README.md train the runs again.
"""

from pathlib import Path

from tabulate import tabulate

from morphgen.benchmark.scores.submission import EPISODES, read_table

RESULTS = Path(__file__).resolve().parent.parent / "results"


def checkpoint_rows() -> list[list[str]]:
    """Return file, version of morphgen and split of each training with stored episodes."""
    rows = {}
    for table in sorted(RESULTS.rglob(EPISODES)):
        for run in read_table(table):
            if run.config and not run.finetuned:  # baselines have no config
                seed = f"seed{run.training_seed}"
                names = (table.parent.name, *run.split.name.split("/"), run.method, seed)
                file = "-".join(names) + (".zip" if run.method.startswith("se") else ".pt")
                rows[file] = [file, run.morphgen, run.split.name]
    return list(rows.values())


if __name__ == "__main__":
    print(tabulate(checkpoint_rows(), headers=["file", "version", "split"]))
