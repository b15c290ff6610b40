"""A damaged, incomplete or hostile checkpoint is rejected in one line, and runs no code."""

import copy
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


def refused(tmp_path, content, change):
    """Return the error of a checkpoint with changed content and its hash."""
    changed = copy.deepcopy(content)
    change(changed, changed["learner"])
    save(changed, tmp_path / "c.pt")
    with pytest.raises(TaskError) as error:
        read_checkpoint(tmp_path / "c.pt")
    text = str(error.value)
    assert "\n" not in text
    assert len(text) < 400
    assert text.startswith(str(tmp_path / "c.pt"))
    return text


def put(*path, value):
    """Return a function that sets the value at a path of the learner's state."""

    def change(_, learner):
        for key in path[:-1]:
            learner = learner[key]
        learner[path[-1]] = value

    return change


def put_run(*path, value):
    return lambda whole, _: put(*path, value=value)(whole, whole["run"])


def nested(levels, wide):
    value = [1]
    for _ in range(levels):
        value = [value] * wide
    return value


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda _, own: own["actor"][ENTER][0, :3].fill_(torch.nan),
            f"learner.actor.{ENTER}: 3 of 832 numbers are not finite",
        ),
        (
            lambda _, own: own["critic"][ENTER][0, 0].fill_(torch.inf),
            f"learner.critic.{ENTER}: 1 of 832 numbers are not finite",
        ),
        (
            lambda _, own: own["optimiser"]["state"][0]["exp_avg"].fill_(torch.inf),
            "exp_avg: 16 of 16 numbers are not finite",
        ),
        (
            lambda run, _: run["run"].update(reach=[1]),
            "run: reach: invalid value [1]; expected keys and values",
        ),
        (lambda run, _: run.update(format=torch.tensor(3)), "has format tensor(3); expected"),
        (put("actor_lr_scale", value=float("nan")), "learner.actor_lr_scale is nan: not finite"),
        (
            put("actor", ENTER, value=torch.ones(3)),
            f"actor: {ENTER} has shape (3,) of torch.float32; expected (8, 104)",
        ),
        (
            put("actor", ENTER, value=torch.ones(8, 104).double()),
            "of torch.float64; expected (8, 104) of torch.float32",
        ),
        (
            put("actor", ENTER, value=torch.zeros(1).expand(10**12)),
            "has 4,000,000,000,000 bytes, more than the file holds",
        ),
        (put("actor", ENTER, value="much"), f"actor: {ENTER} is 'much'; expected a tensor"),
        (lambda _, own: own["actor"].pop(ENTER), f"actor has no {ENTER}"),
        (
            put("critic", "more", value=torch.ones(1)),
            "critic has 'more', which its sizes do not ask for",
        ),
        (
            put("target_critic", "more", value=torch.ones(1)),
            "target_critic has 'more', which its sizes do not ask for",
        ),
        (put("actor", value=3), "learner: actor: invalid value 3; expected keys and values"),
        (lambda _, own: own.pop("policy"), "learner: missing key 'policy'"),
        (
            put("policy", "network", "mlp_width", value=10**12),
            "mlp_width 1000000000000: expected at most 8192",
        ),
        (
            put("policy", "network", "mlp_layers", value=10**9),
            "mlp_layers 1000000000: expected at most 100",
        ),
        (
            put("policy", "network", "mlp_width", value="abc"),
            "policy: network: mlp_width: invalid value 'abc'; expected an integer",
        ),
        (
            put("policy", "agent", value="hal"),
            "policy: unknown agent 'hal'; ",
        ),
        (put("policy", "colour", value=1), "policy: unknown key 'colour'"),
        (
            put("config", "gamma", value="big"),
            "config: gamma: invalid value 'big'; expected a number",
        ),
        (
            put("layout", "links", value=10**12),
            "layout: links 1000000000000: expected 0 to 100,000",
        ),
        (put("layout", "links", value=-4), "layout: links -4: expected 0 to 100,000"),
        (put("layout", "channels", value=5), "layout: channels: invalid value 5; expected a list"),
        (
            put("optimiser", "state", 0, "exp_avg", value=torch.ones(2)),
            "exp_avg of parameter 0 is not of shape (4, 4)",
        ),
        (put("optimiser", "state", 10**6, value={}), "state of an unknown parameter 1000000"),
        (put("batch", value=nested(12, 10)), "more than 1,000,000 values"),
        (put("batch", value=nested(100, 1)), "more than 20 levels of containers"),
        (put("update", value=2**300), "learner.update is a number of 301 bits"),
        (
            put("batch", value=bytearray(5)),
            "it names '__builtin__ bytearray', which no checkpoint does",
        ),
        (
            put("batch", value=torch.eye(3).to_sparse()),
            "_rebuild_sparse_tensor', which no checkpoint does",
        ),
        (
            put("batch", value=torch.empty(10**12, device="meta")),
            "_rebuild_meta_tensor_no_storage', which",
        ),
        (
            put_run("num_envs", value="many"),
            "run: num_envs: invalid value 'many'; expected an integer",
        ),
        (put_run("policy", value=[1]), "run: policy: invalid value [1]; expected keys and values"),
        (
            put_run("sim", value="gazebo"),
            "unknown simulator 'gazebo'; valid: kinematic, mujoco, pybullet",
        ),
        (put_run("ppo", "colour", value=1), "ppo: unknown key 'colour'"),
        (lambda whole, _: whole["run"].pop("source"), "run: missing key 'source'"),
        (lambda whole, _: whole.pop("run"), "is not a checkpoint of morphgen train"),
    ],
)
def test_an_invalid_checkpoint_is_rejected(tmp_path, content, change, message):
    assert message in refused(tmp_path, content, change)


