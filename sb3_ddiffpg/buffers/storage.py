"""Rows of a replay buffer: the fields of a row lie together, so that reading one touches one place of memory."""

import warnings
from typing import Any

import numpy as np
import torch as th

# Name of a field -> shape and dtype of its value in one row
Fields = dict[str, tuple[tuple[int, ...], Any]]


class HostRows:
    """
    Rows in the main memory. The operating system commits zeroed pages only when they are written, so unused rows cost nothing.

    :param n_rows: How many
    :param fields: What one row holds
    """

    def __init__(self, n_rows: int, fields: Fields) -> None:
        self.fields = fields
        self.dtype = np.dtype([(name, dtype, shape) for name, (shape, dtype) in fields.items()], align=True)
        self.bytes = np.zeros((n_rows, self.dtype.itemsize), dtype=np.uint8)
        self.records = self.bytes.view(self.dtype)[:, 0]

    def __getitem__(self, name: str) -> np.ndarray:
        """All rows of one field, to read and to write; shape [n_rows, ...]."""
        return self.records[name]

    def take(self, rows: np.ndarray) -> np.ndarray:
        """
        :param rows: Any shape
        :return: Copies of their records, same shape
        """
        return self.records.take(rows)

    def tensors(self, rows: np.ndarray) -> dict[str, th.Tensor]:
        """
        :param rows: Shape [N]
        :return: Each field's values there, [N, ...]
        """
        taken = self.take(rows)
        return {name: th.from_numpy(taken[name]) for name in self.dtype.names or ()}

    def write(self, name: str, rows: np.ndarray, values: np.ndarray | th.Tensor) -> None:
        """
        :param name: Of a field
        :param rows: Shape [N]
        :param values: Shape [N, ...]
        """
        self.records[name][rows] = values.cpu().numpy() if isinstance(values, th.Tensor) else values

    def dump(self, n_rows: int) -> np.ndarray:
        """
        :param n_rows: The first so many
        :return: Their bytes, [n_rows, size of a row]
        """
        return self.bytes[:n_rows]

    def restore(self, raw: np.ndarray) -> None:
        """
        :param raw: Of the first rows, as ``dump`` gave them
        """
        self.bytes[: len(raw)] = raw

    @property
    def nbytes(self) -> int:
        """Size of all rows."""
        return self.bytes.nbytes


class DeviceRows:
    """
    The same on an accelerator. Neither reading nor writing waits for it.

    :param n_rows: How many
    :param fields: What one row holds
    :param device: Where
    """

    def __init__(self, n_rows: int, fields: Fields, device: th.device) -> None:
        self.fields = fields
        self.layout = HostRows(0, fields)  # only its dtype
        self.bytes = th.zeros(n_rows, self.layout.dtype.itemsize, dtype=th.uint8, device=device)

    def _split(self, packed: th.Tensor, name: str) -> th.Tensor:
        """The view of one field, of bytes [N, size of a row]."""
        dtype, offset = self.layout.dtype.fields[name][:2]  # type: ignore[index]
        values = packed[:, offset : offset + dtype.itemsize].view(th.from_numpy(np.empty(0, dtype=dtype.base)).dtype)
        return values.unflatten(1, dtype.shape) if dtype.shape else values.squeeze(1)

    def __getitem__(self, name: str) -> th.Tensor:
        """All rows of one field, to read and to write; shape [n_rows, ...]."""
        return self._split(self.bytes, name)

    def _indices(self, rows: np.ndarray) -> th.Tensor:
        return th.from_numpy(rows).to(self.bytes.device, th.long, non_blocking=True)

    def tensors(self, rows: np.ndarray) -> dict[str, th.Tensor]:
        """
        :param rows: Shape [N]
        :return: Each field's values there, [N, ...]
        """
        packed = self.bytes.index_select(0, self._indices(rows))
        return {name: self._split(packed, name) for name in self.layout.dtype.names or ()}

    def write(self, name: str, rows: np.ndarray, values: np.ndarray | th.Tensor) -> None:
        """
        :param name: Of a field
        :param rows: Shape [N]
        :param values: Shape [N, ...]
        """
        field = self[name]
        values = (th.from_numpy(values) if isinstance(values, np.ndarray) else values).to(
            field.device, field.dtype, non_blocking=True
        )
        # As bytes: not every type can be copied by index
        raw = values.reshape(len(rows), -1).contiguous().view(th.uint8)
        offset = self.layout.dtype.fields[name][1]  # type: ignore[index]
        self.bytes[:, offset : offset + raw.shape[1]].index_copy_(0, self._indices(rows), raw)

    def dump(self, n_rows: int) -> np.ndarray:
        """
        :param n_rows: The first so many
        :return: Their bytes, [n_rows, size of a row]
        """
        return self.bytes[:n_rows].cpu().numpy()

    def restore(self, raw: np.ndarray) -> None:
        """
        :param raw: Of the first rows, as ``dump`` gave them
        """
        self.bytes[: len(raw)] = th.from_numpy(raw).to(self.bytes.device)

    @property
    def nbytes(self) -> int:
        """Size of all rows."""
        return self.bytes.nbytes


