"""HDF5 and netCDF-4 files made in memory: a file on disk that cannot be completed kills its process."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import h5py
import numpy as np

from forward.model import FloatArray

if TYPE_CHECKING:
    import xarray as xr

File = h5py.File
OTHER = "_nc4_non_coord_"  # before the name of a variable that has the name of a dimension


def in_memory(creation: Any = None) -> h5py.File:
    """Return a new HDF5 file in memory; `creation` is its property list."""
    access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
    access.set_libver_bounds(h5py.h5f.LIBVER_EARLIEST, h5py.h5f.LIBVER_LATEST)
    access.set_fapl_core(2**20, backing_store=False)
    return h5py.File(h5py.h5f.create(b"memory", fcpl=creation, fapl=access))


def image(file: h5py.File) -> bytes:
    """Return the bytes of a file in memory, without those left free by `head`."""
    file.flush()
    return bytes(file.id.get_file_image())


def creation(head: int = 0, *, ordered: bool = False) -> Any:
    """Return the property list of a file with `head` bytes before those of HDF5, and without time stamps.

    `ordered` files keep the order of creation, which netCDF-4 needs.
    """
    properties = h5py.h5p.create(h5py.h5p.FILE_CREATE)
    if head:
        properties.set_userblock(head)
    return _ordered(properties) if ordered else properties


def netcdf(
    dataset: xr.Dataset,
    groups: Mapping[str, xr.Dataset] | None = None,
    head: int = 0,
    more: Callable[[h5py.File], None] = lambda file: None,
) -> bytes:
    """Return the bytes of a netCDF-4 file with groups; equal datasets give equal bytes.

    Parameters
    ----------
    dataset, groups
        The variables of the file, and those of its groups by name.
    head
        Bytes before those of HDF5.
    more
        Writes data that are not netCDF into groups of the file.
    """
    import h5netcdf
    from xarray.backends import H5NetCDFStore

    with in_memory(creation(head, ordered=True)) as file:
        for name in groups or {}:
            h5py.h5g.create(file.id, name.encode(), gcpl=_ordered(h5py.h5p.create(h5py.h5p.GROUP_CREATE)))
        with h5netcdf.File(file, "a") as whole:
            dataset.dump_to_store(H5NetCDFStore(whole))  # type: ignore[no-untyped-call]
            for name, part in (groups or {}).items():
                part.dump_to_store(H5NetCDFStore(whole.groups[name]))  # type: ignore[no-untyped-call]
        more(file)
        return image(file)


def _ordered(properties: Any) -> Any:
    """Properties of a file or group that keeps the order of its parts, without the time stamps of HDF5."""
    order = h5py.h5p.CRT_ORDER_TRACKED | h5py.h5p.CRT_ORDER_INDEXED
    properties.set_obj_track_times(False)
    properties.set_link_creation_order(order)
    properties.set_attr_creation_order(order)
    return properties


def holds(path: Path, group: str) -> bool:
    """Whether a file has a group."""
    with h5py.File(path, "r") as file:
        return group in file


class Variable(NamedTuple):
    """A variable of a netCDF file: numbers or texts, and the names of their dimensions."""

    values: Any
    dims: tuple[str, ...]


def variables(content: bytes, group: str = "") -> tuple[dict[str, Variable], dict[str, Any]]:
    """Return the variables of a netCDF-4 file and the texts and numbers that it has as attributes, without xarray.

    If the file has such a group, they are those of the group.

    Raises
    ------
    OSError
        If it is no HDF5 file.
    """
    with h5py.File(io.BytesIO(content), "r") as file:
        part = file[group] if group and isinstance(file.get(group), h5py.Group) else file
        found = {}
        for name, one in part.items():
            if not isinstance(one, h5py.Dataset) or b"not a netCDF variable" in bytes(one.attrs.get("NAME", b"")):
                continue
            dims = tuple(Path(dim[0].name).name if len(dim) else "" for dim in one.dims)
            texts = h5py.check_string_dtype(one.dtype) is not None
            values = one.asstr()[()] if texts else one[()]
            coordinate = h5py.h5ds.is_scale(one.id) and np.ndim(values) == 1  # its own dimension
            found[name.removeprefix(OTHER)] = Variable(values, (name,) if coordinate else dims)
        return found, dict(part.attrs)


def stored_array(path: Path, place: str) -> FloatArray:
    """Return the numbers of a data set in a file.

    Raises
    ------
    OSError, KeyError
        If the file cannot be read, or has no such data set.
    """
    with h5py.File(path, "r") as file:
        return np.asarray(file[place], dtype=float)
