"""Write demonstrations as a LeRobotDataset v3, and read its columns: Parquet and JSON.

LeRobot itself is not used: it needs other versions of torch and NumPy. Arms differ in their joints:
features of joints are padded with zeros to the largest robot, and ``joint_count`` says how many are
real. ``robot_index`` is the line of the robot in ``bodies/robots.jsonl``. The same episodes give
the same bytes with the same version of pyarrow.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from morphgen.errors import TaskError, explain_missing_extras
from morphgen.files import replacing_file, write_cache_file
from morphgen.formats.data_files import parse_json, read_json, read_text
from morphgen.formats.zip_files import read_npz
from morphgen.tasks.registry import TASKS
from morphgen.tasks.sim.base import CONTROL_PERIOD

if TYPE_CHECKING:
    import pyarrow

BODIES = "bodies"  # folder with the bundle of each robot, by its hash
RECORDING, INDEX, BODY = "recording.json", "bodies/robots.jsonl", "body.json"
FORMAT = 1  # version of what morphgen adds to the format of LeRobot
Arrays = dict[str, NDArray[Any]]

FPS = round(1 / CONTROL_PERIOD)
VERSION = "v3.0"
INFO, STATS, TASKS_FILE = "meta/info.json", "meta/stats.json", "meta/tasks.parquet"
CHUNK = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA_PATH = f"data/{CHUNK}.parquet"
VIDEO_PATH = f"videos/{{video_key}}/{CHUNK}.mp4"
EPISODES_FILE = "meta/episodes/chunk-000/file-000.parquet"
CHUNKS_SIZE, DATA_MB, VIDEO_MB = 1000, 100, 200
"""Files in a folder, and sizes above which another file begins: LeRobot's defaults."""
QUANTILES = (0.01, 0.1, 0.5, 0.9, 0.99)
JOINTS = {
    "observation.state": "q",
    "observation.velocity": "qd",
    "observation.targets": "targets",
    "action": "action",
    "normalized_action": "normalized_action",
    "executed_action": "executed_action",
}
"""Features with a number per joint, and their arrays in shards."""
_POSE = ["x", "y", "z", "qw", "qx", "qy", "qz"]
STATE = "observation.environment_state"


def require_pyarrow() -> None:
    """Require the optional package that reads and writes Parquet."""
    with explain_missing_extras("demos"):
        import pyarrow.parquet  # noqa: F401


def is_data_set(folder: Path) -> bool:
    """Return whether a folder is, or is to become, a data set: of ``record`` or any LeRobot."""
    return any((folder / name).is_file() for name in (RECORDING, INFO))


def read_shard(path: Path) -> tuple[list[dict[str, Any]], Arrays]:
    """Return the episodes of a shard, and the arrays of their steps, one after another."""
    arrays = read_npz(path)
    return json.loads(str(arrays.pop("episodes"))), arrays


def video_path(shard: Path, feature: str) -> Path:
    """Return the video of a feature in the episodes of a shard."""
    return shard.with_suffix(f".{feature}.mp4")


