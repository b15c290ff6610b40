"""Checkpoint files: written with a hash of their content, and read as untrusted data.

``torch.load`` with ``weights_only`` runs no code of a file. This module bounds what it may
allocate before it is called, and checks its result.
"""

from __future__ import annotations

import hashlib
import io
import logging
import math
import pickle
import pickletools
import struct
import zipfile
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from morphgen.errors import TaskError

_log = logging.getLogger(__name__)

HASH = "sha256"
"""Key of the hash of all other content; checkpoints of older versions have none."""
MAX_BYTES = 512 * 2**20
"""Largest size of a checkpoint's file, and of its tensors together [bytes]."""
MAX_INDEX_BYTES = 32 * 2**20
"""Largest size of a checkpoint without the numbers of its tensors [bytes]."""
MAX_INSTRUCTIONS = 2_000_000
"""Most pickle instructions of that part; a run of 1,000 environments has about 60,000."""
MAX_VALUES = 1_000_000
"""Most numbers, texts, tensors and containers in a checkpoint."""
MAX_LEVELS = 20
"""Most levels of nested containers."""
MAX_INTEGER_BITS = 256
"""Most bits of an integer; the states of random generators have 128."""
_GLOBALS = frozenset(
    {"collections OrderedDict", "torch._utils _rebuild_tensor_v2"}
    | {f"torch {kind}Storage" for kind in ("Float", "Double", "Half", "BFloat16")}
    | {f"torch {kind}Storage" for kind in ("Long", "Int", "Short", "Char", "Byte", "Bool")}
)
"""All Python objects that a checkpoint of morphgen names. torch itself would also allow some that
allocate as much as a file asks for, such as ``bytearray``."""


def packed(content: Mapping[str, Any], where: str) -> bytes:
    """Return the bytes of a checkpoint's file, with its hash.

    Raises:
        TaskError: If a number of the content is not finite, or it is beyond a limit.
    """
    _require_plain(content, where)
    file = io.BytesIO()
    torch.save({**content, HASH: _digest(content)}, file)
    return file.getvalue()


def unpacked(file: Path) -> tuple[dict[str, Any], bool]:
    """Return the content of a checkpoint's file without its hash, and whether it has one.

    Raises:
        TaskError: If the file is not a checkpoint, is damaged or beyond a limit, or a number in it
            is not finite.
    """
    try:
        _require_container(file)
        # Mapped, a storage that claims more than its record has cannot reach beyond the file.
        data = torch.load(file, map_location="cpu", weights_only=True, mmap=True)
    except (
        pickle.UnpicklingError,
        zipfile.BadZipFile,
        NotImplementedError,
        OverflowError,
        RecursionError,
        RuntimeError,
        EOFError,
        OSError,
        ValueError,
        KeyError,
        IndexError,
        TypeError,
        AttributeError,
        AssertionError,
    ) as error:
        raise TaskError(f"{file} is not a checkpoint of morphgen train") from error
    if not isinstance(data, dict):
        raise TaskError(f"{file} is not a checkpoint of morphgen train")
    digest = data.pop(HASH, None)
    _require_plain(data, str(file))
    if digest is not None and digest != _digest(data):
        raise TaskError(
            f"{file} is damaged: its content does not have the hash that was stored with it; use "
            "another copy"
        )
    return {key: in_main_memory(value) for key, value in data.items()}, digest is not None


@lru_cache(maxsize=1024)
def warn_of_no_hash(file: Path) -> None:
    """Warn once per file."""
    _log.warning(
        "morphgen: %s has no hash, as those of older versions: damage to it would not be noticed",
        file,
    )


def _require_container(file: Path) -> None:
    size = file.stat().st_size
    if size > MAX_BYTES:
        raise TaskError(f"{file}: {size:,} bytes; a checkpoint has at most {MAX_BYTES:,}")
    with zipfile.ZipFile(file) as archive:
        entries = archive.infolist()
        if sum(entry.file_size for entry in entries) > size or any(
            entry.compress_type != zipfile.ZIP_STORED for entry in entries
        ):
            raise TaskError(f"{file}: compressed or overlapping entries; a checkpoint has none")
        index = [entry for entry in entries if entry.filename.endswith("/data.pkl")]
        if len(index) != 1:
            raise TaskError(f"{file} is not a checkpoint of morphgen train")
        if index[0].file_size > MAX_INDEX_BYTES:
            raise TaskError(
                f"{file}: {index[0].file_size:,} bytes beside its tensors; expected at most "
                f"{MAX_INDEX_BYTES:,}"
            )
        instructions = archive.read(index[0])
    for count, (operation, argument, _) in enumerate(pickletools.genops(instructions)):
        if count > MAX_INSTRUCTIONS:
            raise TaskError(
                f"{file}: more than {MAX_INSTRUCTIONS:,} instructions to build its content"
            )
        if "GLOBAL" in operation.name and argument not in _GLOBALS:
            raise TaskError(
                f"{file} is not a checkpoint of morphgen train: it names {str(argument)[:100]!r}, "
                "which no checkpoint does"
            )


