"""Loading a built split without morphgen's models, and what is wrong with broken ones."""

import subprocess
import sys
import zipfile

import numpy as np
import pytest

from morphgen.benchmark.split_folder import load_split_folder
from morphgen.errors import BenchmarkError, MorphgenError
from morphgen.formats import zip_files as npz_files


def test_loading_returns_plain_records_with_tokens(whole, example_split):
    built = load_split_folder(whole)
    assert [robot["name"] for robot in built.robots] == [
        m.name for m in (*example_split.train, *example_split.test)
    ]
    assert [len(each) for each in (built.robots, built.train, built.test)] == [4, 3, 1]
    for i, robot in enumerate(built.robots):
        assert type(robot) is dict
        assert robot["side"] == ("test" if i == 3 else "train")
        np.testing.assert_array_equal(robot["tokens"], built.tokens[i])
        assert robot["mask"].sum() == robot["links"]
        assert (built.folder / robot["path"] / "robot.urdf").is_file()
    assert built.test[0]["name"] == built.train[:2][1]["name"].replace("cube", "plane")
    assert load_split_folder(str(whole)).folder == whole


def test_loading_does_not_import_torch(whole):
    code = (
        "import sys; from morphgen.benchmark.split_folder import load_split_folder; "
        f"print(len(load_split_folder({str(whole)!r}).train), 'torch' in sys.modules)"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.split() == ["3", "False"]


@pytest.mark.parametrize(
    ("path", "content", "message"),
    [
        ("build.json", None, r"is no built split: it has no build.json; morphgen split build"),
        ("SHA256SUMS", None, "is not finished: it has no SHA256SUMS; build it again"),
        ("robots.jsonl", None, "robots.jsonl: no such file"),
        ("robots.jsonl", b"{\n", "robots.jsonl:1: invalid JSON"),
        ("robots.jsonl", b"[]\n", "robots.jsonl:1: expected an object with a name and a side"),
        ("robots.jsonl", b"\xff\n", "robots.jsonl: cannot be read"),
        ("robots.jsonl", b"", "tokens.npz is not of the robots in robots.jsonl"),
        ("tokens.npz", None, "tokens.npz: no such file"),
        ("tokens.npz", b"", "tokens.npz: cannot be read"),
        ("tokens.npz", b"PK\x03\x04 and so on", "tokens.npz: cannot be read"),
    ],
)
def test_unreadable_files_are_errors_that_name_the_file(whole, path, content, message):
    if content is None:
        (whole / path).unlink()
    else:
        (whole / path).write_bytes(content)
    with pytest.raises(MorphgenError, match=message):
        load_split_folder(whole)


@pytest.mark.parametrize("change", ["tokens", "mask", "names"])
def test_inconsistent_token_arrays_are_errors(whole, change):
    with np.load(whole / "tokens.npz") as data:
        arrays = dict(data)
    arrays[change] = arrays[change][:2]
    np.savez(whole / "tokens.npz", **arrays)
    with pytest.raises(BenchmarkError, match=r"names, tokens and mask are of shapes \("):
        load_split_folder(whole)
    del arrays[change]
    np.savez(whole / "tokens.npz", **arrays)
    with pytest.raises(BenchmarkError, match=f"cannot be read: .*{change}"):
        load_split_folder(whole)


@pytest.mark.parametrize("kind", ["U4", "M8[s]", "?", "c16"])
def test_token_arrays_of_other_types_are_errors(whole, kind):
    with np.load(whole / "tokens.npz") as data:
        arrays = dict(data)
    arrays["tokens"] = arrays["tokens"].astype(int).astype(kind)
    np.savez(whole / "tokens.npz", **arrays)
    with pytest.raises(BenchmarkError, match=r"are of types .*expected str, float64 and bool"):
        load_split_folder(whole)


def test_arrays_that_claim_or_hold_more_than_the_memory_are_errors(whole, monkeypatch):
    header = {"descr": "<f8", "fortran_order": False, "shape": (10**9, 10**5)}
    with zipfile.ZipFile(whole / "tokens.npz", "w") as archive:
        for name in ("names", "tokens", "mask"):
            with archive.open(f"{name}.npy", "w") as file:
                np.lib.format.write_array_header_1_0(file, header)
    with pytest.raises(BenchmarkError, match=r"tokens\.npz: cannot be read: "):
        load_split_folder(whole)
    monkeypatch.setattr(npz_files, "MAX_BYTES", 1000)
    np.savez_compressed(whole / "tokens.npz", tokens=np.zeros(10_000))
    with pytest.raises(BenchmarkError, match="its arrays have more than"):
        load_split_folder(whole)
    with (whole / "tokens.npz").open("wb") as file:
        np.save(file, np.zeros(3))  # one array without an archive
    with pytest.raises(BenchmarkError, match=r"tokens\.npz: cannot be read: "):
        load_split_folder(whole)


def test_loading_a_parent_folder_suggests_the_split_folder(tmp_path, whole):
    with pytest.raises(BenchmarkError, match=r"did you mean .*whole/mine/some\?"):
        load_split_folder(tmp_path / "whole")
    with pytest.raises(BenchmarkError, match="nowhere: no such folder"):
        load_split_folder(tmp_path / "nowhere")
