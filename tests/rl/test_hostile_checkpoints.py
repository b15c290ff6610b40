"""A damaged, incomplete or hostile checkpoint is rejected in one line, and runs no code."""

import copy
import math
import pickle
import random
import struct
import zipfile

import pytest
import torch

from helpers.runs import QUIET, equal, small_config, weights
from morphgen.cli import main
from morphgen.errors import TaskError
from morphgen.rl.runs import checkpoint as checkpoint_file
from morphgen.rl.runs.checkpoint import CHECKPOINT, packed, read_checkpoint, write_checkpoint
from morphgen.rl.runs.training import train

ENTER = "network.enter.weight"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "run"
    train(folder, small_config(), execution=QUIET)
    return folder


@pytest.fixture(scope="module")
def content(run):
    """The content of a checkpoint without its hash."""
    found = torch.load(run / CHECKPOINT, weights_only=True)
    del found["sha256"]
    return found


def save(content, path):
    """Write a checkpoint with its hash, or with none if it has values that cannot be hashed."""
    try:
        path.write_bytes(packed(content, "c.pt"))
    except TaskError:
        torch.save({**content, "sha256": ""}, path)


GONE = object()
"""Stands for a missing key."""


def changed(content, path, value):
    """Return the content with a value, or the result of a function, at a path of keys."""
    whole = found = copy.deepcopy(content)
    *keys, last = (int(key) if key.isdecimal() else key for key in path.split("/"))
    for key in keys:
        found = found[key]
    if value is GONE:
        del found[last]
    else:
        found[last] = value(found[last]) if callable(value) else value
    return whole


def nested(levels, wide):
    return [nested(levels - 1, wide)] * wide if levels else [1]


def with_first(number):
    return lambda tensor: tensor.index_fill(0, torch.tensor([0]), number)


ACTOR, WIDTH = f"learner/actor/{ENTER}", "learner/policy/network/mlp_width"
MOMENT = "learner/optimiser/state/0/exp_avg"
OTHERS_HAVE_NONE = "which no checkpoint does"
CASES = [
    (ACTOR, with_first(torch.nan), f"learner.actor.{ENTER}: 104 of 832 numbers are not finite"),
    (MOMENT, with_first(torch.inf), "exp_avg: 4 of 16 numbers are not finite"),
    ("run/reach", [1], "run: reach: invalid value [1]; expected keys and values"),
    ("format", torch.tensor(3), "has format tensor(3); expected"),
    ("learner/actor_lr_scale", math.nan, "learner.actor_lr_scale is nan: not finite"),
    (ACTOR, torch.ones(3), f"actor: {ENTER} has shape (3,) of torch.float32; expected (8, 104)"),
    (ACTOR, torch.Tensor.double, "of torch.float64; expected (8, 104) of torch.float32"),
    (ACTOR, torch.zeros(1).expand(10**12), "4,000,000,000,000 bytes, more than the file holds"),
    (ACTOR, "much", f"actor: {ENTER} is 'much'; expected a tensor"),
    (ACTOR, GONE, f"actor has no {ENTER}"),
    ("learner/critic/more", torch.ones(1), "critic has 'more', which its sizes do not ask for"),
    ("learner/target_critic/more", torch.ones(1), "target_critic has 'more', which its sizes do"),
    ("learner/actor", 3, "learner: actor: invalid value 3; expected keys and values"),
    ("learner/policy", GONE, "learner: missing key 'policy'"),
    (WIDTH, 10**12, "mlp_width 1000000000000: expected 1 to 8192"),
    ("learner/policy/network/mlp_layers", 10**9, "mlp_layers 1000000000: expected 1 to 100"),
    (WIDTH, "abc", "policy: network: mlp_width: invalid value 'abc'; expected an integer"),
    ("learner/policy/agent", "hal", "policy: unknown agent 'hal'; "),
    ("learner/policy/colour", 1, "policy: unknown key 'colour'"),
    ("learner/config/gamma", "big", "config: gamma: invalid value 'big'; expected a number"),
    ("learner/layout/links", 10**12, "layout.links: invalid value 1000000000000; "),
    ("learner/layout/links", -4, "layout.links: invalid value -4; expected"),
    ("learner/layout/channels", 5, "layout.channels: invalid value 5; expected a list"),
    (MOMENT, torch.ones(2), "parameter 0: exp_avg has shape (2,) of torch.float32; expected ("),
    ("learner/optimiser/state/1000000", {}, "state of an unknown parameter 1000000"),
    ("learner/optimiser/state/0", 7, "optimiser.state[0]: invalid value 7; expected keys and"),
    ("learner/batch", nested(12, 10), "more than 1,000,000 values"),
    ("learner/batch", nested(18, 1), "more than 20 levels of containers"),
    ("learner/batch", nested(100, 1), "more than 20 levels of containers"),
    ("learner/batch", {1.5: 0}, "a key of an unexpected type: float"),
    ("learner/update", 2**300, "learner.update is a number of 301 bits"),
    ("learner/batch", bytearray(5), f"it names '__builtin__ bytearray', {OTHERS_HAVE_NONE}"),
    ("learner/batch", torch.eye(3).to_sparse(), f"_rebuild_sparse_tensor', {OTHERS_HAVE_NONE}"),
    (
        "learner/batch",
        torch.empty(10**12, device="meta"),
        f"_rebuild_meta_tensor_no_storage', {OTHERS_HAVE_NONE}",
    ),
    ("run/num_envs", "many", "run: num_envs: invalid value 'many'; expected an integer"),
    ("run/policy", [1], "run: policy: invalid value [1]; expected keys and values"),
    ("run/sim", "gazebo", "unknown simulator 'gazebo'; valid: kinematic, mujoco, pybullet"),
    ("run/ppo/colour", 1, "ppo: unknown key 'colour'"),
    ("run/source", GONE, "run: missing key 'source'"),
    ("run/geometry", "convex", "geometry 'convex': robots collide as primitives now"),
    ("run", GONE, "is not a checkpoint of morphgen train"),
]


