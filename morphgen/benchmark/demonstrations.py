"""Describe demonstrations: a summary by task, dataset card, licences, Croissant and hashes."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from string import Template
from typing import Any

import yaml

from morphgen.benchmark.licences import LicencedPart, find_licence, licence_ids
from morphgen.benchmark.release import (
    CROISSANT_FILE,
    LICENCES_FILE,
    LICENCES_TEXT,
    licence_summary,
    licences_json,
    licences_text,
)
from morphgen.benchmark.split_folder import README_FILE, SUMS_FILE, read_sums, sums_text
from morphgen.benchmark.texts import read_text
from morphgen.files import write_atomic
from morphgen.formats.bundle import CARD
from morphgen.formats.data_files import read_json
from morphgen.formats.files import folder_hashes
from morphgen.rl.demonstrations.lerobot import BODIES, INDEX, INFO, RECORDING, STATS, read_index
from morphgen.rl.demonstrations.reader import Demonstrations
from morphgen.rl.demonstrations.replay import Replay
from morphgen.rl.scores import Interval, success_interval
from morphgen.tables import table


@dataclass(frozen=True)
class TaskSummary:
    """The episodes of a task."""

    task: str
    policy: str
    robots: int
    episodes: int
    steps: int
    success: Interval
    """Share of the episodes that ended in success, with its 95% Wilson interval."""


def summarize(demos: Demonstrations) -> list[TaskSummary]:
    """Return a summary of each task of a data set."""
    summaries = []
    for task in dict.fromkeys(episode.task for episode in demos.episodes):
        own = [episode for episode in demos.episodes if episode.task == task]
        rate = sum(episode.success for episode in own) / len(own)
        summaries.append(
            TaskSummary(
                task,
                own[0].policy,
                len({episode.robot_index for episode in own}),
                len(own),
                sum(episode.length for episode in own),
                success_interval([rate], [len(own)]),
            )
        )
    return summaries


def summary_text(demos: Demonstrations, style: str = "simple") -> str:
    """Return the table of the tasks of a data set."""
    headers = ("task", "policy", "robots", "episodes", "steps", "success")
    rows = [
        (each.task, each.policy, each.robots, each.episodes, each.steps, each.success.as_percent())
        for each in summarize(demos)
    ]
    return table(rows, headers, style=style)


@dataclass(frozen=True)
class Verification:
    """Result of verifying demonstrations."""

    replays: tuple[Replay, ...]
    """Simulated episodes beside the recorded ones."""
    changed_files: tuple[str, ...]
    """Files that are missing, were added, or differ from ``SHA256SUMS``."""

    @property
    def agrees(self) -> bool:
        """Whether all episodes agree and no file was changed."""
        return not self.changed_files and all(each.agrees for each in self.replays)


def changed_files(folder: Path) -> tuple[str, ...]:
    """Return the files of a data set that are missing, were added or were changed."""
    known, own = read_sums(folder / SUMS_FILE), _sums(folder)
    names = sorted(known.keys() | own.keys())
    return tuple(name for name in names if known.get(name) != own.get(name))


def _sums(folder: Path) -> dict[str, str]:
    return {k: v for k, v in folder_hashes(folder).items() if k not in (SUMS_FILE, ".lock")}


def describe(demos: Demonstrations) -> None:
    """Write card, licences, Croissant and hashes into a data set, the hashes last."""
    folder = demos.folder
    if (folder / SUMS_FILE).is_file():
        return
    parts = _licenced_parts(folder)
    texts = {
        LICENCES_FILE: licences_json(parts),
        LICENCES_TEXT: licences_text(parts),
        README_FILE: _card(demos, parts),
    }
    for name, text in texts.items():
        write_atomic(folder / name, text)
    write_atomic(folder / CROISSANT_FILE, _croissant(demos, parts, folder_hashes(folder)))
    write_atomic(folder / SUMS_FILE, sums_text(_sums(folder)))


def _licenced_parts(folder: Path) -> tuple[LicencedPart, ...]:
    """Return the parts of all robots with their licences, sorted by licence and name."""
    robots: dict[tuple[str, str, str], dict[tuple[str, str], None]] = {}
    for body in read_index(folder):
        card = read_json(folder / BODIES / body["robot_hash"] / CARD)
        for part in card.get("parts") or [{"part": body["name"], "licence": "unknown"}]:
            key = part["part"], part.get("licence", "unknown"), part.get("citation", "")
            robots.setdefault(key, {})["train", body["name"]] = None
    found = [
        LicencedPart(name, find_licence(licence), citation, (*who,))
        for (name, licence, citation), who in robots.items()
    ]
    return tuple(sorted(found, key=lambda each: (each.licence.id, each.part)))


def _card(demos: Demonstrations, parts: Sequence[LicencedPart]) -> str:
    """Return the dataset card, with the front matter that Hugging Face and LeRobot read."""
    settings = demos.settings
    ids = list(dict.fromkeys(find_licence(each).hub_id for each in licence_ids(parts)))
    tasks = [each.task for each in summarize(demos)]
    data_files = [{"split": "train", "path": "data/*/*.parquet"}]
    front = {
        "pretty_name": demos.folder.resolve().name,
        "license": ids[0] if len(ids) == 1 else ids,
        "task_categories": ["robotics"],
        "tags": ["LeRobot", "morphgen", "cross-embodiment", "croissant", *tasks],
        "configs": [{"config_name": "default", "data_files": data_files}],
    }
    noise = f"`executed_action` is what the robot did, with noise of {settings['noise']:g}."
    text = Template(read_text("demonstrations_card.md")).substitute(
        name=front["pretty_name"],
        folder=front["pretty_name"],
        episodes=f"{len(demos.episodes):,}",
        robots=f"{len(demos.robot_hashes):,}",
        steps=f"{len(demos):,}",
        fps=read_json(demos.folder / INFO)["fps"],
        sim=settings["sim"],
        morphgen=settings["morphgen"],
        tasks=summary_text(demos, "github"),
        noise=noise
        if settings["noise"]
        else "`normalized_action` its fractions of the largest steps.",
        licences=licence_summary(parts),
    )
    head: str = yaml.safe_dump(front, sort_keys=False, allow_unicode=True, width=10_000)
    return f"---\n{head}---\n\n{text}"


def _croissant(
    demos: Demonstrations, parts: Sequence[LicencedPart], sums: Mapping[str, str]
) -> str:
    """Return the text of ``croissant.json``, with the provenance of the data in terms of PROV-O."""
    data: dict[str, Any] = json.loads(read_text(CROISSANT_FILE))
    data["@context"] |= {"prov": "http://www.w3.org/ns/prov#"}
    info, settings = read_json(demos.folder / INFO), demos.settings
    name = demos.folder.resolve().name
    data |= {
        "name": name,
        "description": f"{len(demos.episodes)} episodes of {len(demos.robot_hashes)} robots with "
        "the robots that they show, for cross-embodiment imitation learning",
        "version": "1.0.0",
        "license": [find_licence(each).url or each for each in licence_ids(parts)],
        "citeAs": f"{name}: demonstrations recorded with morphgen {settings['morphgen']}",
        "prov:wasGeneratedBy": {
            "@type": "prov:Activity",
            "prov:label": f"morphgen record, seed {settings['seed']}, simulator {settings['sim']}, "
            f"policies {json.dumps(settings['policy'])}; all options are in {RECORDING}",
            "prov:wasAssociatedWith": {
                "@type": "prov:SoftwareAgent",
                "prov:label": f"morphgen {settings['morphgen']}",
            },
        },
        "prov:wasDerivedFrom": [
            {"@type": "prov:Entity", "prov:label": f"{each.part}, {each.licence.id}: {source}"}
            for each in parts
            if (source := " ".join(each.citation.split()))
        ],
    }
    files = {
        INFO: ("application/json", "Features and sizes, as LeRobot reads them"),
        STATS: ("application/json", "Statistics of the features"),
        INDEX: ("application/jsonlines", "A line per robot"),
        RECORDING: ("application/json", "Robots, policies, seeds and constants of the tasks"),
        LICENCES_FILE: ("application/json", "Every part with its licence, source and robots"),
    }
    sets = {
        "steps": ("application/x-parquet", "data/*/*.parquet", "Steps of all episodes"),
        "episodes": ("application/x-parquet", "meta/episodes/*/*.parquet", "Episodes"),
        "urdf": ("application/xml", f"{BODIES}/*/robot.urdf", "The URDF of every robot"),
        "mjcf": ("application/xml", f"{BODIES}/*/robot.xml", "The MJCF of every robot"),
        "videos": ("video/mp4", "videos/*/*/*.mp4", "Videos of the cameras, by feature"),
        "goals": ("application/x-npz", f"{BODIES}/*/goals/*.npz", "Certified goals"),
    }
    data["distribution"] = [
        {
            **_named("cr:FileObject", file, about),
            "contentUrl": file,
            "encodingFormat": kind,
            "sha256": sums[file],
        }
        for file, (kind, about) in files.items()
    ] + [
        {**_named("cr:FileSet", f"{key}-files", about), "encodingFormat": kind, "includes": glob}
        for key, (kind, glob, about) in sets.items()
        if any(PurePosixPath(name).match(glob) for name in sums)
    ]
    steps = {name: each for name, each in info["features"].items() if each["dtype"] != "video"}
    episodes = ("episode_index", "robot_hash", "task", "policy", "seed", "success", "length")
    data["recordSet"] = [
        _records("robots", {"fileObject": {"@id": INDEX}}, read_index(demos.folder)[0]),
        _records(
            "episodes",
            {"fileSet": {"@id": "episodes-files"}},
            {
                key: getattr(demos.episodes[0], key.replace("episode_index", "index"))
                for key in episodes
            },
        ),
        _records("steps", {"fileSet": {"@id": "steps-files"}}, steps),
    ]
    return json.dumps(data, indent=2, ensure_ascii=False) + "\n"


def _named(kind: str, name: str, about: str) -> dict[str, Any]:
    return {"@type": kind, "@id": name, "name": name, "description": about}


def _records(name: str, source: Mapping[str, Any], columns: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record set; the values of its columns are examples, or features of LeRobot."""
    fields = []
    for column, value in columns.items():
        dtype = value["dtype"] if isinstance(value, dict) else type(value).__name__
        field = {
            **_named("cr:Field", f"{name}/{column}", column),
            "dataType": _DATA_TYPES[dtype],
            "source": {**source, "extract": {"column": column}},
        }
        if isinstance(value, dict) and value["names"] is not None:
            field |= {"isArray": True, "arrayShape": str(value["shape"][0])}
        elif isinstance(value, list):
            field |= {"isArray": True, "arrayShape": "-1"}
        fields.append(field)
    return {"@type": "cr:RecordSet", "@id": name, "name": name, "field": fields}


_DATA_TYPES = {
    **dict.fromkeys(("float32", "float"), "sc:Float"),
    **dict.fromkeys(("int64", "int"), "sc:Integer"),
    "bool": "sc:Boolean",
    **dict.fromkeys(("str", "list"), "sc:Text"),
}
