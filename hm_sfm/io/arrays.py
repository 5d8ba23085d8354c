"""Arrays and attributes of HDF5 files."""

from typing import Any

import h5py
import numpy as np


def read_array(group: h5py.Group, name: str, rows: int | None = None) -> np.ndarray:
    """The dataset `name` of a group, or its first `rows`. Raises KeyError where there is none."""
    dataset = group[name]
    if not isinstance(dataset, h5py.Dataset):
        raise KeyError(f"{name!r} is no dataset")
    return np.asarray(dataset[()] if rows is None else dataset[:rows])


def read_attributes(node: h5py.HLObject) -> dict[str, Any]:
    """All attributes of a group or dataset."""
    return dict(node.attrs)


def open_group(file: h5py.Group, name: str) -> h5py.Group:
    """The group `name` of a file or group. Raises KeyError where there is none."""
    group = file[name]
    if not isinstance(group, h5py.Group):
        raise KeyError(f"{name!r} is no group")
    return group