def assemble(
    folder: Path,
    shards: Mapping[str, Path],
    tasks: Sequence[str],
    videos: Mapping[str, Mapping[str, Any]],
) -> None:
    """Write the files of the format from at least one episode; ``meta/info.json`` last.

    Shards are by the hash of their robot, in order; ``videos`` are the features of the cameras.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    bodies = [read_json(folder / BODIES / robot / BODY) for robot in shards]
    dofs = [len(body["joints"]) for body in bodies]
    sizes = {field.name: field.size for task in tasks for field in TASKS[task].fields}
    names = {feature: [f"joint_{i}" for i in range(max(dofs))] for feature in JOINTS}
    names |= {"observation.tool_pose": _POSE, "observation.object_pose": _POSE}
    names[STATE] = [f"{name}_{i}" for name, size in sizes.items() for i in range(size)]
    features: dict[str, Any] = {}
    rows: list[dict[str, Any]] = []
    num_frames = file_index = num_videos = 0
    writer = None
    path = folder / DATA_PATH.format(chunk_index=0, file_index=0)
    for robot_index, (robot, shard) in enumerate(shards.items()):
        episodes, arrays = read_shard(shard)
        if not episodes:
            continue
        columns = _columns(arrays, max(dofs), sizes)
        columns |= _index_columns(episodes, tasks, first_frame=num_frames, first_episode=len(rows))
        columns["joint_count"] = np.full(len(columns["index"]), dofs[robot_index])
        columns["robot_index"] = np.full(len(columns["index"]), robot_index)
        table = pa.table({name: _array(values) for name, values in columns.items()})
        if writer is None:
            path = folder / DATA_PATH.format(**_place(file_index))
            path.parent.mkdir(parents=True, exist_ok=True)
            writer = pq.ParquetWriter(path, table.schema, compression="zstd", use_dictionary=False)
        writer.write_table(table)
        features = {
            name: {
                "dtype": str(values.dtype),
                "shape": [*values.shape[1:]] or [1],
                "names": names.get(name),
            }
            for name, values in columns.items()
        }
        facts: dict[str, Any] = {f"data/{key}": value for key, value in _place(file_index).items()}
        facts |= {"robot_hash": robot, "robot_index": robot_index, "joint_count": dofs[robot_index]}
        rows += _episode_rows(episodes, columns, facts, num_videos)
        for name in videos:
            target = folder / VIDEO_PATH.format(video_key=name, **_place(num_videos))
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(video_path(shard, name), target)
        num_videos += 1
        num_frames += len(table)
        if path.stat().st_size > DATA_MB * 2**20:
            writer.close()
            writer, file_index = None, file_index + 1
    if not rows:
        raise TaskError(f"{folder}: no episode ended in success, and nothing else is to be kept")
    if writer is not None:
        writer.close()
    _write_meta(folder, rows, [*features, *videos], tasks)
    kept = ("robot_hash", "name", "category", "derivation", "licences")
    index = [{name: body[name] for name in kept} | {"dof": len(body["joints"])} for body in bodies]
    write_cache_file(folder / INDEX, "".join(f"{json.dumps(row)}\n" for row in index))
    info = {
        "codebase_version": VERSION,
        "robot_type": "morphgen",
        "total_episodes": len(rows),
        "total_frames": num_frames,
        "total_tasks": len(tasks),
        "chunks_size": CHUNKS_SIZE,
        "data_files_size_in_mb": DATA_MB,
        "video_files_size_in_mb": VIDEO_MB,
        "fps": FPS,
        "splits": {"train": f"0:{len(rows)}"},
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH if videos else None,
        "features": features | dict(videos),
    }
    _write_json(folder / INFO, info)


def _index_columns(
    episodes: Sequence[Mapping[str, Any]],
    tasks: Sequence[str],
    *,
    first_frame: int,
    first_episode: int,
) -> Arrays:
    """Return the columns of a shard that its place in the data set determines."""
    lengths = [episode["length"] for episode in episodes]
    frame = np.concatenate([np.arange(length) for length in lengths])
    return {
        "frame_index": frame,
        "timestamp": (frame / FPS).astype(np.float32),
        "index": first_frame + np.arange(len(frame)),
        "episode_index": first_episode + np.repeat(np.arange(len(lengths)), lengths),
        "task_index": np.repeat([tasks.index(each["task"]) for each in episodes], lengths),
    }


def _episode_rows(
    episodes: Sequence[Mapping[str, Any]],
    columns: Arrays,
    facts: Mapping[str, Any],
    video_index: int,
) -> Iterator[dict[str, Any]]:
    """Yield the row of each episode of a shard."""
    start = 0
    for episode in episodes:
        length = episode["length"]
        own = {name: values[start : start + length] for name, values in columns.items()}
        yield {
            "episode_index": int(own["episode_index"][0]),
            "tasks": [episode["task"]],
            "dataset_from_index": int(own["index"][0]),
            "dataset_to_index": int(own["index"][-1]) + 1,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
            **facts,
            **{key: value for key, value in episode.items() if key != "videos"},
            **_statistics(own),
            **_video_columns(episode.get("videos", {}), length, video_index),
        }
        start += length


def _place(file_index: int) -> dict[str, int]:
    """Return the folder and number of a file."""
    return {"chunk_index": file_index // CHUNKS_SIZE, "file_index": file_index % CHUNKS_SIZE}


def _columns(arrays: Arrays, num_joints: int, sizes: Mapping[str, int]) -> Arrays:
    """Return the columns of a shard by feature, without those that its place determines.

    ``num_joints`` is of the largest robot; ``sizes`` are of the observation fields of all tasks.
    """
    columns: Arrays = {}
    for name, source in JOINTS.items():
        if source in arrays:  # the last one only with noise
            padding = (0, 0), (0, num_joints - arrays[source].shape[1])
            columns[name] = np.pad(arrays[source], padding)
    for name in ("tool_pose", "object_pose"):
        columns[f"observation.{name}"] = arrays[name]
    n = len(arrays["reward"])
    fields = [
        arrays.get(f"field.{k}", np.zeros((n, size), np.float32)) for k, size in sizes.items()
    ]
    columns[STATE] = np.concatenate(fields, axis=1)
    return columns | {f"next.{name}": arrays[name] for name in ("reward", "success", "done")}


def _array(values: NDArray[Any]) -> pyarrow.Array:
    import pyarrow as pa

    if values.ndim == 1:
        return pa.array(values)
    flat = pa.array(np.ascontiguousarray(values).reshape(-1))
    return pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def moments(values: NDArray[np.float64]) -> Arrays:
    """Return the statistics of rows (n, k) that LeRobot wants, each of the shape (k,)."""
    quantiles = np.quantile(values, QUANTILES, axis=0)
    return {
        "min": values.min(axis=0),
        "max": values.max(axis=0),
        "mean": values.mean(axis=0),
        "std": values.std(axis=0),
        **{f"q{round(100 * q):02d}": row for q, row in zip(QUANTILES, quantiles, strict=True)},
    }


def _video_columns(shown: Mapping[str, Any], length: int, file_index: int) -> dict[str, Any]:
    """Return where an episode is in the videos, and their statistics, as columns of its row."""
    columns: dict[str, Any] = {}
    for name, video in shown.items():
        columns |= {f"videos/{name}/{key}": value for key, value in _place(file_index).items()}
        columns[f"videos/{name}/from_timestamp"] = video["first"] / FPS
        columns[f"videos/{name}/to_timestamp"] = (video["first"] + length) / FPS
        columns |= {f"stats/{name}/{key}": value for key, value in video["stats"].items()}
    return columns


def _statistics(columns: Arrays) -> dict[str, list[float] | list[int]]:
    """Return the statistics of an episode, as columns of its row."""
    wide = {name: values.reshape(len(values), -1) for name, values in columns.items()}
    joined = np.concatenate(list(wide.values()), axis=1, dtype=np.float64)
    results = moments(joined)
    statistics: dict[str, list[float] | list[int]] = {}
    start = 0
    for name, values in wide.items():
        columns_of = slice(start, start + values.shape[1])
        for key, row in results.items():
            statistics[f"stats/{name}/{key}"] = row[columns_of].tolist()
        statistics[f"stats/{name}/count"] = [len(values)]
        start += values.shape[1]
    return statistics


def _write_meta(
    folder: Path, rows: Sequence[Mapping[str, Any]], features: Sequence[str], tasks: Sequence[str]
) -> None:
    """Write the tasks, the episodes and the statistics of all episodes."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    task_table = pa.table({"task_index": list(range(len(tasks))), "task": list(tasks)})
    kinds = {"task_index": ("int64", "int64"), "task": ("unicode", "object")}
    columns = [
        {"name": k, "field_name": k, "pandas_type": a, "numpy_type": b, "metadata": None}
        for k, (a, b) in kinds.items()
    ]
    # What pandas itself writes, by which it knows that the names of the tasks are an index.
    index = {"index_columns": ["task"], "column_indexes": [], "columns": columns}
    task_table = task_table.replace_schema_metadata({"pandas": json.dumps(index)})
    for name, table in (
        (TASKS_FILE, task_table),
        (EPISODES_FILE, pa.Table.from_pylist(list(rows))),
    ):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        with replacing_file(folder / name) as partial:
            pq.write_table(table, partial, compression="zstd")
    stats: dict[str, dict[str, list[float]]] = {}
    for name in features:
        own = {
            key: np.array([row[f"stats/{name}/{key}"] for row in rows])
            for key in ("min", "max", "mean", "std", *(f"q{round(100 * q):02d}" for q in QUANTILES))
        }
        total = sum(row[f"stats/{name}/count"][0] for row in rows)
        counts = np.array([row[f"stats/{name}/count"][0] for row in rows], np.float64)
        counts = counts.reshape(-1, *[1] * (own["min"].ndim - 1))
        # As LeRobot does: quantiles are means of those of the episodes.
        merged = {key: (own[key] * counts).sum(axis=0) / total for key in own}
        spread = own["std"] ** 2 + (own["mean"] - merged["mean"]) ** 2
        merged["std"] = np.sqrt((spread * counts).sum(axis=0) / total)
        merged |= {"min": own["min"].min(axis=0), "max": own["max"].max(axis=0)}
        stats[name] = {key: values.tolist() for key, values in merged.items()}
        stats[name]["count"] = [total]
    _write_json(folder / STATS, stats)