def _require_plain(content: object, where: str) -> None:
    """Require that the content has plain containers, finite numbers and dense tensors only.

    Raises:
        TaskError: If it has others, or is beyond a limit.
    """
    total = 0
    for count, (path, value) in enumerate(_walked(content, where)):
        if count > MAX_VALUES:
            raise TaskError(f"{where}: more than {MAX_VALUES:,} values")
        if isinstance(value, torch.Tensor):
            total += _require_tensor(value, where, path)
            if total > MAX_BYTES:
                raise TaskError(f"{where}: tensors of more than {MAX_BYTES:,} bytes")
        elif isinstance(value, float) and not math.isfinite(value):
            raise TaskError(f"{where}: {path} is {value}: not finite")
        elif isinstance(value, int) and value.bit_length() > MAX_INTEGER_BITS:
            raise TaskError(f"{where}: {path} is a number of {value.bit_length():,} bits")
        elif not isinstance(value, str | int | float | dict | list | tuple | None):
            raise TaskError(f"{where}: {path} is of an unexpected type: {type(value).__name__}")


def _walked(content: object, where: str) -> Iterator[tuple[str, object]]:
    """Yield every value of nested containers, with its path."""
    left: list[tuple[str, object, int]] = [("", content, 0)]
    while left:
        path, value, level = left.pop()
        yield path, value
        entries: Iterator[tuple[object, object]] | None = None
        if isinstance(value, dict):
            entries = iter(value.items())
        elif isinstance(value, list | tuple):
            entries = iter(enumerate(value))
        if entries is None:
            continue
        if level == MAX_LEVELS:
            raise TaskError(f"{where}: more than {MAX_LEVELS} levels of containers")
        for key, below in entries:
            if not isinstance(key, str | int):
                raise TaskError(f"{where}: a key of an unexpected type: {type(key).__name__}")
            left.append((f"{path}.{str(key)[:100]}".lstrip("."), below, level + 1))


def _require_tensor(tensor: torch.Tensor, where: str, path: str) -> int:
    """Require a dense tensor of finite numbers in main memory; return its size [bytes]."""
    plain = type(tensor) is torch.Tensor and tensor.device.type == "cpu"
    if not plain or tensor.layout != torch.strided or tensor.is_quantized:
        raise TaskError(f"{where}: {path} is not a dense tensor in main memory")
    size = tensor.numel() * tensor.element_size()
    if size > tensor.untyped_storage().nbytes():
        raise TaskError(f"{where}: {path} has {size:,} bytes, more than the file holds of it")
    if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
        lost = int((~torch.isfinite(tensor)).sum())
        raise TaskError(f"{where}: {path}: {lost} of {tensor.numel()} numbers are not finite")
    return size


def _digest(content: object) -> str:
    """Return the hexadecimal SHA-256 of a content; the order of keys does not matter."""
    digest = hashlib.sha256()
    _add(digest, content)
    return digest.hexdigest()


def _add(digest: hashlib._Hash, value: object) -> None:
    if isinstance(value, torch.Tensor):
        digest.update(f"t{value.dtype}{tuple(value.shape)}".encode())
        flat = value.detach().cpu().contiguous().reshape(-1)
        digest.update(flat.view(torch.uint8).numpy().tobytes())
    elif isinstance(value, dict):
        digest.update(f"d{len(value)};".encode())
        for key in sorted(value, key=lambda key: (isinstance(key, str), key)):
            _add(digest, key)
            _add(digest, value[key])
    elif isinstance(value, list | tuple):
        digest.update(f"l{len(value)};".encode())
        for item in value:
            _add(digest, item)
    elif isinstance(value, str):
        text = value.encode("utf-8", "surrogatepass")
        digest.update(f"s{len(text)};".encode() + text)
    elif isinstance(value, float):
        digest.update(b"f" + struct.pack(">d", value))
    else:
        digest.update(f"{type(value).__name__}{value};".encode())


def in_main_memory(value: object) -> object:
    """Return a copy of a content whose tensors are in main memory and need no file or GPU."""
    if isinstance(value, torch.Tensor):
        return value.detach().to("cpu", copy=True)
    if isinstance(value, dict):
        return {key: in_main_memory(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(in_main_memory(each) for each in value)
    return value
