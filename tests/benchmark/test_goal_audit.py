"""The audit reports leaking goals and goal sets that do not belong to the split's robots."""

import re
from dataclasses import replace

import numpy as np
import pytest

from helpers.caching import once
from helpers.splits import LIBRARY, TEST, TRAIN, member, split
from morphgen.benchmark import audit as audit_module
from morphgen.benchmark.audit import NEAR, audit, audit_goals, with_goal_findings
from morphgen.encoding.robot_hash import robot_hash
from morphgen.model.geometry import Pose
from morphgen.tasks.goals.split_goals import SplitGoals, sample_split_goals
from morphgen.tasks.push.config import PushConfig
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.scenes.env_specs import GoalConfig

RECIPE = GoalConfig(0, (ReachConfig(num_goals=12), PushConfig(num_goals=4)))
REACH = "train", "gantry-plane"
PUSH = "train", "gantry-cylinder"
LAST = "test", "planar-plane"


@pytest.fixture(scope="module", autouse=True)
def _sets_are_sampled_anew_once():
    """Each audit compares the sets of a few robots with those that it samples anew."""

    def key(robot, task, config, **options):
        return robot.name, robot_hash(robot), task, config, *options.items()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(audit_module, "env_spec", once(audit_module.env_spec, key))
        yield


def some(**more):
    """A split with reach and push members, with and without obstacles."""
    train = [member(TRAIN[0], task="reach"), member(TRAIN[2])]
    return split(train, [member(TEST[0], task="reach", obstacles=True)], **more)


def draw_sets(which, cache, config=RECIPE):
    return SplitGoals.from_results(sample_split_goals(which, LIBRARY, config, cache=cache), config)


@pytest.fixture
def sets(cache):
    return draw_sets(some(), cache)


def changed(sets, at, fields=None, **changes):
    """Return the goal sets with one of them changed."""
    one = replace(sets.sets[at], **changes)
    one = replace(one, goals=replace(one.goals, **(fields or {})))
    return replace(sets, sets={**sets.sets, at: one})


def audit_codes(which, sets):
    return [(finding.code, finding.where) for finding in audit_goals(which, sets, LIBRARY)]


def audit_reasons(which, sets):
    return [finding.why for finding in audit_goals(which, sets, LIBRARY)]


def moved(array, row, column, by):
    array = array.copy()
    array[row, column] += by
    return array


def test_valid_sets_have_no_findings(sets):
    assert audit_codes(some(), sets) == []


def test_a_task_that_no_package_has_is_an_error():
    odd = split([member(TRAIN[0], task="rech")], [member(TEST[0], task="reach")])
    sound = replace(audit(some(), LIBRARY), findings=())
    for findings in (None, ()):
        (found,) = with_goal_findings(sound, odd, findings).findings
        assert (found.code, found.severity) == ("task-unknown", "error")
        assert found.where == "train robot gantry-plane"
        assert "its task 'rech' is unknown; did you mean 'reach'?" in found.why
    accepted = replace(odd, accepted={"task-unknown": "the package is not published"})
    assert with_goal_findings(sound, accepted, None).passed()


def test_cache_that_ignores_the_seed_is_reported(sets, cache):
    """A valid set of another seed stored under this seed's key is reported."""
    other = draw_sets(some(), cache, replace(RECIPE, seed=1))
    for at in (REACH, PUSH):
        wrong = replace(other.sets[at].goals, key=sets.sets[at].goals.key, seed=0)
        findings = audit_goals(some(), changed(sets, at, goals=wrong), LIBRARY)
        assert [finding.code for finding in findings] == ["goals-changed"]
        assert findings[0].why == "its goals are not those that seed 0 gives"


FEWER = (ReachConfig(num_goals=10), PushConfig(num_goals=3))
LARGER = (ReachConfig(num_goals=12, obstacles=2), PushConfig(num_goals=4, block_size=(0.1, 0.12)))


@pytest.mark.parametrize(
    ("made_with", "members", "why"),
    [
        (replace(RECIPE, seed=1), {REACH, PUSH, LAST}, "its set was made with seed 1, the split's"),
        (replace(RECIPE, tasks=FEWER), {REACH, PUSH, LAST}, "its set, of .* goals, was made with"),
        (replace(RECIPE, tasks=LARGER), {PUSH, LAST}, "its set, of .* goals, was made with other"),
    ],
)
def test_sets_of_another_seed_or_other_constants_are_reported(cache, made_with, members, why):
    other = draw_sets(some(), cache, made_with)
    assert audit_codes(some(), other) == []
    findings = audit_goals(some(), replace(other, config=RECIPE), LIBRARY)
    assert {finding.where for finding in findings} == {f"{s} robot {name}" for s, name in members}
    assert all(re.match(why, finding.why) for finding in findings)
    code = "goals-seed" if made_with.seed else "goals-config"
    assert {finding.code for finding in findings} == {code}


