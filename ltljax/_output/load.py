"""`load_fields`: the fields that a file holds for the vertices of a mesh, by name.

What enters: a file that `save` or another program wrote. What leaves: arrays in the order of the file's vertices.
"""

import xml.etree.ElementTree
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from .._mesh import MeshError
from .._mesh.columns import DataError, read_columns
from .._mesh.readers import read_elsewhere

# Arrays of an archive that belong to the mesh, not to the fields.
_OF_THE_MESH = {"vertices", "faces"}
_COLORS = {"red", "green", "blue", "alpha"}


def load_fields(path: str | Path) -> dict[str, np.ndarray]:
    """The fields of a file, by name, in the order of its vertices.

    Reads what `ltljax.save` writes of fields (VTP, VTU, PVD, PLY, GIfTI, FreeSurfer's ``.curv`` and ``.thickness``, NPZ
    and Zarr), and CSV. A series gives (T, V) or (T, V, C), and its times (T,) by the name ``times`` where the file has
    them. PLY and GIfTI hold the components of a field apart, as ``name_0`` and so on.

    For a mesh that was loaded from the same file, ``mesh.pull(field)`` is in the order of the mesh.

    Args:
        path: the file, or folder of a Zarr group.

    Raises:
        ValueError: there is no such file, its ending is not known, it is damaged, or it needs a package of the extras
            `io` or `viz` that is not installed.
    """
    path = Path(path)
    ending = next((ending for ending in _READERS if path.name.lower().endswith(ending)), None)
    if ending is None:
        raise DataError(path, f"a file that ends in {', '.join(_READERS)}")
    if not path.exists():
        raise DataError(path, f"a file, and there is none at {path}")
    try:
        return _READERS[ending](path)
    except DataError:
        raise
    except ImportError:
        raise DataError(path, 'a file that can be read without the extra "io" (pip install "ltljax[io]")') from None
    except MeshError as error:
        raise DataError(path, f"a file of fields ({error})") from error
    # Packages that read files meet damaged ones with any exception there is.
    except Exception as error:
        raise DataError(path, f"a sound file ({' '.join(str(error).split())[:200]})") from error


def _npz(path: Path) -> dict[str, np.ndarray]:
    with open(path, "rb") as file, np.load(file, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files if name not in _OF_THE_MESH}


def _ply(path: Path) -> dict[str, np.ndarray]:
    return {name: values for name, values in read_columns(path).items() if name not in _COLORS}


def _vtk(path: Path) -> dict[str, np.ndarray]:
    return read_elsewhere("vtk fields", path)


def _pvd(path: Path) -> dict[str, np.ndarray]:
    sets = xml.etree.ElementTree.parse(path).getroot().iter("DataSet")
    frames = [(float(entry.get("timestep", "nan")), path.parent / entry.get("file", "")) for entry in sets]
    if not frames:
        raise DataError(path, "a series of at least one file")
    for _, file in frames:
        if not file.resolve().is_relative_to(path.parent.resolve()):
            raise DataError(path, f"files in its own folder, found {str(file)[:80]!r}")
    # Each is read by a process of its own, which mostly waits for its libraries to load.
    with ThreadPoolExecutor() as pool:
        fields = list(pool.map(_vtk, [file for _, file in frames]))
    series = {name: np.stack([frame[name] for frame in fields]) for name in fields[0]}
    times = np.array([time for time, _ in frames])
    return series | ({} if np.isnan(times).any() else dict(times=times))


def _gifti(path: Path) -> dict[str, np.ndarray]:
    return read_elsewhere("gifti fields", path)


def _curv(path: Path) -> dict[str, np.ndarray]:
    return read_elsewhere("freesurfer fields", path)


def _zarr(path: Path) -> dict[str, np.ndarray]:
    import zarr

    group = zarr.open_group(path, mode="r")
    return {name: np.asarray(array[...]) for name, array in group.arrays() if name not in _OF_THE_MESH}


_READERS: dict[str, Callable[[Path], dict[str, np.ndarray]]] = {
    ".vtp": _vtk,
    ".vtu": _vtk,
    ".pvd": _pvd,
    ".ply": _ply,
    ".gii": _gifti,
    ".curv": _curv,
    ".thickness": _curv,
    ".npz": _npz,
    ".zarr": _zarr,
    ".csv": read_columns,
}
