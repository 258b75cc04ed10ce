"""`save`: a mesh with fields becomes a file of the kind that its ending names.

What enters: a mesh or a surface, and arrays by name. What leaves: one file, or for a series and for a texture several
files beside it. `ltljax.load_fields` reads the fields back, and of most kinds `ltljax.load_mesh` the mesh.
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

# The attribute of a Zarr group of `save` that names its arrays.
_MADE_BY = "ltljax.save"
# Kinds that hold fields as columns of numbers, and each column by its name.
_IN_COLUMNS = (".ply", ".gii")


class _Saved(NamedTuple):
    """A mesh, its fields (V,) or (V, C), or (T, V) and (T, V, C) at times (T,).

    Attributes:
        vertices: (V, 3), displaced where that was asked for.
        faces: (F, 3).
        normals: (V, 3).
        uv: (F, 3, 2) places of the corners in an image, or None.
        fields: by name.
        times: (T,) times of a series, or None.
        shades: (V, 4) of unsigned bytes, the colours of the first field of numbers.
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
        """The fields, of a series the last."""
        return self.frames()[-1]

    def frames(self) -> list[dict[str, np.ndarray]]:
        """The fields at each time, or once where there are no times."""
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
    """Write a mesh, and fields on its vertices, to a file.

    The ending names the kind. All fields are kept by VTP, VTU, PVD (a series of VTP files for ParaView, in a folder
    ``NAME_series`` beside it), PLY, GIfTI (``.gii`` with the mesh, ``.func.gii`` without it; in float32), NPZ and Zarr.
    FreeSurfer's ``.curv`` and ``.thickness`` keep one field. GLB and OBJ show the first field of numbers as colours; an
    OBJ whose mesh has a UV map gets a texture. STL and 3MF keep the shape alone, for printers; an STL far from the
    origin is written about its middle, as its numbers are in float32.

    A file of the same name is replaced, when the new one is complete.

    Args:
        path: the file.
        mesh: a `Mesh`, or a `Surface` with the positions it has now.
        fields: arrays (V,) or (V, C) by name, in the order of the mesh's vertices; (T, V) or (T, V, C) with ``times``.
        times: (T,), of a series. Files that know no times get the last field.
        displacement: how far the vertex with the largest value of the first field of numbers is moved along its normal;
            the vertex with the smallest value stays in place.
        colormap: a colour map of the pictures.

    Raises:
        ValueError: the ending is not known, a field does not fit the mesh or the kind of file, or a folder that was not
            written by `save` is in the way.
        ImportError: the kind needs a package of the extras `io` or `viz` that is not installed.

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
    saved = _prepared(mesh, {} if fields is None else fields, times, displacement, colormap)
    if ending in _IN_COLUMNS:
        files.scalar_columns(saved.last)
    if not path.parent.is_dir():
        raise ValueError(f"There is no folder {path.parent}. Make it first, or choose another one.")
    with tempfile.TemporaryDirectory(prefix=".ltljax-", dir=path.parent) as draft:
        _WRITERS[ending](Path(draft) / path.name, saved)
        _put(Path(draft), path)


def _put(draft: Path, path: Path) -> None:
    """Move what was written into place."""
    written, folder = sorted(draft.iterdir()), path.parent
    # An OBJ that was written with a texture has it replaced; a picture of somebody else stays.
    material = draft / f"{path.stem}.mtl"
    is_again = material.exists() and (folder / material.name).exists()
    is_again = is_again and (folder / material.name).read_bytes() == material.read_bytes()
    for new in written:
        old = folder / new.name
        is_another_kind = old.exists() and (old.is_dir() != new.is_dir() or (old.is_dir() and old.is_symlink()))
        if is_another_kind or (old.is_file() and new.name != path.name and not is_again):
            raise ValueError(f"{old} is in the way. Move it, or choose another name.")
        if old.is_dir() and (others := _foreign(old)):
            raise ValueError(f"{old} holds {others[0]!r}, which save did not write. Move it, or choose another name.")
    for new in written:
        old = folder / new.name
        if old.is_dir():
            shutil.rmtree(old)
        os.replace(new, old)


def _foreign(folder: Path) -> list[str]:
    """What a folder holds beside the files of a series, or of a Zarr group, that `save` writes."""
    names = sorted(path.name for path in folder.iterdir())
    if folder.name.endswith("_series"):
        frame = re.compile(re.escape(folder.name.removesuffix("_series")) + r"_\d{4,}\.vtp")
        return [name for name in names if not (frame.fullmatch(name) and (folder / name).is_file())]
    try:
        arrays = json.loads((folder / "zarr.json").read_text(encoding="utf-8"))["attributes"][_MADE_BY]
    except (OSError, ValueError, LookupError, TypeError):
        return names
    return [name for name in names if name not in (*arrays, "zarr.json")]


def _prepared(mesh: Any, fields: Mapping[str, Any], times: Any, displacement: float, colormap: str) -> _Saved:
    if isinstance(mesh, Mesh):
        vertices, faces, uv = mesh.vertices, mesh.faces, mesh.uv
        normals = vertex_normals(vertices, faces) if mesh.normals is None else mesh.normals
    elif hasattr(mesh, "centre") and hasattr(mesh, "normals"):  # a Surface, which this room does not import
        vertices, faces, uv = np.asarray(mesh.vertices, np.float64) + mesh.centre, np.asarray(mesh.faces), None
        normals = np.asarray(mesh.normals, np.float64)
    else:
        raise TypeError(f"Expected a Mesh or a Surface, found {type(mesh).__name__}.")
    times = None if times is None else np.asarray(times, np.float64)
    lead = () if times is None else times.shape
    if times is not None and (times.ndim != 1 or not times.size):
        raise ValueError(f"Expected times of shape (T,), one at least, found {times.shape}.")
    if not isinstance(fields, Mapping):
        raise TypeError(f'Expected fields by name, such as {{"u": u}}, found a {type(fields).__name__}.')
    arrays = {_checked_name(name): _in_a_common_type(as_numbers(repr(name), values)) for name, values in fields.items()}
    for name, values in arrays.items():
        expected = (*lead, len(vertices))
        if values.dtype.kind not in "biuf" or values.shape[: len(expected)] != expected or values.ndim > len(lead) + 2:
            raise ValueError(
                f"Expected {name!r} as numbers of shape {expected}, or with one more axis, found {values.dtype} of "
                f"shape {values.shape}."
            )
    shades = np.full((len(vertices), 4), 255, np.uint8)
    first = next((values for values in arrays.values() if values.ndim == len(lead) + 1), None)
    if first is not None:
        values = np.asarray(first if times is None else first[-1], np.float64)
        shades = colors.vertex_colors(values, None, colormap)
        if displacement:
            vertices = texture.displaced(vertices, normals, values, displacement)
    elif displacement:
        raise ValueError("A displacement needs a field of one number for each vertex.")
    return _Saved(vertices, faces, normals, uv, arrays, times, shades, colormap)


def _checked_name(name: Any) -> str:
    """The name of a field, if all kinds of files can hold it."""
    if not isinstance(name, str) or not name or not name.isprintable() or "/" in name:
        raise ValueError(f"Expected the name of a field as a printable text without slashes, found {name!r}.")
    if name in ("vertices", "faces", "times"):
        raise ValueError(f"The name {name!r} is reserved for the mesh or its times. Choose another one.")
    return name


def _in_a_common_type(values: Any) -> np.ndarray:
    """An array, whose floats have four or eight bytes."""
    array = np.asarray(values)
    if array.dtype.kind == "f" and array.dtype.itemsize not in (4, 8):
        return array.astype(np.float32 if array.dtype.itemsize < 4 else np.float64)
    return array


def _vtp(path: Path, saved: _Saved) -> None:
    files.write_vtp(path, saved.vertices, saved.faces, saved.last)


def _vtu(path: Path, saved: _Saved) -> None:
    files.write_vtp(path, saved.vertices, saved.faces, saved.last, unstructured=True)


def _pvd(path: Path, saved: _Saved) -> None:
    times = np.zeros(1) if saved.times is None else saved.times
    folder = path.with_name(f"{path.stem}_series")
    folder.mkdir(exist_ok=True)
    names = [f"{folder.name}/{path.stem}_{index:04d}.vtp" for index in range(len(times))]
    for name, frame in zip(names, saved.frames(), strict=True):
        files.write_vtp(path.with_name(folder.name) / Path(name).name, saved.vertices, saved.faces, frame)
    files.write_series(path, times, names)


def _ply(path: Path, saved: _Saved) -> None:
    files.write_ply(path, saved.vertices, saved.faces, saved.shades, saved.last)


def _glb(path: Path, saved: _Saved) -> None:
    files.write_glb(path, saved.vertices, saved.faces, saved.shades, saved.normals)


def _obj(path: Path, saved: _Saved) -> None:
    shown = next((values for values in saved.last.values() if values.ndim == 1), None)
    if saved.uv is None or shown is None:
        shades = None if shown is None else saved.shades[:, :3] / 255
        files.write_obj(path, saved.vertices, saved.faces, saved.uv, colors=shades)
        return
    baked = texture.bake(saved.uv, saved.faces, shown)
    finite = shown[np.isfinite(shown)]
    limits = (float(finite.min()), float(finite.max())) if finite.size else None
    image = colors.vertex_colors(baked.ravel(), limits, saved.colormap)[:, :3].reshape(*baked.shape, 3)
    texture.write_textured_obj(path, saved.vertices, saved.faces, saved.uv, image)


def _stl(path: Path, saved: _Saved) -> None:
    files.write_stl(path, saved.vertices, saved.faces)


def _3mf(path: Path, saved: _Saved) -> None:
    files.write_3mf(path, saved.vertices, saved.faces)


def _gifti(path: Path, saved: _Saved) -> None:
    import nibabel
    from nibabel.gifti import gifti

    # Relative to a middle, to where the file's transform moves them, so that float32 keeps the shape.
    middle = far_middle(saved.vertices)
    arrays: list[tuple[str, np.ndarray, str]] = []
    if not path.name.lower().endswith(".func.gii"):
        arrays.append(("NIFTI_INTENT_POINTSET", np.asarray(saved.vertices - middle, np.float32), ""))
        arrays.append(("NIFTI_INTENT_TRIANGLE", np.asarray(saved.faces, np.int32), ""))
    for frame in saved.frames():
        for name, values in files.scalar_columns(frame).items():
            rounded = np.asarray(values, np.float32)
            if values.dtype.kind in "iu" and not np.array_equal(rounded.astype(values.dtype), values):
                raise ValueError(f"GIfTI keeps float32, which does not hold the whole numbers of {name!r}. Take VTP.")
            arrays.append(("NIFTI_INTENT_TIME_SERIES", rounded, name))
    place = np.eye(4)
    place[:3, 3] = middle
    parts = [
        gifti.GiftiDataArray(data, intent, meta={"Name": name}, coordsys=gifti.GiftiCoordSystem(xform=place))
        for intent, data, name in arrays
    ]
    nibabel.save(gifti.GiftiImage(darrays=parts), path)


def _curv(path: Path, saved: _Saved) -> None:
    from nibabel.freesurfer.io import write_morph_data

    (values, *others) = saved.last.values() or (None,)
    if values is None or others or values.ndim != 1:
        raise ValueError(f"A file such as {path.name} holds one number for each vertex: give one field of them.")
    write_morph_data(path, np.asarray(values, np.float32), len(saved.faces))


def _npz(path: Path, saved: _Saved) -> None:
    # numpy.savez takes names as arguments, some of which it has itself.
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, values in _arrays(saved).items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, np.asanyarray(values), allow_pickle=False)


def _zarr(path: Path, saved: _Saved) -> None:
    import zarr

    arrays = _arrays(saved)
    group = zarr.open_group(path, mode="w", attributes={_MADE_BY: list(arrays)})
    for name, values in arrays.items():
        group.create_array(name, data=np.ascontiguousarray(values))


def _arrays(saved: _Saved) -> dict[str, np.ndarray]:
    """What an archive of arrays holds."""
    own: dict[str, np.ndarray] = dict(vertices=saved.vertices, faces=saved.faces)
    if saved.times is not None:
        own["times"] = saved.times
    return own | saved.fields


_WRITERS: dict[str, Callable[[Path, _Saved], None]] = {
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
