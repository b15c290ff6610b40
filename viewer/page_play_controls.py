"""What is to be played: from a page's address, and by the controls that change it."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import viser

from morphgen.errors import MorphgenError, nearest
from morphgen.rl.baselines import BASELINES, baselines_for
from morphgen.tasks.registry import TASKS
from morphgen.viewer import browser, play_bodies
from morphgen.viewer.address import Address, whole_number
from morphgen.viewer.play_bodies import Bodies
from morphgen.viewer.play_screen import PlayPage, asked, playing
from morphgen.viewer.robot_uri import WORDS, name_of
from morphgen.viewer.rollout import (
    MOST,
    Rollout,
    RolloutConfig,
    checkpoints,
    simulators,
    trained_with,
)
from morphgen.viewer.session import say, set_value, when

BODY = "words:arm=ur5 ee=plane"
"""What plays if an address names nobody."""


def parse_rollout(address: Address, trained: Bodies) -> RolloutConfig:
    """What an address asks to play.

    Args:
        address: Of the page.
        trained: Bodies that its policy was trained on; the first plays if it names none.

    Raises:
        MorphgenError: If there is no such task or simulator, or the seed is no number.
    """
    state, installed = address.state, simulators()
    task = address.subject
    if task not in TASKS:
        raise MorphgenError(f"no task {address.subject!r} to play{nearest(address.subject, TASKS)}")
    simulator = next((each for each in installed if each == state.get("sim", installed[0])), None)
    if simulator is None:
        name = state["sim"]
        raise MorphgenError(f"simulator {name!r} is not here{nearest(name, installed)}")
    seed = state.get("seed", "0")
    if (number := whole_number(seed, -1)) < 0:
        raise MorphgenError(f"seed {seed!r:.80}: expected a whole number, 0 or more")
    default = trained[0][1] if trained else BODY
    return RolloutConfig(
        task,
        (address.robots or (default,))[:MOST],
        state.get("policy") or baselines_for(task)[0],
        number,
        bool(state.get("obstacles")),
        simulator,
    )


def address_of(wanted: RolloutConfig) -> Address:
    """The address of what is played; what is at its default is left out."""
    state = {
        "policy": wanted.policy,
        "seed": str(wanted.seed),
        "obstacles": "yes" if wanted.obstacles else "",
        "sim": "" if wanted.simulator == simulators()[0] else wanted.simulator,
    }
    return Address("play", (wanted.task,), robots=wanted.places).with_state(**state)


def trained_bodies(page: PlayPage) -> Bodies:
    """The bodies of the address's checkpoint; where it names no task or body, it gets them."""
    address, places = page.session.address, page.session.places
    policy = address.state.get("policy", "")
    if not policy or policy in BASELINES:
        return []
    task, obstacles, bodies = trained_with(policy, places)
    if not address.subject:
        address = replace(address, of=(task,))
        page.session.address = address.with_state(obstacles="yes" if obstacles else "")
    return bodies


