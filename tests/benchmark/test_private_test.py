"""Private test sides: the secret, the drawn robots, the commitment and its verification."""

import hashlib
import json
import stat
from dataclasses import replace

import pytest

from helpers.grammars import shipped
from helpers.splits import combined
from morphgen.benchmark.audit import audit
from morphgen.benchmark.generate import SplitRequest, extrapolation, interpolation, parse_bound
from morphgen.benchmark.private_test import (
    PRIVATE_KEY,
    draw_private_test,
    make_secret,
    read_secret,
    reveal,
)
from morphgen.benchmark.release_file import Release
from morphgen.benchmark.split import compose_side, split_id
from morphgen.benchmark.split_file import read_split
from morphgen.errors import BenchmarkError
from morphgen.grammar.library import default_library

LIBRARY = default_library()
SECRET, OTHER = "5a" * 32, "5b" * 32
BY_HULL = {"hull": "inside"}


@pytest.fixture(scope="module")
def sticks():
    """A split of one grammar: sticks of other sizes."""
    request = SplitRequest("mine/sticks", (6,), 1)
    (split,) = interpolation(request, shipped("stick"), LIBRARY, **BY_HULL)
    return split


def released(split, public, version="1.0.0"):
    return Release(split.name, split_id(split), version, "0.0.0", {}, private_test=public)


def test_the_secret_gives_the_same_robots_again_and_no_other_does(sticks):
    private, public = draw_private_test(sticks, "1.0.0", 3, SECRET, LIBRARY)
    again, _ = draw_private_test(sticks, "1.0.0", 3, SECRET, LIBRARY)
    assert private == again
    hashes = {member.robot_hash for member in private.test}
    for secret, version in ((OTHER, "1.0.0"), (SECRET, "1.0.1")):
        other, described = draw_private_test(sticks, version, 3, secret, LIBRARY)
        assert hashes.isdisjoint(member.robot_hash for member in other.test)
        assert described.commitment != public.commitment
    assert (private.train, private.name) == (sticks.train, "mine/sticks-private")
    assert reveal(sticks, released(sticks, public), SECRET, LIBRARY) == private


def test_private_robots_follow_the_rules_of_the_split(sticks):
    private, _ = draw_private_test(sticks, "1.0.0", 5, SECRET, LIBRARY)
    hashes = [member.robot_hash for member in private.test]
    public = {member.robot_hash for member in (*sticks.train, *sticks.test)}
    assert len(set(hashes)) == 5
    assert public.isdisjoint(hashes)
    assert {(member.task, member.obstacles) for member in private.test} == {("reach", False)}
    assert audit(private, LIBRARY).passed(strict=True)


def test_the_commitment_is_the_documented_hash(sticks):
    private, public = draw_private_test(sticks, "1.0.0", 2, SECRET, LIBRARY)
    description = {
        "split": split_id(sticks),
        "version": "1.0.0",
        "robots": 2,
        "grammars": public.grammars,
    }
    data = {
        "secret": SECRET,
        "description": description,
        "hashes": [member.robot_hash for member in private.test],
    }
    text = json.dumps(data, sort_keys=True, separators=(",", ":"))
    assert public.commitment == hashlib.sha256(text.encode()).hexdigest()
    assert private.provenance[PRIVATE_KEY] == {**description, "commitment": public.commitment}


def test_a_wrong_secret_or_commitment_is_refused(sticks):
    _, public = draw_private_test(sticks, "1.0.0", 2, SECRET, LIBRARY)
    release = released(sticks, public)
    with pytest.raises(BenchmarkError, match="does not give the robots that the release committed"):
        reveal(sticks, release, OTHER, LIBRARY)
    forged = replace_public(release, commitment="0" * 64)
    with pytest.raises(BenchmarkError, match="does not give the robots"):
        reveal(sticks, forged, SECRET, LIBRARY)
    more = replace_public(release, robots=3)
    with pytest.raises(BenchmarkError, match="does not give the robots"):
        reveal(sticks, more, SECRET, LIBRARY)
    changed = replace_public(release, grammars={"stick": "0" * 64})
    with pytest.raises(BenchmarkError, match="grammar stick is not the one of the release"):
        reveal(sticks, changed, SECRET, LIBRARY)
    with pytest.raises(BenchmarkError, match="has no private test side"):
        reveal(sticks, released(sticks, None), SECRET, LIBRARY)