def _write_json(path: Path, data: object) -> None:
    write_cache_file(path, json.dumps(data, indent=2) + "\n")


def read_index(folder: Path) -> list[dict[str, Any]]:
    """Return the rows of the robots, which ``robot_index`` refers to."""
    return [parse_json(line, INDEX) for line in read_text(folder / INDEX).splitlines()]


def read_episodes(folder: Path) -> Iterator[dict[str, Any]]:
    """Yield the numbers and texts in the rows of the episodes."""
    from pyarrow.types import is_large_string, is_primitive, is_string

    file = _open_parquet(folder / EPISODES_FILE)
    kinds = is_primitive, is_string, is_large_string
    names = [each.name for each in file.schema_arrow if any(is_a(each.type) for is_a in kinds)]
    size = 0
    for batch in file.iter_batches(_ROWS_AT_ONCE, columns=names):
        if (size := size + batch.nbytes) > MAX_EPISODE_BYTES:
            raise ValueError(f"{EPISODES_FILE}: more than {MAX_EPISODE_BYTES // 2**20} MB")
        yield from batch.to_pylist()


def data_files(folder: Path) -> list[Path]:
    """Return the files with the steps of a data set."""
    return sorted((folder / "data").glob("*/*.parquet"))


def read_columns(folder: Path) -> dict[str, NDArray[Any]]:
    """Return the features of all steps by name: arrays (frames,), or (frames, size)."""
    import pyarrow as pa

    tables = []
    for path in data_files(folder):
        file = _open_parquet(path)
        width = sum(_bits(each.type) for each in file.schema_arrow) / 8
        if file.metadata.num_rows * width > _largest(path):
            raise ValueError(f"{path.name}: {file.metadata.num_rows} steps in a file of its size")
        tables.append(file.read())
    columns = {}
    table = pa.concat_tables(tables)
    for name in table.column_names:
        column = table[name].combine_chunks()
        if hasattr(column.type, "list_size"):
            columns[name] = column.flatten().to_numpy().reshape(len(table), -1)
        else:
            columns[name] = column.to_numpy(zero_copy_only=False)
    return columns