def test_the_hash_is_stored_and_the_content_read_back(run, tmp_path):
    stored = torch.load(run / CHECKPOINT, weights_only=True)
    assert len(stored["sha256"]) == 64
    config, learner = read_checkpoint(run)
    write_checkpoint(tmp_path, config, learner)
    again = torch.load(tmp_path / CHECKPOINT, weights_only=True)
    assert again["sha256"] == stored["sha256"]


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


def test_a_changed_weight_is_detected(run, tmp_path, content):
    data = torch.load(run / CHECKPOINT, weights_only=True)
    data["learner"]["actor"][ENTER][0, 0] += 1e-6
    torch.save(data, tmp_path / CHECKPOINT)
    with pytest.raises(TaskError, match=f"{CHECKPOINT} is damaged: its content does not have the"):
        read_checkpoint(tmp_path)


def test_a_checkpoint_without_a_hash_is_refused(tmp_path, content):
    torch.save(content, tmp_path / CHECKPOINT)
    with pytest.raises(TaskError, match="is not a checkpoint of morphgen train"):
        read_checkpoint(tmp_path)


def test_compressed_content_is_not_unpacked(run, tmp_path):
    with (
        zipfile.ZipFile(run / CHECKPOINT) as whole,
        zipfile.ZipFile(tmp_path / CHECKPOINT, "w", zipfile.ZIP_DEFLATED) as bomb,
    ):
        for name in whole.namelist():
            zeros = bytes(10**8) if name.endswith("data/0") else whole.read(name)
            bomb.writestr(name, zeros)
    with pytest.raises(TaskError, match="compressed or overlapping entries; a checkpoint has none"):
        read_checkpoint(tmp_path)


def test_a_tensor_cannot_reach_beyond_its_storage(run, tmp_path):
    with (
        zipfile.ZipFile(run / CHECKPOINT) as whole,
        zipfile.ZipFile(tmp_path / CHECKPOINT, "w") as claim,
    ):
        for name in whole.namelist():
            record = whole.read(name)
            if name.endswith("data.pkl"):
                numbers = b"M" + struct.pack("<H", 832)
                assert numbers in record
                record = record.replace(numbers, b"J" + struct.pack("<i", 2**31 - 1), 1)
            claim.writestr(name, record)
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
        assert refusal(command, tmp_path / name, capfd).startswith(
            f"morphgen: {tmp_path / name} is not a checkpoint of morphgen train"
        )
    assert not crater.exists()


@pytest.mark.parametrize("command", ["play", "eval", "finetune"])
def test_every_command_rejects_weights_that_are_not_finite(tmp_path, run, content, capfd, command):
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "config.json").write_bytes((run / "config.json").read_bytes())
    broken = copy.deepcopy(content)
    broken["learner"]["actor"][ENTER].fill_(torch.nan)
    save(broken, folder / CHECKPOINT)
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