@pytest.mark.parametrize(("path", "value", "message"), CASES, ids=[case[2] for case in CASES])
def test_an_invalid_checkpoint_is_rejected_in_one_line(tmp_path, content, path, value, message):
    file = tmp_path / "c.pt"
    save(changed(content, path, value), file)
    with pytest.raises(TaskError) as error:
        read_checkpoint(file)
    text = str(error.value)
    assert message in text
    assert "\n" not in text
    assert len(text) < 400
    assert text.startswith(str(file))


@pytest.mark.slow
def test_flipped_bits_are_detected_or_harmless(run, tmp_path):
    whole = (run / CHECKPOINT).read_bytes()
    drawn, noticed = random.Random(0), 0
    for _ in range(200):
        flipped = bytearray(whole)
        flipped[drawn.randrange(len(whole))] ^= 1 << drawn.randrange(8)
        (tmp_path / CHECKPOINT).write_bytes(flipped)
        try:
            assert equal(weights(tmp_path), weights(run))
        except TaskError:
            noticed += 1
    assert noticed > 100


def test_a_changed_weight_and_a_missing_hash_are_detected(run, tmp_path, content):
    file = tmp_path / CHECKPOINT
    stored = torch.load(run / CHECKPOINT, weights_only=True)["sha256"]
    torch.save({**content, "sha256": stored}, file)
    assert equal(weights(tmp_path), weights(run))
    torch.save({**changed(content, ACTOR, lambda w: w + 1e-6), "sha256": stored}, file)
    with pytest.raises(TaskError, match=f"{CHECKPOINT} is damaged: its content does not have the"):
        read_checkpoint(tmp_path)
    torch.save(content, file)
    with pytest.raises(TaskError, match="is not a checkpoint of morphgen train"):
        read_checkpoint(tmp_path)


def copied(source, target, change):
    """Copy the records of a checkpoint into an archive, each changed by its name and content."""
    with zipfile.ZipFile(source) as whole:
        for name in whole.namelist():
            target.writestr(name, change(name, whole.read(name)))