MAX_EPISODE_BYTES = 2**28  # of the rows of all episodes
_ROWS_AT_ONCE = 64  # equal texts are stored once in a file, but not in memory
_MAX_RATIO = 200
"""Most bytes in memory per byte of a file: a stranger's file may repeat a number for ever."""


def _largest(path: Path) -> int:
    return 2**26 + _MAX_RATIO * path.stat().st_size


def _open_parquet(path: Path) -> pyarrow.parquet.ParquetFile:
    """Open a file whose columns are not much larger than the file."""
    import pyarrow.parquet as pq

    file = pq.ParquetFile(path)
    groups = [file.metadata.row_group(i) for i in range(file.num_row_groups)]
    if sum(each.total_byte_size for each in groups) > _largest(path):
        raise ValueError(f"{path.name}: unpacks to more than {_MAX_RATIO} times its size")
    if sum(each.num_rows for each in groups) != file.metadata.num_rows:
        raise ValueError(f"{path.name}: its groups have other numbers of rows than the file")
    return file


def _bits(kind: pyarrow.DataType) -> int:
    """Return the size of a number, or of a list of numbers."""
    import pyarrow as pa

    if pa.types.is_fixed_size_list(kind):
        return int(kind.list_size) * _bits(kind.value_type)
    if not pa.types.is_primitive(kind):
        raise ValueError(f"a column has the type {kind}; expected numbers")
    return int(kind.bit_width)