def replace_public(release, **changes):
    import msgspec

    public = msgspec.structs.replace(release.private_test, **changes)
    return msgspec.structs.replace(release, private_test=public)


def test_extrapolation_keeps_structure_and_similarity():
    request = SplitRequest("mine/chains", (6,), 1)
    grammars = [shipped(name) for name in ("stick", "prims")]
    bound = parse_bound("<0.7")
    (split,) = extrapolation(request, grammars, [shipped("chain")], LIBRARY, similarity=bound)
    private, _ = draw_private_test(split, "1.0.0", 4, OTHER, LIBRARY)
    assert max(len(robot.links) for robot in compose_side(private, "test", LIBRARY)) <= 23
    assert private.test[-1].name == "chain-private-000005"  # chains of more links are left out
    assert {member.category for member in private.test} == {"chain"}
    assert audit(private, LIBRARY).passed()


@pytest.mark.parametrize(
    ("split", "why"),
    [
        (combined(), r"not drawn from grammars \(composition\)"),
        (read_split("interpolation/panda/reach"), r"not drawn from grammars \(interpolation\)"),
        (read_split("extrapolation/arms/reach"), r"not drawn from grammars \(extrapolation\)"),
        (read_split("extrapolation/primitives/reach"), "with different pinned choices"),
        (
            replace(
                read_split("interpolation/arm3/reach"), provenance={"grammar": {"/etc/a": "x"}}
            ),
            "expected the name of a grammar in the library",
        ),
        (
            replace(read_split("interpolation/arm3/reach"), provenance={"grammar": {"arm3": "x"}}),
            "grammar arm3 has changed since the split was made",
        ),
    ],
)
def test_other_splits_are_refused(split, why):
    with pytest.raises(BenchmarkError, match=why):
        draw_private_test(split, "1.0.0", 1, SECRET, LIBRARY)


@pytest.mark.parametrize("robots", [0, 1001])
def test_the_number_of_robots_is_bounded(sticks, robots):
    with pytest.raises(BenchmarkError, match="expected 1 to 1000 robots"):
        draw_private_test(sticks, "1.0.0", robots, SECRET, LIBRARY)


def test_a_new_secret_is_random_and_its_owners_alone(tmp_path):
    paths = [tmp_path / "a", tmp_path / "b"]
    secrets = [make_secret(path) for path in paths]
    assert len(set(secrets)) == 2
    assert all(len(secret) == 64 for secret in secrets)
    assert [read_secret(path) for path in paths] == secrets
    assert [make_secret(path) for path in paths] == secrets
    assert stat.S_IMODE(paths[0].stat().st_mode) == 0o600
    with pytest.raises(BenchmarkError, match="is not a regular file"):
        make_secret(tmp_path)
    paths[0].chmod(0o644)
    with pytest.raises(BenchmarkError, match="others can read this secret"):
        make_secret(paths[0])
    assert read_secret(paths[0]) == secrets[0]  # once published, anybody may have it


@pytest.mark.parametrize("text", ["", "hunter2", "5a" * 31, "5A" * 32, "5a" * 1000])
def test_other_files_are_no_secret_and_are_not_quoted(tmp_path, text):
    path = tmp_path / "secret"
    path.write_text(text)
    path.chmod(0o600)
    for read in (read_secret, make_secret):
        with pytest.raises(BenchmarkError) as caught:
            read(path)
        assert not text or text not in str(caught.value)
    with pytest.raises(BenchmarkError, match="cannot be read"):
        read_secret(tmp_path / "missing")
    with pytest.raises(BenchmarkError, match="cannot write"):
        make_secret(tmp_path / "missing" / "secret")
