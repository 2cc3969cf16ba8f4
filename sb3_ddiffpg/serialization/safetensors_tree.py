"""One file without code: plain values as JSON and arrays, in the safetensors format. Reading it runs nothing that it holds."""

import contextlib
import errno
import hashlib
import json
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

#: How often something was; NumPy and floats hold it
Count = Annotated[int, msgspec.Meta(ge=0, lt=2**53)]

FORMAT = "sb3_ddiffpg"
#: Counted up when a file means something else than before
VERSION = 1
# Key of the one-entry dict that stands in the JSON for an array
_ARRAY = "$array"
# Longer than anything that we write: a reader needs a hundred times the memory
_LONGEST = 2**24
# Deeper than anything that we write, and shallow enough for every reader
_DEEPEST = 50
_LONGEST_MESSAGE = 500


class DamagedError(ValueError):
    """A file is not what was written, or no file of this format."""


def write(path: Path, kind: str, tree: Any) -> None:
    """
    Write a file so that at any moment the old one or the whole new one is there.

    :param path: Of the file
    :param kind: What it is, such as ``"model"``
    :param tree: None, bools, numbers, strings, arrays and tensors, in lists, tuples (which come back as lists) and dicts
    :raises TypeError: If something else is in it, saying where
    :raises OSError: If it cannot be written, such as on a full disk; what was there before still is
    """
    arrays: dict[str, np.ndarray] = {}
    text = json.dumps(_pack(tree, "", arrays))
    if len(text) > _LONGEST:
        raise TypeError(f"{path.name}: {len(text)} characters of plain values; accepted are up to {_LONGEST}")
    metadata = {"format": FORMAT, "version": str(VERSION), "kind": kind, "tree": text, "sha256": _digest(kind, text, arrays)}
    # A folder of its own, for safetensors writes beside the file what it renames
    place = Path(tempfile.mkdtemp(prefix=f".{path.name}.{os.getpid()}.", dir=path.parent))
    unfinished = place / path.name
    try:
        unfinished.touch()
        mode = unfinished.stat().st_mode  # as the user wants files, which safetensors does not ask
        save_file(arrays, unfinished, metadata)
        unfinished.chmod(mode)
        with unfinished.open("rb") as file:
            os.fsync(file.fileno())
        os.replace(unfinished, path)
    except SafetensorError as error:  # it says so for whatever the system refuses
        named = re.search(r"os error (\d+)", str(error))
        number = int(named[1]) if named else errno.EIO
        raise OSError(number, f"{os.strerror(number)} ({error})", str(path)) from None
    finally:
        shutil.rmtree(place, ignore_errors=True)
    _sync_folder(path.parent)


def read(path: Path, kind: str) -> Any:
    """
    :param path: Of a file that ``write`` has written
    :param kind: What it must be
    :return: What was written, arrays in place of tensors
    :raises FileNotFoundError: If there is none
    :raises OSError: If it cannot be read
    :raises DamagedError: If it is damaged, or no file of this format
    :raises ValueError: If it is of another kind or version
    """
    if not path.is_file():
        raise FileNotFoundError(errno.ENOENT, "There is no such file", str(path))
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT:
                raise ValueError(f"{path} is no file of {FORMAT}")
            if metadata.get("version") != str(VERSION):
                raise ValueError(f"{path} is of version {metadata.get('version')!r}; this {FORMAT} reads version {VERSION}")
            if metadata.get("kind") != kind:
                raise ValueError(f"{path} holds a {metadata.get('kind')!r}, not a {kind!r}")
            arrays = _arrays(file, path)
    except SafetensorError as error:
        raise DamagedError(f"{path} is damaged, or no file of {FORMAT}: {error}") from None
    text = metadata.get("tree", "")
    if len(text) > _LONGEST:
        raise ValueError(f"{path}: {len(text)} characters of plain values; accepted are up to {_LONGEST}")
    if metadata.get("sha256") != _digest(kind, text, arrays):
        raise DamagedError(f"{path} is damaged: its contents do not fit their checksum")
    try:
        tree = _unpack(json.loads(text), arrays, [])
        if arrays:
            raise ValueError(f"{sorted(arrays)[:3]} have no place in it")
        return tree
    except (ValueError, RecursionError, KeyError) as error:
        raise DamagedError(f"{path} is damaged: {_short(error)}") from None


def _arrays(file: Any, path: Path) -> dict[str, np.ndarray]:
    try:
        return {name: file.get_tensor(name) for name in file.keys()}
    except (SafetensorError, TypeError, ValueError, KeyError, AttributeError) as error:  # NumPy has fewer types and sizes
        raise DamagedError(f"{path} is damaged, or no file of {FORMAT}: {_short(error)}") from None


def _short(error: Exception) -> str:
    """A file's own words may be long."""
    text = str(error)
    return text if len(text) <= _LONGEST_MESSAGE else f"{text[:_LONGEST_MESSAGE]}..."