def make_rows(n_rows: int, fields: Fields, device: th.device) -> HostRows | DeviceRows:
    """
    :param n_rows: How many
    :param fields: What one row holds
    :param device: Where they live
    :return: The storage
    """
    return HostRows(n_rows, fields) if device.type == "cpu" else DeviceRows(n_rows, fields, device)


class FreeRows:
    """Stack of rows that were used and are free again."""

    def __init__(self) -> None:
        self._rows = np.empty(0, dtype=np.int32)
        self.size = 0

    def add(self, rows: np.ndarray) -> None:
        """
        :param rows: That are used no longer, shape [N]
        """
        needed = self.size + len(rows)
        if needed > len(self._rows):
            self._rows = np.concatenate((self.all(), np.empty(2 * needed, dtype=np.int32)))
        self._rows[self.size : needed] = rows
        self.size = needed

    def take(self, n: int) -> np.ndarray:
        """
        :param n: How many of those that are there
        :return: Rows to use, shape [n]
        """
        self.size -= n
        return self._rows[self.size : self.size + n]

    def all(self) -> np.ndarray:
        """
        :return: Shape [size]
        """
        return self._rows[: self.size]

    def restore(self, rows: np.ndarray) -> None:
        """
        :param rows: What ``all`` gave
        """
        self._rows, self.size = rows.copy(), len(rows)


class RowSet:
    """
    A set of rows that is sampled, extended and reduced in time independent of its size. Sets that never share a row may
    share one ``position`` array.

    :param position: Where each row stands in ``rows``, shape [capacity], int32
    """

    def __init__(self, position: np.ndarray) -> None:
        self.position = position
        self.rows = np.empty(64, dtype=np.int32)
        self.size = 0

    def __getstate__(self) -> dict[str, Any]:
        """The shared array is its owner's to pickle, and to put back."""
        return {"rows": self.rows[: self.size], "size": self.size}

    def add(self, rows: np.ndarray) -> None:
        """
        :param rows: Rows that are in no set yet
        """
        new_size = self.size + len(rows)
        if new_size > len(self.rows):
            self.rows = np.concatenate((self.rows[: self.size], np.empty(max(new_size, len(self.rows)), dtype=np.int32)))
        self.rows[self.size : new_size] = rows
        self.position[rows] = np.arange(self.size, new_size, dtype=np.int32)
        self.size = new_size

    def remove(self, rows: np.ndarray) -> None:
        """
        :param rows: Rows of this set; the holes they leave are filled from the end
        """
        new_size = self.size - len(rows)
        holes = self.position[rows]
        in_tail = np.zeros(len(rows), dtype=bool)
        in_tail[holes[holes >= new_size] - new_size] = True
        movers = self.rows[new_size : self.size][~in_tail]
        holes = holes[holes < new_size]
        self.rows[holes] = movers
        self.position[movers] = holes
        self.size = new_size

    def sample(self, n: int) -> np.ndarray:
        """
        :param n: Number of rows to draw with replacement
        :return: Shape [n]
        """
        return self.rows[np.random.randint(0, self.size, size=n)]

    def spread(self, most: int) -> np.ndarray:
        """
        :param most: Number of rows, at most
        :return: Rows from all over the set, always the same ones, shape [at most ``most``]
        """
        return self.rows[: self.size : self.size // most + 1]


def storage_place(asked: th.device | str, samples: th.device) -> th.device:
    """
    Rows go straight to the networks or stay in the main memory: nowhere else.

    :param asked: ``"cpu"``, ``"auto"`` or the samples' device
    :param samples: Where these go
    :return: Where rows live
    :raises ValueError: If it is none of these
    """
    if asked == "auto":
        return samples
    if not isinstance(asked, (str, th.device)):
        raise ValueError(f"storage_device must be 'cpu', 'auto' or the samples' device, got {asked!r}")
    device = th.device(asked)
    if device.type != "cpu" and device.type != samples.type:
        warnings.warn(f"storage_device={asked!r}: the samples go to {samples}, so the rows stay in the main memory")
        return th.device("cpu")
    return device
