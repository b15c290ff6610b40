"""Playback in one browser: what its player shows there."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from html import escape
from typing import Any

import viser

from morphgen.tasks.registry import TASKS
from morphgen.viewer import markup
from morphgen.viewer.episode import Episode, score_until
from morphgen.viewer.play_bodies import Bodies
from morphgen.viewer.player import Player
from morphgen.viewer.rollout import RolloutConfig, Source
from morphgen.viewer.scene_episode import PlayScene, add_episode, show_step
from morphgen.viewer.scene_robot import look_at
from morphgen.viewer.session import Session, say, set_value

PLANNERS = ("ik", "scripted")
"""Policies whose first step takes seconds."""


@dataclass(eq=False)
class PlayPage:
    """Playback in one browser; the screen of its player."""

    session: Session
    wanted: RolloutConfig | None = None
    """What is simulated; None for a recorded episode."""
    trained: Bodies = field(default_factory=list)
    player: Player | None = None
    source: Source | None = None
    scene: PlayScene | None = None
    bodies: dict[str, str] = field(default_factory=dict)
    """FileAccess by their labels in the dropdown."""
    controls: dict[str, Any] = field(default_factory=dict)
    texts: dict[str, viser.GuiHtmlHandle] = field(default_factory=dict)
    framed: tuple[str, ...] = ()
    """FileAccess of the bodies that the camera was turned to."""
    planned: bool = True
    """Whether the policy has got beyond its first step."""

    def prepared(self, source: Source) -> None:
        """Show another episode at its start."""
        client, self.source = self.session.client, source
        with client.atomic():
            if self.scene is not None:
                self.scene.root.remove()
            self.scene = add_episode(client.scene, source.episode)
        places = tuple(track.place for track in source.episode.tracks)
        if places != self.framed:
            self.framed = places
            look_at(client, self.scene.low, self.scene.high)
        slider = self.controls["time"]
        slider.max = max(source.longest, 1) * source.episode.period
        self.texts["fault"].content = self._faults(source.faults.values())
        self.planned = self.wanted is None or source.episode.policy not in PLANNERS
        say(self.session, "" if self.planned else "the policy plans its way")

    def _faults(self, texts: Iterable[str]) -> str:
        return "".join(fault_text(self.session.places.told(text)) for text in texts)

    def shown(self, step: int) -> None:
        """Show a moment."""
        if self.scene is None or self.source is None:
            return
        episode = self.source.episode
        with self.session.client.atomic():
            show_step(self.scene, step)
        if step > 0 and not self.planned:
            self.planned = True
            say(self.session, "")
        set_value(self.controls["time"], step * episode.period)
        self.texts["score"].content = markup.framed(score_table(episode, step))

    def stopped(self) -> None:
        """Say what has gone wrong on the way."""
        tracks = self.source.episode.tracks if self.source else []
        if found := [track.fault for track in tracks if track.fault]:
            self.texts["fault"].content = self._faults(found)

    def failed(self, why: str) -> None:
        """Say why there is nothing to see."""
        say(self.session, "")
        self.texts["fault"].content = self._faults([why])
        self.texts["score"].content = ""
        if self.scene is not None:
            self.scene.root.remove()
            self.scene = None
        self.source = None


def score_table(episode: Episode, step: int) -> str:
    """How the bodies have done until a moment."""
    rows = []
    target = TASKS[episode.task].target
    for track in episode.tracks:
        at = min(step, track.steps)
        score = score_until(track, episode.task, at)
        if score is None:
            rows.append((escape(track.robot.name), "", "", ""))
            continue
        kind = ("success", "train") if track.success[at - 1] else ("not yet", "")
        distance = f"{track.distance[at - 1]:.3f}"
        rows.append((escape(track.robot.name), f"{score:.2f}", distance, markup.tag(*kind)))
    seconds = step * episode.period
    head = f'<div class="dim">{seconds:.2f} s; simulated: {episode.steps * episode.period:.2f} s'
    table = markup.table(("", "score so far", f"m from {target}", "now"), rows, (1, 2))
    return f"{head}</div>{table}"


def playing(page: PlayPage) -> Player:
    """What plays."""
    assert page.player is not None
    return page.player


def asked(page: PlayPage) -> RolloutConfig:
    """What is simulated."""
    assert page.wanted is not None
    return page.wanted


def fault_text(text: str) -> str:
    """Why something cannot be played."""
    return markup.framed(markup.tag("error", "error"), f" {escape(text)}")
