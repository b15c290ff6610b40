"""Describe demonstrations: a summary by task, dataset card, licences, Croissant and hashes."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from morphgen.benchmark import licences, read_text
from morphgen.benchmark.split_folder import README_FILE, SUMS_FILE, read_sums, sums_text
from morphgen.files import write_atomic
from morphgen.formats.bundle import CARD
from morphgen.formats.data_files import read_json
from morphgen.formats.files import folder_hashes
from morphgen.rl.demonstrations.lerobot import BODIES, INFO, RECORDING, read_index
from morphgen.rl.demonstrations.reader import Demonstrations
from morphgen.rl.demonstrations.recording import Replay
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
    success: Interval  # share of the episodes that ended in success, with its 95% Wilson interval


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

    replays: tuple[Replay, ...]  # simulated episodes beside the recorded ones
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
        licences.LICENCES_FILE: licences.licences_json(parts),
        README_FILE: _card(demos, parts),
    }
    for name, text in texts.items():
        write_atomic(folder / name, text)
    write_atomic(folder / licences.CROISSANT_FILE, _croissant(demos, parts, folder_hashes(folder)))
    write_atomic(folder / SUMS_FILE, sums_text(_sums(folder)))


def _licenced_parts(folder: Path) -> tuple[licences.LicencedPart, ...]:
    """Return the parts of all robots with their licences, sorted by licence and name."""
    robots: dict[tuple[str, str, str], dict[tuple[str, str], None]] = {}
    for body in read_index(folder):
        card = read_json(folder / BODIES / body["robot_hash"] / CARD)
        for part in card.get("parts") or [{"part": body["name"], "licence": "unknown"}]:
            key = part["part"], part.get("licence", "unknown"), part.get("citation", "")
            robots.setdefault(key, {})["train", body["name"]] = None
    found = [
        licences.LicencedPart(name, licences.find_licence(licence), citation, (*who,))
        for (name, licence, citation), who in robots.items()
    ]
    return tuple(sorted(found, key=lambda each: (each.licence.id, each.part)))


def _card(demos: Demonstrations, parts: Sequence[licences.LicencedPart]) -> str:
    """Return the dataset card, with the front matter that Hugging Face and LeRobot read."""
    settings, name = demos.settings, demos.folder.resolve().name
    tasks = [each.task for each in summarize(demos)]
    data_files = [{"split": "train", "path": "data/*/*.parquet"}]
    front = {
        "task_categories": ["robotics"],
        "tags": ["LeRobot", "morphgen", "cross-embodiment", "croissant", *tasks],
        "configs": [{"config_name": "default", "data_files": data_files}],
    }
    noise = f"`executed_action` is what the robot did, with noise of {settings['noise']:g}."
    return licences.dataset_card(
        name,
        parts,
        front,
        read_text("demonstrations_card.md"),
        name=name,
        folder=name,
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
    )


def _croissant(
    demos: Demonstrations, parts: Sequence[licences.LicencedPart], sums: Mapping[str, str]
) -> str:
    data = licences.croissant_head() | licences.croissant_contents(
        "demonstrations_croissant.json", sums
    )
    data["@context"] |= {"prov": "http://www.w3.org/ns/prov#"}
    info, settings = read_json(demos.folder / INFO), demos.settings
    name = demos.folder.resolve().name
    data |= {
        "name": name,
        "description": f"{len(demos.episodes)} episodes of {len(demos.robot_hashes)} robots with "
        "the robots that they show, for cross-embodiment imitation learning",
        "version": "1.0.0",
        "license": licences.licence_addresses(parts),
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
    data["recordSet"].append(
        {
            "@type": "cr:RecordSet",
            "@id": "steps",
            "name": "steps",
            "field": [
                _field(column, feature)
                for column, feature in info["features"].items()
                if feature["dtype"] != "video"
            ],
        }
    )
    return json.dumps(data, indent=2, ensure_ascii=False) + "\n"


def _field(column: str, feature: Mapping[str, Any]) -> dict[str, Any]:
    field: dict[str, Any] = {
        "@type": "cr:Field",
        "@id": f"steps/{column}",
        "name": f"steps/{column}",
        "description": column,
        "dataType": _DATA_TYPES[feature["dtype"]],
        "source": {"fileSet": {"@id": "steps-files"}, "extract": {"column": column}},
    }
    if feature["names"] is not None:
        field |= {"isArray": True, "arrayShape": str(feature["shape"][0])}
    return field


_DATA_TYPES = {"float32": "sc:Float", "int64": "sc:Integer", "bool": "sc:Boolean"}
