"""HDF5 and netCDF-4 files made in memory: a file on disk that cannot be completed kills its process."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import h5py
import numpy as np

if TYPE_CHECKING:
    import xarray as xr

NO_VARIABLE = b"This is a netCDF dimension but not a netCDF variable."
OTHER = "_nc4_non_coord_"  # before the name of a variable that has the name of a dimension
OF_FORMAT = {"CLASS", "NAME", "DIMENSION_LIST", "REFERENCE_LIST", "_Netcdf4Dimid", "_Netcdf4Coordinates", "_FillValue"}
ENCODED = {"scale_factor", "add_offset", "missing_value", "calendar"}  # attributes of numbers that are not as written


def in_memory(head: int = 0, *, ordered: bool = False) -> h5py.File:
    """Return a new HDF5 file in memory with `head` bytes before those of HDF5, and without time stamps.

    `ordered` files keep the order of creation, which netCDF-4 needs.
    """
    creation = h5py.h5p.create(h5py.h5p.FILE_CREATE)
    if head:
        creation.set_userblock(head)
    if ordered:
        creation = _ordered(creation)
    access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
    access.set_libver_bounds(h5py.h5f.LIBVER_EARLIEST, h5py.h5f.LIBVER_LATEST)
    access.set_fapl_core(2**20, backing_store=False)
    return h5py.File(h5py.h5f.create(b"memory", fcpl=creation, fapl=access))


def image(file: h5py.File) -> bytes:
    """Return the bytes of a file in memory, without those left free by `head`."""
    file.flush()
    return bytes(file.id.get_file_image())


def netcdf(dataset: xr.Dataset, groups: Mapping[str, xr.Dataset] | None = None) -> bytes:
    """Return the bytes of a netCDF-4 file with the variables of a dataset, and those of its groups by name.

    Equal datasets give equal bytes.
    """
    with in_memory(ordered=True) as file:
        _write(file, dataset)
        for name, part in (groups or {}).items():
            made = h5py.h5g.create(file.id, name.encode(), gcpl=_ordered(h5py.h5p.create(h5py.h5p.GROUP_CREATE)))
            _write(h5py.Group(made), part)
        return image(file)


def _write(group: Any, dataset: xr.Dataset) -> None:
    """Write variables as xarray encodes them; h5netcdf would look up every dimension in the file, again and again.

    A dimension is a dimension scale of HDF5: the variable of its name, or else an empty data set.
    """
    from xarray.conventions import cf_encoder, encode_dataset_coordinates

    encoded, about = cf_encoder(*encode_dataset_coordinates(dataset))
    sizes = {dim: size for one in encoded.values() for dim, size in one.sizes.items()}
    own = {dim for dim in sizes if dim in encoded and encoded[dim].dims == (dim,)}
    scales, written = {}, []
    for dim in (dim for dim in sizes if dim not in own):
        scales[dim] = _data_set(group, dim, np.dtype(">f4"), (sizes[dim],))
        h5py.h5ds.set_scale(scales[dim].id, NO_VARIABLE + f"{sizes[dim]:10}".encode())
    for name, one in encoded.items():
        texts = one.dtype.kind in "OU"
        kind, fill = h5py.string_dtype() if texts else one.dtype, one.attrs.get("_FillValue")
        made = _data_set(group, OTHER + name if name in scales else name, kind, one.shape, fill)
        if made.size:
            made[...] = one.values.astype(object) if texts else one.values
        if name in own:
            scales[name] = made
            h5py.h5ds.set_scale(made.id, name.encode())
        else:
            written.append((made, one.dims))
        _attributes(made, one.attrs)
    for number, dim in enumerate(sizes):
        _attributes(scales[dim], {"_Netcdf4Dimid": np.int32(number)})
    for made, dims in written:
        for axis, dim in enumerate(dims):
            h5py.h5ds.attach_scale(made.id, scales[dim].id, axis)
    _attributes(group, about)


def _data_set(group: Any, name: str, dtype: Any, shape: tuple[int, ...], fill: Any = None) -> Any:
    """Make a data set; dimensions of length zero are unlimited, since netCDF has no others."""
    most = tuple(size or None for size in shape)
    return group.create_dataset(
        name, shape, dtype, maxshape=None if most == shape else most, fillvalue=fill, track_order=True
    )


def _attributes(to: Any, values: Mapping[str, Any]) -> None:
    """Write attributes: texts, and lists of numbers or texts."""
    for name, value in values.items():
        several = np.atleast_1d(value)
        texts = several.astype(h5py.string_dtype()) if several.dtype.kind == "U" else several
        to.attrs.create(name, value if texts is not several and np.ndim(value) == 0 else texts)


def _ordered(properties: Any) -> Any:
    """Properties of a file or group that keeps the order of its parts, without the time stamps of HDF5."""
    order = h5py.h5p.CRT_ORDER_TRACKED | h5py.h5p.CRT_ORDER_INDEXED
    properties.set_obj_track_times(False)
    properties.set_link_creation_order(order)
    properties.set_attr_creation_order(order)
    return properties


class Variable(NamedTuple):
    """A variable of a netCDF file: numbers or texts, the names of their dimensions, and what is said about them."""

    values: Any
    dims: tuple[str, ...]
    attributes: Mapping[str, Any] = {}


def variables(content: bytes, group: str = "") -> tuple[dict[str, Variable], dict[str, Any]]:
    """Return the variables of a netCDF-4 file and the texts and numbers that it has as attributes, without xarray.

    If the file has such a group, they are those of the group. Raises `OSError` if it is no HDF5 file.
    """
    with h5py.File(io.BytesIO(content), "r") as file:
        part = file[group] if group and file.get(group, getclass=True) is h5py.Group else file["/"]
        return _variables(part), dict(part.attrs)


def _variables(part: Any) -> dict[str, Variable]:
    """Variables of a group, in the order in which they were made where that is kept."""
    found = {}
    places: dict[int, str] = {}  # names of scales: to look one up takes as long as to read a variable
    for name in part:
        one = part[name]
        if h5py.h5i.get_type(one.id) != h5py.h5i.DATASET or NO_VARIABLE in bytes(one.attrs.get("NAME", b"")):
            continue
        about = {key: _plain(one.attrs[key]) for key in one.attrs if key not in OF_FORMAT}
        texts = h5py.check_string_dtype(one.dtype) is not None
        values = one.asstr()[()] if texts else one[()]
        coordinate = h5py.h5ds.is_scale(one.id) and np.ndim(values) == 1  # its own dimension
        dims = (name,) if coordinate else tuple(_dimension(one.id, axis, places) for axis in range(one.ndim))
        found[name.removeprefix(OTHER)] = Variable(values, dims, about)
    return found


def _dimension(of: Any, axis: int, places: dict[int, str]) -> str:
    """Name of a dimension of a variable; empty if it has none."""
    scales: list[Any] = []
    if h5py.h5ds.get_num_scales(of, axis):
        h5py.h5ds.iterate(of, axis, scales.append, 0)
    if not scales:
        return ""
    at = h5py.h5o.get_info(scales[0]).addr
    if at not in places:
        places[at] = Path(h5py.h5i.get_name(scales[0]).decode()).name
    return places[at]


def _plain(value: Any) -> Any:
    return value[0] if np.shape(value) == (1,) else value


def stored_dataset(path: Path) -> xr.Dataset:
    """Return the variables of a netCDF-4 file outside its groups, like ``xarray.load_dataset``, five times as fast.

    Raises `OSError` if it is no HDF5 file.
    """
    import xarray as xr

    with h5py.File(path, "r") as file:
        found, about = _variables(file["/"]), {key: _plain(value) for key, value in file.attrs.items()}
    if any(ENCODED & one.attributes.keys() for one in found.values()):  # by another program
        return xr.load_dataset(path, engine="h5netcdf")
    made, coordinates = {}, set()
    for name, (values, dims, said) in found.items():
        coordinates |= {name} if dims == (name,) else set(said.get("coordinates", "").split())
        texts = np.asarray(values).dtype.kind in "OU"
        kind = np.str_ if texts else bool if said.get("dtype") == "bool" else None
        about_it = {key: value for key, value in said.items() if key not in ("dtype", "coordinates")}
        made[name] = (dims, np.asarray(values, dtype=kind), about_it)
    return xr.Dataset(made, attrs=about).set_coords([name for name in made if name in coordinates])