def test_set_without_the_obstacles_of_its_member_is_reported(cache):
    bare = replace(some().test[0], obstacles=False)
    other = draw_sets(replace(some(), test=(bare,)), cache)
    assert audit_reasons(some(), other) == ["its set is for reach, not reach with obstacles"]


def test_set_of_another_robot_is_reported(sets):
    body = "0" * 32
    wrong = changed(sets, REACH, {"key": "1" * 64}, robot_hash=body)
    (finding,) = audit_goals(some(), wrong, LIBRARY)
    assert (finding.code, finding.where) == ("goals-body", "train robot gantry-plane")
    assert finding.why.startswith(f"its set is of body {body}, not of ")


def test_swapped_sets_are_reported(cache):
    which = split([member(TRAIN[0], task="reach"), member(TRAIN[1], task="reach")], [TEST[0]])
    sets = draw_sets(which, cache)
    a, b = (("train", name) for name in ("gantry-plane", "planar-cube"))
    goals = {a: sets.sets[b].goals, b: sets.sets[a].goals}
    swapped = {at: replace(one, goals=goals.get(at, one.goals)) for at, one in sets.sets.items()}
    findings = audit_goals(which, replace(sets, sets=swapped), LIBRARY)
    bodies = [finding for finding in findings if finding.code == "goals-body"]
    assert [finding.why for finding in bodies] == [
        "its set is that of train robot planar-cube",
        "its set is that of train robot gantry-plane",
    ]
    codes = {"goals-body", "goals-unproven", "goals-missing"}
    assert {finding.code for finding in findings} == codes


def blocked(goals, points):
    """Return the layouts of a set with a box of the second where a goal is that it leaves free."""
    layouts = goals.layouts.copy()
    layouts[1, 0, :3] = points[int(np.flatnonzero(goals.usable[1])[0]), :3]
    return {"layouts": layouts}


def lifted(goals):
    box, *others = goals.obstacles
    pose = replace(box.pose, position=(0.0, 0.0, 3.0))
    return {"obstacles": (replace(box, pose=pose), *others)}


@pytest.mark.parametrize(
    ("at", "change", "why"),
    [
        (
            REACH,
            lambda goals: {"poses": moved(goals.poses, [3, 5], 0, 0.01)},
            r"goal 3: the tool of its configuration is 0.01 m away.*\(and 1 more\)$",
        ),
        (LAST, lambda goals: blocked(goals, goals.poses), "layout 1: (goal .*blocked|the robot)"),
        (LAST, lifted, "the obstacles are not at the poses of the first layout"),
        *(
            (
                PUSH,
                lambda goals, f=field, c=column, d=by: {f: moved(getattr(goals, f), 2, c, d)},
                why,
            )
            for field, column, by, why in (
                ("q", 0, 9.0, "start 2: start: joint "),
                ("behind", 2, 9.0, "start 2: proof behind: joint "),
                ("blocks", 2, 0.05, "start 2: the block is 0.05 m above the ground"),
                ("blocks", 1, 1.0, "start 2: the block is across the line already"),
                ("blocks", 0, 0.05, "start 2: the tool of its proof is not behind the block"),
                ("across", 0, 0.05, "start 2: the tool of its proof is not on the line"),
                ("q", 0, np.nan, "not all numbers are finite"),
            )
        ),
    ],
)
def test_goals_without_a_proof_are_reported(sets, at, change, why):
    wrong = changed(sets, at, change(sets.sets[at].goals))
    findings = audit_goals(some(), wrong, LIBRARY)
    (unproven,) = [finding for finding in findings if finding.code == "goals-unproven"]
    assert unproven.where == f"{at[0]} robot {at[1]}"
    assert unproven.fix
    assert re.match(why, unproven.why)


def test_missing_and_surplus_sets_are_reported(sets):
    other = {**sets.sets, ("test", "stranger"): sets.sets[LAST]}
    del other[REACH]
    assert audit_codes(some(), replace(sets, sets=other)) == [
        ("goals-missing", "train robot gantry-plane"),
        ("goals-unknown", "test robot stranger"),
    ]


def test_finding_explains_why_a_robot_has_no_goals(sets):
    broken = replace(some().train[0], derivation="base=planar[top: ee=cubw]")
    which = replace(some(), train=(broken, some().train[1]))
    findings = audit_goals(which, sets, LIBRARY)
    assert [finding.code for finding in findings] == ["goals-missing"]
    assert "unknown part 'cubw'" in findings[0].why


def twins(task, obstacles=False):
    """A split with one robot on both sides under two names, and another robot."""
    train = [member(TRAIN[2], task=task), member(TRAIN[0], task=task)]
    return split(train, [member(TRAIN[0], "twin", task=task, obstacles=obstacles)])