def add_choices(page: PlayPage, wanted: RolloutConfig) -> None:
    """Controls of what is played."""
    gui, session, controls = page.session.client.gui, page.session, page.controls
    again = gui.add_button("New episode", icon=viser.Icon.REFRESH, hint="with the next seed")
    with gui.add_folder("Task"):
        controls["task"] = gui.add_dropdown("task", tuple(TASKS), initial_value=wanted.task)
        names = _policies(page, wanted)
        controls["policy"] = gui.add_dropdown("policy", names, initial_value=wanted.policy)
        controls["obstacles"] = gui.add_checkbox("obstacles", wanted.obstacles)
        controls["seed"] = gui.add_number("seed", wanted.seed, min=0, step=1)
        installed = tuple(simulators())
        controls["sim"] = gui.add_dropdown("simulator", installed, initial_value=wanted.simulator)
    with gui.add_folder("Bodies"):
        listed = tuple(play_bodies.sources(wanted.places[0], page.trained, session.places))
        controls["from"] = gui.add_dropdown("from", listed)
        controls["body"] = gui.add_dropdown("body", ("",))
        controls["words"] = gui.add_text(
            "or words", "", hint="such as arm=ur5 ee=plane, or a bundle's folder; then Enter"
        )
        group = gui.add_button_group("this body", ("instead", "beside", "alone"))
    when(again, session, lambda: _change(page, seed=asked(page).seed + 1))
    when(controls["task"], session, lambda: _change_task(page))
    when(controls["policy"], session, lambda: _change(page, policy=controls["policy"].value))
    when(controls["obstacles"], session, lambda: _change(page, obstacles=_value(page, "obstacles")))
    when(controls["seed"], session, lambda: _change(page, seed=_value(page, "seed")), "seed")
    when(controls["sim"], session, lambda: _change(page, simulator=_value(page, "sim")))
    when(controls["from"], session, lambda: _list_bodies(page))
    when(controls["body"], session, lambda: _put_body(page, "instead"))
    when(group, session, lambda: _put_body(page, group.value))
    _list_bodies(page)


def _policies(page: PlayPage, wanted: RolloutConfig) -> tuple[str, ...]:
    """Those of the task, checkpoints of this folder, and the one that is wanted."""
    found = (*baselines_for(wanted.task), *checkpoints(page.session.places), wanted.policy)
    return tuple(dict.fromkeys(found))


def _list_bodies(page: PlayPage) -> None:
    """Fill the dropdown of bodies from where they are to come."""
    wanted, box = asked(page), page.controls["body"]
    listed = play_bodies.sources(wanted.places[0], page.trained, page.session.places)
    found = listed.get(page.controls["from"].value, list)()
    page.bodies = play_bodies.labels(found, wanted.places[:1])
    box.options = tuple(page.bodies)
    labels = [label for label, place in page.bodies.items() if place == wanted.places[0]]
    set_value(box, labels[0])


def _put_body(page: PlayPage, how: str) -> None:
    """Have the chosen body play: instead of the first, beside all, or alone."""
    wanted, text = asked(page), page.controls["words"].value.strip()
    place = page.bodies[page.controls["body"].value]
    if text:
        place = WORDS + text if "=" in text and ":" not in text else text
        set_value(page.controls["words"], "")
    if how == "beside":
        if len(wanted.places) >= MOST:
            raise MorphgenError(f"{MOST} bodies are shown at most")
        _change(page, places=(*wanted.places, place))
    else:
        rest = wanted.places[1:] if how == "instead" else ()
        _change(page, places=(place, *rest))


def _change_task(page: PlayPage) -> None:
    """Play another task, with its own reference if the policy is the other's."""
    wanted = asked(page)
    task = page.controls["task"].value
    policy = wanted.policy
    if policy in BASELINES and policy not in baselines_for(task):
        policy = baselines_for(task)[0]
    changed = replace(wanted, task=task, policy=policy)
    page.controls["policy"].options = _policies(page, changed)
    set_value(page.controls["policy"], policy)
    _change(page, task=task, policy=policy)


def _change(page: PlayPage, **changes: Any) -> None:  # noqa: ANN401
    """Begin an episode of something else."""
    page.wanted = replace(asked(page), **changes)
    if page.controls["seed"].value != page.wanted.seed:
        set_value(page.controls["seed"], page.wanted.seed)
    begin(page)


def begin(page: PlayPage) -> None:
    """Have the page's player begin an episode of what is asked for, and tell its address."""
    session, wanted = page.session, asked(page)
    session.address = address_of(wanted)
    browser.show_query(
        session.client, session.address.query, f"{wanted.task} {name_of(wanted.places[0])}"
    )
    progress = functools.partial(say, session)
    playing(page).prepare(lambda: Rollout(wanted, session.places, progress))


def _value(page: PlayPage, name: str) -> Any:  # noqa: ANN401
    return page.controls[name].value
