"""`save` writes a mesh and its fields to a file; the suffix determines the format.

`ltljax.load_fields` reads the fields back, and `ltljax.load_mesh` the mesh of most formats.
"""

import importlib.util
import json
import os
import re
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .._base.arguments import as_numbers
from .._mesh import Mesh, far_middle, vertex_normals
from . import colors, files, texture

# The attribute of a Zarr group that lists the arrays that `save` wrote.
_MADE_BY = "ltljax.save"
# Formats that store fields as named columns of numbers.
_COLUMN_FORMATS = (".ply", ".gii")


class _Contents(NamedTuple):
    """The contents of a file: a mesh and fields on its vertices.

    Attributes:
        vertices: (V, 3) positions, after the displacement.
        faces: (F, 3) vertex indices.
        normals: (V, 3) unit normals.
        uv: (F, 3, 2) texture coordinates of the corners, or None.
        fields: (V,) or (V, C) fields by name; (T, V) or (T, V, C) in a series.
        times: (T,) times of a series, or None.
        shades: (V, 4) colours of the first scalar field, unsigned bytes.
        colormap: name of the colour map of the shades.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    uv: np.ndarray | None
    fields: dict[str, np.ndarray]
    times: np.ndarray | None
    shades: np.ndarray
    colormap: str

    @property
    def last(self) -> dict[str, np.ndarray]:
        """The fields at the last time."""
        return self.frames()[-1]

    def frames(self) -> list[dict[str, np.ndarray]]:
        """The fields at each time; a single entry without times."""
        if self.times is None:
            return [self.fields]
        return [{name: values[index] for name, values in self.fields.items()} for index in range(len(self.times))]


def save(
    path: str | Path,
    mesh: Any,
    fields: Mapping[str, Any] | None = None,
    *,
    times: Any | None = None,
    displacement: float = 0.0,
    colormap: str = "viridis",
) -> None:
    """Write a mesh and fields on its vertices to a file, whose suffix determines the format.

    - VTP, VTU, PLY, NPZ and Zarr store all fields.
    - PVD stores all fields of a time series for ParaView, as VTP files in the folder ``NAME_series`` beside the file.
    - GIfTI stores all fields in float32, with the mesh (``.gii``) or without it (``.func.gii``).
    - FreeSurfer's ``.curv`` and ``.thickness`` store a single scalar field.
    - GLB and OBJ show the first scalar field as colours. An OBJ gets a texture if the mesh has texture coordinates.
    - STL and 3MF store the shape only. STL stores float32, so a shape far from the origin is written relative to its
      centre.

    An existing file is replaced once the new file is complete.

    Args:
        path: path of the file.
        mesh: a `Mesh`, or a `Surface`, whose current positions are written.
        fields: arrays (V,) or (V, C) by name, in the order of the mesh's vertices; (T, V) or (T, V, C) with ``times``.
        times: (T,) times of a series. Formats without times store the fields at the last time.
        displacement: distance by which the vertex with the largest value of the first scalar field moves along its
            normal. The displacement of the other vertices is proportional to the value above the smallest value.
        colormap: name of the colour map, a key of `ltl.io.COLORMAPS`.

    Raises:
        ValueError: the suffix is not known, a field does not match the mesh or the format, or a file or folder that
            `save` did not write is in the way.
        ImportError: the format needs a package of the extras `io` or `viz` that is not installed.

    Example:
        >>> import ltljax as ltl
        >>> mesh = ltl.shapes.icosphere(2)
        >>> ltl.save("ball.vtp", mesh, {"height": mesh.vertices[:, 2]})
        >>> ltl.load_fields("ball.vtp")["height"].shape
        (162,)
    """
    path = Path(path)
    ending = next((ending for ending in _WRITERS if path.name.lower().endswith(ending)), None)
    if ending is None:
        raise ValueError(f"Expected a file that ends in {', '.join(_WRITERS)}, found {path.name!r}.")
    package = {".gii": "nibabel", ".curv": "nibabel", ".thickness": "nibabel", ".zarr": "zarr"}.get(ending)
    if package is not None and importlib.util.find_spec(package) is None:
        raise ImportError(f'{ending} files need {package}. Run: pip install "ltljax[io]"')
    contents = _checked_contents(mesh, {} if fields is None else fields, times, displacement, colormap)
    if ending in _COLUMN_FORMATS:
        files.scalar_columns(contents.last)
    if not path.parent.is_dir():
        raise ValueError(f"There is no folder {path.parent}. Create it first, or choose another folder.")
    with tempfile.TemporaryDirectory(prefix=".ltljax-", dir=path.parent) as draft:
        _WRITERS[ending](Path(draft) / path.name, contents)
        _move_into_place(Path(draft), path)


def _move_into_place(draft: Path, path: Path) -> None:
    """Move the files of a draft to the folder of ``path``; raises if a file of the user is in the way."""
    written, folder = sorted(draft.iterdir()), path.parent
    # A texture image is replaced only if the MTL file beside it equals the new one, which shows that `save` wrote both.
    material = draft / f"{path.stem}.mtl"
    has_same_material = material.exists() and (folder / material.name).exists()
    has_same_material = has_same_material and (folder / material.name).read_bytes() == material.read_bytes()
    for new in written:
        old = folder / new.name
        is_another_kind = old.exists() and (old.is_dir() != new.is_dir() or (old.is_dir() and old.is_symlink()))
        if is_another_kind or (old.is_file() and new.name != path.name and not has_same_material):
            raise ValueError(f"{old} is in the way. Move it, or choose another name.")
        if old.is_dir() and (others := _other_files(old)):
            raise ValueError(
                f"{old} contains {others[0]!r}, which save did not write. Move it, or choose another name."
            )
    for new in written:
        old = folder / new.name
        if old.is_dir():
            shutil.rmtree(old)
        os.replace(new, old)


def _other_files(folder: Path) -> list[str]:
    """The names in the folder of a series or of a Zarr group that do not belong to files of `save`."""
    names = sorted(path.name for path in folder.iterdir())
    if folder.name.endswith("_series"):
        frame = re.compile(re.escape(folder.name.removesuffix("_series")) + r"_\d{4,}\.vtp")
        return [name for name in names if not (frame.fullmatch(name) and (folder / name).is_file())]
    try:
        arrays = json.loads((folder / "zarr.json").read_text(encoding="utf-8"))["attributes"][_MADE_BY]
    except (OSError, ValueError, LookupError, TypeError):
        return names
    return [name for name in names if name not in (*arrays, "zarr.json")]


def _checked_contents(
    mesh: Any, fields: Mapping[str, Any], times: Any, displacement: float, colormap: str
) -> _Contents:
    """The contents of a file from the arguments of `save`."""
    if isinstance(mesh, Mesh):
        vertices, faces, uv = mesh.vertices, mesh.faces, mesh.uv
        normals = vertex_normals(vertices, faces) if mesh.normals is None else mesh.normals
    elif hasattr(mesh, "centre") and hasattr(mesh, "normals"):  # a Surface, which this package does not import
        vertices, faces, uv = np.asarray(mesh.vertices, np.float64) + mesh.centre, np.asarray(mesh.faces), None
        normals = np.asarray(mesh.normals, np.float64)
    else:
        raise TypeError(f"Expected a Mesh or a Surface, found {type(mesh).__name__}.")
    times = None if times is None else np.asarray(times, np.float64)
    if times is not None and (times.ndim != 1 or not times.size):
        raise ValueError(f"Expected times of shape (T,) with at least one time, found shape {times.shape}.")
    time_shape = () if times is None else times.shape
    arrays = _checked_fields(fields, (*time_shape, len(vertices)))
    shades = np.full((len(vertices), 4), 255, np.uint8)
    first = next((values for values in arrays.values() if values.ndim == len(time_shape) + 1), None)
    if first is not None:
        values = np.asarray(first if times is None else first[-1], np.float64)
        shades = colors.vertex_colors(values, None, colormap)
        if displacement:
            vertices = texture.displaced(vertices, normals, values, displacement)
    elif displacement:
        raise ValueError("A displacement needs a scalar field, with one value for each vertex. Pass one in fields.")
    return _Contents(vertices, faces, normals, uv, arrays, times, shades, colormap)


def _checked_fields(fields: Mapping[str, Any], shape: tuple[int, ...]) -> dict[str, np.ndarray]:
    """The fields as arrays by name, each of a given shape or with an additional last axis.

    Floating-point arrays are converted to float32 or float64, which all formats support.
    """
    if not isinstance(fields, Mapping):
        raise TypeError(f'Expected fields by name, such as {{"u": u}}, found a {type(fields).__name__}.')
    arrays: dict[str, np.ndarray] = {}
    for name, values in fields.items():
        if not isinstance(name, str) or not name or not name.isprintable() or "/" in name:
            raise ValueError(f"Expected field names as printable text without slashes, found {name!r}.")
        if name in ("vertices", "faces", "times"):
            raise ValueError(f"The name {name!r} is reserved for the mesh or its times. Rename the field.")
        array = np.asarray(as_numbers(repr(name), values))
        if array.dtype.kind == "f" and array.dtype.itemsize not in (4, 8):
            array = array.astype(np.float32 if array.dtype.itemsize < 4 else np.float64)
        if array.dtype.kind not in "biuf" or array.shape[: len(shape)] != shape or array.ndim > len(shape) + 1:
            raise ValueError(
                f"Expected {name!r} as numbers of shape {shape}, or with one more axis, found {array.dtype} of shape "
                f"{array.shape}."
            )
        arrays[name] = array
    return arrays


def _vtp(path: Path, contents: _Contents) -> None:
    files.write_vtp(path, contents.vertices, contents.faces, contents.last)


def _vtu(path: Path, contents: _Contents) -> None:
    files.write_vtp(path, contents.vertices, contents.faces, contents.last, unstructured=True)


def _pvd(path: Path, contents: _Contents) -> None:
    times = np.zeros(1) if contents.times is None else contents.times
    folder = path.with_name(f"{path.stem}_series")
    folder.mkdir(exist_ok=True)
    names = [f"{folder.name}/{path.stem}_{index:04d}.vtp" for index in range(len(times))]
    for name, frame in zip(names, contents.frames(), strict=True):
        files.write_vtp(path.with_name(folder.name) / Path(name).name, contents.vertices, contents.faces, frame)
    files.write_series(path, times, names)


def _ply(path: Path, contents: _Contents) -> None:
    files.write_ply(path, contents.vertices, contents.faces, contents.shades, contents.last)


def _glb(path: Path, contents: _Contents) -> None:
    files.write_glb(path, contents.vertices, contents.faces, contents.shades, contents.normals)


def _obj(path: Path, contents: _Contents) -> None:
    shown = next((values for values in contents.last.values() if values.ndim == 1), None)
    if contents.uv is None or shown is None:
        shades = None if shown is None else contents.shades[:, :3] / 255
        files.write_obj(path, contents.vertices, contents.faces, contents.uv, colors=shades)
        return
    baked = texture.bake(contents.uv, contents.faces, shown)
    finite = shown[np.isfinite(shown)]
    limits = (float(finite.min()), float(finite.max())) if finite.size else None
    image = colors.vertex_colors(baked.ravel(), limits, contents.colormap)[:, :3].reshape(*baked.shape, 3)
    texture.write_textured_obj(path, contents.vertices, contents.faces, contents.uv, image)


def _stl(path: Path, contents: _Contents) -> None:
    files.write_stl(path, contents.vertices, contents.faces)


def _3mf(path: Path, contents: _Contents) -> None:
    files.write_3mf(path, contents.vertices, contents.faces)


def _gifti(path: Path, contents: _Contents) -> None:
    import nibabel
    from nibabel.gifti import gifti

    # Positions are relative to the middle, so that float32 preserves the shape; the file's transform restores them.
    middle = far_middle(contents.vertices)
    arrays: list[tuple[str, np.ndarray, str]] = []
    if not path.name.lower().endswith(".func.gii"):
        arrays.append(("NIFTI_INTENT_POINTSET", np.asarray(contents.vertices - middle, np.float32), ""))
        arrays.append(("NIFTI_INTENT_TRIANGLE", np.asarray(contents.faces, np.int32), ""))
    for frame in contents.frames():
        for name, values in files.scalar_columns(frame).items():
            rounded = np.asarray(values, np.float32)
            if values.dtype.kind in "iu" and not np.array_equal(rounded.astype(values.dtype), values):
                raise ValueError(
                    f"GIfTI stores float32, which does not represent the integers of {name!r} exactly. Save as VTP."
                )
            arrays.append(("NIFTI_INTENT_TIME_SERIES", rounded, name))
    transform = np.eye(4)
    transform[:3, 3] = middle
    parts = [
        gifti.GiftiDataArray(data, intent, meta={"Name": name}, coordsys=gifti.GiftiCoordSystem(xform=transform))
        for intent, data, name in arrays
    ]
    nibabel.save(gifti.GiftiImage(darrays=parts), path)


def _curv(path: Path, contents: _Contents) -> None:
    from nibabel.freesurfer.io import write_morph_data

    (values, *others) = contents.last.values() or (None,)
    if values is None or others or values.ndim != 1:
        raise ValueError(f"A file such as {path.name} stores a single scalar field. Pass one field of shape (V,).")
    write_morph_data(path, np.asarray(values, np.float32), len(contents.faces))


def _npz(path: Path, contents: _Contents) -> None:
    # numpy.savez takes the names of arrays as keyword arguments, which could clash with its own.
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, values in _arrays(contents).items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, np.asanyarray(values), allow_pickle=False)


def _zarr(path: Path, contents: _Contents) -> None:
    import zarr

    arrays = _arrays(contents)
    group = zarr.open_group(path, mode="w", attributes={_MADE_BY: list(arrays)})
    for name, values in arrays.items():
        group.create_array(name, data=np.ascontiguousarray(values))


def _arrays(contents: _Contents) -> dict[str, np.ndarray]:
    """The arrays of an NPZ or Zarr archive by name."""
    arrays: dict[str, np.ndarray] = dict(vertices=contents.vertices, faces=contents.faces)
    if contents.times is not None:
        arrays["times"] = contents.times
    return arrays | contents.fields


_WRITERS: dict[str, Callable[[Path, _Contents], None]] = {
    ".vtp": _vtp,
    ".vtu": _vtu,
    ".pvd": _pvd,
    ".ply": _ply,
    ".glb": _glb,
    ".obj": _obj,
    ".stl": _stl,
    ".3mf": _3mf,
    ".gii": _gifti,
    ".curv": _curv,
    ".thickness": _curv,
    ".npz": _npz,
    ".zarr": _zarr,
}