def test_compressed_content_is_not_unpacked(run, tmp_path):
    with zipfile.ZipFile(tmp_path / CHECKPOINT, "w", zipfile.ZIP_DEFLATED) as bomb:
        zeros = bytes(10**8)
        copied(run / CHECKPOINT, bomb, lambda n, data: zeros if n.endswith("data/0") else data)
    with pytest.raises(TaskError, match="compressed or overlapping entries; a checkpoint has none"):
        read_checkpoint(tmp_path)


def test_a_tensor_cannot_reach_beyond_its_storage(run, tmp_path):
    numbers = b"M" + struct.pack("<H", 832)
    more = b"J" + struct.pack("<i", 2**31 - 1)

    def claimed(name, data):
        if not name.endswith("data.pkl"):
            return data
        assert numbers in data
        return data.replace(numbers, more, 1)

    with zipfile.ZipFile(tmp_path / CHECKPOINT, "w") as claim:
        copied(run / CHECKPOINT, claim, claimed)
    assert equal(weights(tmp_path), weights(run))


@pytest.mark.parametrize(
    ("limit", "message"),
    [
        ("MAX_BYTES", "a checkpoint has at most 100"),
        ("MAX_INDEX_BYTES", "bytes beside its tensors; expected at most 100"),
        ("MAX_INSTRUCTIONS", "more than 100 instructions"),
    ],
)
def test_a_file_beyond_a_limit_is_rejected(run, monkeypatch, limit, message):
    monkeypatch.setattr(checkpoint_file, limit, 100)
    with pytest.raises(TaskError, match=message):
        read_checkpoint(run)


class Bomb:
    def __init__(self, crater):
        self.crater = crater

    def __reduce__(self):
        return exec, (f"open({str(self.crater)!r}, 'w').close()",)


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
@pytest.mark.parametrize("command", ["play", "eval"])
def test_the_command_line_runs_no_code_of_a_checkpoint(tmp_path, content, capfd, command):
    crater = tmp_path / "crater"
    torch.save({**content, "more": Bomb(crater)}, tmp_path / "zip.pt")
    torch.save({"more": Bomb(crater)}, tmp_path / "old.pt", _use_new_zipfile_serialization=False)
    (tmp_path / "bare.pt").write_bytes(pickle.dumps(Bomb(crater)))
    for name in ("zip.pt", "old.pt", "bare.pt"):
        says = f"morphgen: {tmp_path / name} is not a checkpoint of morphgen train"
        assert refusal(command, tmp_path / name, capfd).startswith(says)
    assert not crater.exists()


@pytest.mark.parametrize("command", ["play", "eval", "finetune"])
def test_every_command_rejects_weights_that_are_not_finite(tmp_path, run, content, capfd, command):
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "config.json").write_bytes((run / "config.json").read_bytes())
    save(changed(content, ACTOR, lambda weight: weight * torch.nan), folder / CHECKPOINT)
    says = f"learner.actor.{ENTER}: 832 of 832 numbers are not finite"
    assert says in refusal(command, folder, capfd)
    assert not (tmp_path / "tuned").exists()
    with pytest.raises(TaskError, match=says):
        train(folder, small_config(), resume=True, execution=QUIET)


def test_weights_that_are_not_finite_do_not_replace_the_last_checkpoint(run, tmp_path):
    config, learner = read_checkpoint(run)
    write_checkpoint(tmp_path, config, learner)
    before = (tmp_path / CHECKPOINT).read_bytes()
    learner["actor"][ENTER][0, 0] = torch.nan
    with pytest.raises(TaskError, match=r"checkpoint.pt is not replaced: learner.actor.* not fin"):
        write_checkpoint(tmp_path, config, learner)
    assert (tmp_path / CHECKPOINT).read_bytes() == before


def refusal(command, path, capfd):
    """Return the one-line error of a command for a checkpoint."""
    words = {
        "play": ["play", "reach", "planar-cube", "--policy", path],
        "eval": ["eval", path],
        "finetune": ["finetune", path, "--out", path.parent / "tuned"],
    }[command]
    assert main(list(map(str, words))) == 2
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 1, lines
    return lines[0]