@pytest.mark.parametrize("task", ["reach", "push"])
def test_same_robot_on_both_sides_shares_its_goals(cache, task):
    count = 12 if task == "reach" else 4
    (leak,) = audit_goals(twins(task), draw_sets(twins(task), cache), LIBRARY)
    assert (leak.code, leak.severity, leak.where) == ("goals-shared", "error", "test robot twin")
    assert leak.why == f"train robot gantry-plane has {count} of its {count} goals"
    more = member(TRAIN[0], "again", task=task)
    which = replace(twins(task), train=(*twins(task).train, more))
    (why,) = audit_reasons(which, draw_sets(which, cache))
    assert why == f"train robot gantry-plane (and 1 more) has {count} of its {count} goals"


def test_same_robot_with_another_task_shares_no_goals(cache):
    train = [member(TRAIN[0], task="reach")]
    which = split(train, [member(TRAIN[0], "twin")])
    assert audit_codes(which, draw_sets(which, cache)) == []
    assert audit_codes(twins("reach", True), draw_sets(twins("reach", True), cache)) == []


def test_single_nearby_goal_of_the_same_robot_is_a_leak(cache):
    which = twins("reach", obstacles=True)
    sets = draw_sets(which, cache)
    goal = sets.sets[REACH].goals.poses[7]
    poses = sets.sets["test", "twin"].goals.poses.copy()

    def shifted_codes(by, turned=0.0):
        poses[2] = goal
        poses[2, 0] += by
        spin = Pose.from_xyz_rpy(rpy=(turned, 0.0, 0.0))
        poses[2, 3:] = (Pose(quaternion=tuple(goal[3:])) @ spin).quaternion
        wrong = changed(sets, ("test", "twin"), {"poses": poses})
        return [why for why in audit_reasons(which, wrong) if why.startswith("train robot")]

    expected = ["train robot gantry-plane has 1 of its 12 goals"]
    assert shifted_codes(0.9 * NEAR, np.radians(0.9)) == expected
    assert shifted_codes(1.1 * NEAR) == shifted_codes(0.0, np.radians(1.1)) == []


def test_most_goals_shared_with_another_robot_are_a_leak_but_one_is_not(cache):
    which = split([member(TRAIN[0], task="reach")], [member(TRAIN[2], "other", task="reach")])
    sets = draw_sets(which, cache)
    other_goals = sets.sets[REACH].goals

    def shared(n, field):
        array = getattr(sets.sets["test", "other"].goals, field).copy()
        array[:n] = getattr(other_goals, field)[:n]
        wrong = changed(sets, ("test", "other"), {field: array})
        return [why for why in audit_reasons(which, wrong) if why.startswith("train robot")]

    assert shared(6, "poses") == shared(6, "q") == []
    assert shared(7, "poses") == ["train robot gantry-plane has 7 of its 12 goals"]
    assert shared(7, "q") == ["train robot gantry-plane has 7 of its 12 configurations"]


@pytest.mark.parametrize(("at", "fields"), [(REACH, ["poses", "q"]), (PUSH, ["blocks", "q"])])
def test_duplicate_goals_in_a_set_are_a_warning(sets, at, fields):
    goals = sets.sets[at].goals
    arrays = {name: getattr(goals, name).copy() for name in fields}
    for array in arrays.values():
        array[[1, 2]] = array[0]
    findings = audit_goals(some(), changed(sets, at, arrays), LIBRARY)
    (twice,) = [finding for finding in findings if finding.code == "goals-repeated"]
    assert (twice.severity, twice.where) == ("warning", f"train robot {at[1]}")
    assert twice.why == "goals 0 and 1 of its set are the same (and 2 more pairs)"
    if at == PUSH:  # starts with one block differ by their configurations
        del arrays["q"]
        codes = audit_codes(some(), changed(sets, at, arrays))
        assert {code for code, _ in codes} == {"goals-changed", "goals-unproven"}


def test_accepted_findings_do_not_fail(cache):
    reasons = {"body-shared": "new goals of a known body", "goals-shared": "on purpose"}
    which = replace(twins("reach"), accepted=reasons, regime="interpolation")
    done = audit(which, LIBRARY)
    findings = audit_goals(which, draw_sets(which, cache), LIBRARY)
    joined = with_goal_findings(done, which, findings)
    assert {finding.code: why for finding, why in joined.accepted} == reasons
    assert "goals-shared" not in {finding.code for finding in joined.findings}
    strict = replace(which, accepted={"body-shared": "a reason"})
    assert not with_goal_findings(audit(strict, LIBRARY), strict, findings).passed()


def test_unused_accepted_goal_findings_are_reported_only_after_a_goal_audit(sets):
    which = replace(some(), accepted={"goals-shared": "on purpose"}, regime="interpolation")
    done = audit(which, LIBRARY)
    for goal_findings, reported in ((None, False), ((), True)):
        findings = with_goal_findings(done, which, goal_findings).findings
        assert ("accepted goals-shared" in {each.where for each in findings}) == reported
