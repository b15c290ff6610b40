"""No URL or text from a browser reveals files outside the served folders."""

import json
import re
from types import SimpleNamespace

import numpy as np
import pytest

from helpers.robots import arm
from helpers.viser_client import PlainClient
from morphgen.errors import MorphgenError
from morphgen.formats.bundle import write_bundle
from morphgen.rl.runs.robot_source import OneRobot
from morphgen.viewer import simulation

WORD = "tellnobody"
DEEP = "a=b[c:" * 1000 + "a=b" + "]" * 1000
NOTHING = "This address cannot be shown"


@pytest.fixture
def secret(tmp_path):
    """Files outside the viewer's folder whose parse errors would quote a secret word."""
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    (folder / "a.grammar").write_text(f"robot -> {WORD} }}{WORD}\n")
    (folder / "a.urdf").write_text(f'<robot name="{WORD}"><link name="{WORD}"')
    (folder / "a.xacro").write_text(f'<robot name="{WORD}"><link name="{WORD}"')
    (folder / "a.yaml").write_text(f"{WORD}: {{{WORD}\n")
    (folder / "checkpoint.pt").write_text(WORD)
    (folder / "a.npz").write_text(WORD)
    (folder / "card.json").write_text(f'{{"{WORD}"')
    (folder / "index.jsonl").write_text(WORD)
    return folder


@pytest.mark.parametrize(
    "query",
    [
        "?compose={}/a.grammar",
        "?compose={}/a.yaml",
        "?robot={}/a.urdf",
        "?robot={}/a.xacro",
        "?robot={}",
        "?robot=words:{}/a.grammar",
        "?robot=words:{}/a.yaml more",
        "?robot=words:{}/a.urdf",
        "?robot=split:{}/a.yaml@test/x",
        "?robot=upload:{}/a.urdf",
        "?robot=upload:..",
        "?gallery={}",
        "?split={}/a.yaml",
        "?split={}",
        "?compare={}/a.urdf&compare={}/a.grammar",
        "?play={}/a.npz",
        "?play=reach&policy={}/checkpoint.pt",
        "?play=reach&policy={}",
        "?play=&policy={}/a.yaml",
        "?play=reach&robot={}/a.urdf",
        "?play=reach&robot=words:{}/a.grammar",
        "?robot=../elsewhere/a.urdf",
        "?robot=robots/../../elsewhere/a.urdf",
        "?compose=./../elsewhere/a.grammar",
    ],
)
def test_url_reveals_nothing_outside_the_folders(shared_viewer, capfd, secret, query):
    with PlainClient(shared_viewer.port, query.replace("{}", str(secret))) as client:
        client.until(lambda: NOTHING in client.text or "tag error" in client.text)
        assert re.search("outside of the folders|no such file", client.text)
        assert WORD not in client.text
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("query", "why"),
    [
        ("?robot=%00", r"\\x00: no such file or folder"),
        ("?robot=" + "a" * 7000, "no such file or folder"),
        ("?robot=" + "a" * 10_000, "at most 8000 are read"),
        ("?robot=" + "a/" * 3000, "no such file or folder"),
        ("?robot=%ff%fe", "no such file or folder"),
        ("?robot=words:%00", "is not a part"),
        ("?robot=words:", "no robot is named"),
        ("?compose=%00.grammar", "no such file or folder"),
        ("?gallery=%00", "no such file or folder"),
        ("?split=%00", "no such file or folder"),
        ("?compare=%00&compare=%00", "no such file or folder"),
        ("?play=%00.npz", "no such file or folder"),
        ("?play=reach&policy=%00", "neither a checkpoint nor a policy"),
        ("?play=reach&policy=ikk", "did you mean 'ik'"),
        ("?robot=derivation:" + DEEP, "more than 100 parts"),
        ("?play=reach&robot=derivation:" + DEEP, "more than 100 parts"),
        ("?compare=derivation:" + DEEP, "more than 100 parts"),
        ("?robot=" + "&robot=".join("a" * 50), "no such file or folder"),
        ("?" + "&".join(f"k{i}=1" for i in range(1000)), "names no page"),
    ],
    ids=lambda each: each[:30],
)
def test_invalid_url_shows_an_error_message(shared_viewer, capfd, query, why):
    with PlainClient(shared_viewer.port, query) as client:
        client.until(lambda: NOTHING in client.text or "tag error" in client.text)
        shown = client.text.replace("&#x27;", "'")
        assert re.search(why, shown), shown[-600:]
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("query", ["?compose=arm3&seed=²", f"?compose=arm3&number={'9' * 5000}"])
def test_an_invalid_number_counts_as_zero(shared_viewer, capfd, query):
    with PlainClient(shared_viewer.port, query) as client:
        client.until(lambda: "The same on the command line" in client.text)
    assert capfd.readouterr().err == ""


def test_grammar_file_cannot_include_outside_files(shared_viewer, folder, secret):
    (folder / "mine.grammar").write_text(f'include "{secret}/a.grammar"\nrobot -> ur5\n')
    with PlainClient(shared_viewer.port, "?compose=mine.grammar") as client:
        client.shows("leads outside of")
        assert WORD not in client.text


def test_grammar_text_cannot_include_files(shared_viewer, secret):
    with PlainClient(shared_viewer.port, "?compose=arm3") as client:
        text = client.control("Text", "grammar")
        client.change(text, f'include "{secret}/a.grammar"\nrobot -> ur5\n')
        client.shows("a grammar given as text cannot include others")
        assert WORD not in client.text


def test_checkpoint_cannot_name_an_outside_robot(files, folder, secret, monkeypatch):
    (folder / "runs").mkdir(exist_ok=True)
    (folder / "runs" / "some.pt").touch()
    for name in (f"{secret}/a.urdf", f"{secret}/a.grammar", f"{secret}"):
        run = SimpleNamespace(source=OneRobot(name=name, task="reach", robot_hash=""))
        monkeypatch.setattr(simulation, "read_checkpoint", lambda path, run=run: (run, None))
        with pytest.raises(MorphgenError, match="outside of the folders") as refused:
            simulation.training_robots("runs/some.pt", files)
        assert WORD not in str(refused.value)


def test_episode_cannot_name_an_outside_robot(shared_viewer, folder, secret):
    body = {"name": "a", "place": f"{secret}/a.urdf", "body": "", "ground": None}
    body |= {"obstacles": [], "block": None, "markers": []}
    about = {"format": 2, "morphgen": "", "task": "reach", "policy": "zero", "seed": 0}
    about |= {"obstacles": False, "simulator": "mujoco", "period": 0.02, "bodies": [body]}
    arrays = {f"0/{name}": np.zeros(1) for name in ("q", "score", "distance", "success", "goal")}
    np.savez(folder / "mine.npz", about=np.array(json.dumps(about)), **arrays)
    with PlainClient(shared_viewer.port, "?play=mine.npz") as client:
        client.shows("outside of the folders")
        assert WORD not in client.text


def test_card_cannot_name_an_outside_file(shared_viewer, folder, secret):
    bundle = write_bundle(arm(), folder / "robots" / "nosy", picture=False)
    card = (bundle / "card.json").read_text()
    (bundle / "card.json").write_text(card.replace('"robot.xml":', f'"{secret}/a.urdf":'))
    with PlainClient(shared_viewer.port, "?robot=robots/nosy") as client:
        client.shows("leads out of the folder")