def remove_unfinished(folder: Path, names: str) -> None:
    """
    What writers left behind that were killed, also one of this process's number: nothing else must be writing.

    :param folder: Where they wrote
    :param names: Pattern of the files' names
    """
    for path in folder.glob(f".{names}.*.*"):
        number = path.suffixes[-2][1:]
        if number.isdecimal() and path.is_dir() and (int(number) == os.getpid() or not _is_running(int(number))):
            shutil.rmtree(path, ignore_errors=True)


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


def convert(tree: Any, schema: Any, what: str) -> Any:
    """
    :param tree: As read from a file
    :param schema: What it must be: a type as ``msgspec`` knows them, with ``np.ndarray`` for arrays
    :param what: Its name, for the message
    :return: The same as the schema wants it
    :raises ValueError: If it is something else, saying where
    """
    try:
        return msgspec.convert(tree, schema)
    except (msgspec.ValidationError, UnicodeError, RecursionError) as error:
        raise ValueError(f"{what}: {_short(error)}") from None
    except AttributeError as error:  # an array where a mapping belongs
        raise ValueError(f"{what}: Expected `object`: {error}") from None


def check_array(array: np.ndarray, dtype: Any, shape: Sequence[int | None], what: str) -> np.ndarray:
    """
    :param array: As read from a file
    :param dtype: What its numbers must be
    :param shape: Its shape, None where any size will do
    :param what: Its name, for the message
    :return: The array
    :raises ValueError: If it is another
    """
    fits = len(array.shape) == len(shape) and all(want in (None, got) for want, got in zip(shape, array.shape, strict=True))
    if array.dtype != np.dtype(dtype) or not fits:
        accepted = f"{np.dtype(dtype)} of shape {['any' if size is None else size for size in shape]}"
        raise ValueError(f"{what}: {array.dtype} of shape {list(array.shape)} given; accepted is {accepted}")
    return array


def _pack(tree: Any, place: str, arrays: dict[str, np.ndarray]) -> Any:
    """What JSON holds of a tree; arrays go into ``arrays`` under their place."""
    if tree is None or isinstance(tree, (bool, int, float, str)):
        return tree
    if isinstance(tree, np.generic):
        return tree.item()
    torch = sys.modules.get("torch")  # where it was not imported, there is no tensor
    if torch is not None and isinstance(tree, torch.Tensor):
        tree = tree.detach().cpu().numpy()
    if isinstance(tree, np.ndarray):
        if tree.dtype.kind not in "biuf" or not tree.dtype.isnative:
            raise TypeError(f"{place}: an array of {tree.dtype} cannot be saved")
        arrays[place] = tree.copy(order="C")
        return {_ARRAY: place}
    if isinstance(tree, Mapping):
        for key in tree:
            if not isinstance(key, str) or key.startswith("$"):
                raise TypeError(f"{place}: keys must be strings without '$' in front, got {key!r}")
        return {key: _pack(value, f"{place}/{_name(key)}", arrays) for key, value in tree.items()}
    if isinstance(tree, Sequence):
        return [_pack(value, f"{place}/{i}", arrays) for i, value in enumerate(tree)]
    raise TypeError(f"{place}: {tree!r} of {type(tree)} cannot be saved")


def _unpack(packed: Any, arrays: dict[str, np.ndarray], path: list[str]) -> Any:
    """
    The tree of what JSON held at a path; each array is taken out of ``arrays`` at its place, or a small file would hold many.
    """
    if len(path) > _DEEPEST:
        raise ValueError(f"more than {_DEEPEST} lists and dicts in one another")
    if not isinstance(packed, (list, dict)):
        return packed
    if isinstance(packed, dict) and set(packed) == {_ARRAY}:
        place = "".join(f"/{_name(key)}" for key in path)
        if packed[_ARRAY] != place:
            raise ValueError(f"an array of another place at {place[:100]!r}")
        return arrays.pop(place)
    tree = []
    for key, each in packed.items() if isinstance(packed, dict) else enumerate(packed):
        path.append(str(key))
        tree.append((key, _unpack(each, arrays, path)))
        path.pop()
    return dict(tree) if isinstance(packed, dict) else [each for _, each in tree]


def _name(key: str) -> str:
    """As in JSON pointers, so that {"a/b": x} and {"a": {"b": y}} are two places."""
    return key.replace("~", "~0").replace("/", "~1")


def _digest(kind: str, text: str, arrays: dict[str, np.ndarray]) -> str:
    """Checksum of all that a file holds."""
    digest = hashlib.sha256(f"{kind}\0{text}".encode())
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(f"\0{name}\0{array.dtype.str}\0{array.shape}\0".encode())
        digest.update(array.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


def _sync_folder(folder: Path) -> None:
    """Let the new name survive a loss of power, where the system can."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
