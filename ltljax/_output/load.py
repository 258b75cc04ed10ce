"""`load_fields`: the fields in a file that `save` or another program wrote."""

import xml.etree.ElementTree
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from .._mesh import MeshError
from .._mesh.columns import DataError, read_columns
from .._mesh.readers import read_elsewhere

# Arrays of an archive that describe the mesh.
_MESH_ARRAYS = {"vertices", "faces"}
_COLORS = {"red", "green", "blue", "alpha"}


def load_fields(path: str | Path) -> dict[str, np.ndarray]:
    """The fields in a file by name, in the order of its vertices.

    Reads the formats in which `ltljax.save` stores fields (VTP, VTU, PVD, PLY, GIfTI, FreeSurfer's ``.curv`` and
    ``.thickness``, NPZ and Zarr), and CSV. The fields of a time series have shape (T, V) or (T, V, C); its times (T,)
    have the name ``times`` if the file stores them. PLY and GIfTI store the components of a field separately, as
    ``name_0``, ``name_1``, ...

    If a mesh was loaded from the same file, ``mesh.pull(field)`` reorders a field to match the mesh.

    Args:
        path: path of the file, or of the folder of a Zarr group.

    Raises:
        ValueError: there is no such file, its suffix is not known, it is damaged, or reading it needs a package of the
            extras `io` or `viz` that is not installed.
    """
    path = Path(path)
    ending = next((ending for ending in _READERS if path.name.lower().endswith(ending)), None)
    if ending is None:
        raise DataError(path, f"a file that ends in {', '.join(_READERS)}")
    if not path.exists():
        raise DataError(path, f"a file, but there is none at {path}")
    try:
        return _READERS[ending](path)
    except DataError:
        raise
    except ImportError:
        raise DataError(path, 'a file that can be read without the extra "io" (pip install "ltljax[io]")') from None
    except MeshError as error:
        raise DataError(path, f"a file of fields ({error})") from error
    # The readers raise arbitrary exceptions on damaged files.
    except Exception as error:
        raise DataError(path, f"an intact file ({' '.join(str(error).split())[:200]})") from error


def _npz(path: Path) -> dict[str, np.ndarray]:
    with open(path, "rb") as file, np.load(file, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files if name not in _MESH_ARRAYS}


def _ply(path: Path) -> dict[str, np.ndarray]:
    return {name: values for name, values in read_columns(path).items() if name not in _COLORS}


def _vtk(path: Path) -> dict[str, np.ndarray]:
    return read_elsewhere("vtk fields", path)


def _pvd(path: Path) -> dict[str, np.ndarray]:
    sets = xml.etree.ElementTree.parse(path).getroot().iter("DataSet")
    frames = [(float(entry.get("timestep", "nan")), path.parent / entry.get("file", "")) for entry in sets]
    if not frames:
        raise DataError(path, "a series of at least one file, found none")
    for _, file in frames:
        if not file.resolve().is_relative_to(path.parent.resolve()):
            raise DataError(path, f"files in its own folder, found {str(file)[:80]!r}")
    # Each file is read by a process of its own, which mostly waits for its libraries to load.
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
    return {name: np.asarray(array[...]) for name, array in group.arrays() if name not in _MESH_ARRAYS}


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
