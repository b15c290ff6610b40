"""Zip archives: the same bytes for the same files, and entries that are refused."""

import io
import stat
import zipfile

import pytest

from morphgen.errors import FormatError
from morphgen.formats import zip_files
from morphgen.formats.zip_files import ZipLimits, unpack_zip, write_entries, write_zip

LIMITS = ZipLimits(max_bytes=10_000, max_files=5)


def archive(path, entries, method=zipfile.ZIP_DEFLATED):
    """Write an archive of (name or entry, content), in this order."""
    with zipfile.ZipFile(path, "w", method) as target:
        for entry, content in entries:
            target.writestr(entry, content)
    return path


def link(name, target="/etc/passwd"):
    entry = zipfile.ZipInfo(name)
    entry.create_system, entry.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
    return entry, target


def test_the_same_files_give_the_same_bytes(tmp_path):
    (tmp_path / "b.txt").write_bytes(b"from a file")
    contents = []
    for names in (("a/b", "a.txt"), ("a.txt", "a/b")):
        files = {name: tmp_path / "b.txt" for name in names} | {"c": b"bytes"}
        write_zip(tmp_path / "one.zip", files)
        target = io.BytesIO()
        write_entries(target, files)
        contents += [(tmp_path / "one.zip").read_bytes(), target.getvalue()]
    assert len(set(contents)) == 1
    unpack_zip(tmp_path / "one.zip", tmp_path / "out", LIMITS)
    found = {p.relative_to(tmp_path / "out").as_posix() for p in (tmp_path / "out").rglob("*")}
    assert found == {"a", "a/b", "a.txt", "c"}


@pytest.mark.parametrize(
    ("entries", "why"),
    [
        ([("../evil", b"x")], "'../evil' leads out of its folder"),
        ([("a/../../evil", b"x")], "leads out of its folder"),
        ([("/evil", b"x")], "leads out of its folder"),
        ([("C:/evil", b"x")], "leads out of its folder"),
        ([("..\\evil", b"x")], "leads out of its folder"),
        ([link("a/link")], "'a/link' is a link"),
        ([("a", b"x"), ("A", b"y")], "'A' is there twice"),
        ([("a", b"x"), ("a/b", b"y")], "'a/b' is in a folder that is a file"),
        ([("a", bytes(20_000))], "unpacks to more than 0 MB"),
        ([(f"{i}", b"") for i in range(6)], "holds more than 5 files"),
        ([("/".join("a" * 30), b"x")], "lies in more than 20 folders"),
        ([("n" * 300, b"x")], "is longer than 250 characters"),
        ([("a\nb", b"x")], "is not a valid file name"),
    ],
)
def test_unsafe_archives_are_refused_before_anything_is_written(tmp_path, entries, why):
    path = archive(tmp_path / "evil.zip", entries)
    (tmp_path / "out").mkdir()
    with pytest.raises(FormatError, match=r"evil\.zip: ") as caught:
        unpack_zip(path, tmp_path / "out", LIMITS)
    assert why in str(caught.value)
    assert "\n" not in str(caught.value)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["evil.zip", "out"]
    assert list((tmp_path / "out").iterdir()) == []


def test_other_compression_and_broken_archives_are_refused(tmp_path):
    (tmp_path / "out").mkdir()
    lzma = archive(tmp_path / "lzma.zip", [("a", b"x" * 100)], zipfile.ZIP_LZMA)
    with pytest.raises(FormatError, match="a method other than deflate"):
        unpack_zip(lzma, tmp_path / "out", LIMITS)
    whole = archive(tmp_path / "cut.zip", [("a", bytes(range(200)))]).read_bytes()
    for content in (whole[:60], b"", b"no zip at all"):
        (tmp_path / "cut.zip").write_bytes(content)
        with pytest.raises(FormatError, match=r"cut\.zip: not a readable zip"):
            unpack_zip(tmp_path / "cut.zip", tmp_path / "out", LIMITS)
    with pytest.raises(FormatError, match="no such file"):
        unpack_zip(tmp_path / "none.zip", tmp_path / "out", LIMITS)
    with pytest.raises(FormatError, match="out: is not a regular file"):
        unpack_zip(tmp_path / "out", tmp_path / "out", LIMITS)


def test_an_entry_that_is_larger_than_it_says_is_refused(tmp_path):
    path = archive(tmp_path / "liar.zip", [("a", bytes(5000))])
    content = bytearray(path.read_bytes())
    start = content.index(b"PK\x01\x02")
    content[start + 24 : start + 28] = (10).to_bytes(4, "little")  # size of the unpacked file
    path.write_bytes(content)
    (tmp_path / "out").mkdir()
    with pytest.raises(FormatError, match=r"liar.zip: (not a readable zip|.*larger)"):
        unpack_zip(path, tmp_path / "out", LIMITS)


def test_a_failed_write_leaves_nothing(tmp_path):
    with pytest.raises(FormatError, match="cannot write"):
        write_zip(tmp_path / "a.zip", {"x": tmp_path / "missing"})
    assert list(tmp_path.iterdir()) == []


def test_a_table_of_too_many_entries_is_not_read(tmp_path, monkeypatch):
    path = archive(tmp_path / "many.zip", [(f"folder{i}/", b"") for i in range(11)])
    (tmp_path / "out").mkdir()
    monkeypatch.setattr(zipfile, "ZipFile", None)
    for chunk in (2**20, 7):  # signatures at the ends of chunks count once
        monkeypatch.setattr(zip_files, "_CHUNK", chunk)
        with pytest.raises(FormatError, match=r"many\.zip: holds more than 5 files"):
            unpack_zip(path, tmp_path / "out", LIMITS)
    with path.open("rb") as file:
        zip_files.require_few_entries(file, ZipLimits(max_bytes=10_000, max_files=6))
