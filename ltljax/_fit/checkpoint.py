"""An interrupted fit on disk: its unknowns, and the checks that only the same fit continues from them."""

import dataclasses
import io
import zipfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._base.owned_folder import Folder
from .._solve.fingerprint import fingerprint
from .._solve.restart import RestartError
from .observations import Observations
from .unknowns import Unknowns

# Residuals belong to the same model if their norms differ by less than this share of the norms of residuals and data.
_SAME = 1e-4
_CURE = "Fit without resume, or give another checkpoint."


@dataclasses.dataclass(frozen=True)
class Interrupted:
    """The content of a checkpoint.

    Attributes:
        space: unknowns with the scales of the interrupted fit.
        z: vector of the unknowns.
        loss: loss at ``z``.
        spread: spread of the misfit that the loss was computed with.
    """

    space: Unknowns
    z: Array
    loss: float
    spread: np.ndarray


class Checkpoint:
    """The file that keeps the unknowns of a fit. It is written completely or not at all.

    Args:
        path: file.
        space: unknowns.
        data: fitted data.
    """

    def __init__(self, path: Path, space: Unknowns, data: Observations):
        self.path, self.space, self.data = path, space, data
        self.folder = Folder(path.parent)
        self.fit = {"data": fingerprint(data), "ranges of parameters": fingerprint(space.transforms)}

    def keep(self, z: Array, loss: float, spread: np.ndarray) -> None:
        """Write the unknowns, the loss there, and the spread of the misfit that it was computed with."""
        scales = np.array([float(scale) for scale in self.space.scales])
        content = io.BytesIO()
        np.savez(
            content, unknowns=np.asarray(z), names=np.array(self.space.names), scales=scales, loss=loss,
            spread=np.asarray(spread), fit=np.array(list(self.fit.values())),
        )  # fmt: skip
        with self.folder.locked(waits=True):
            self.folder.write(self.path.name, content.getvalue())

    def read(self) -> Interrupted:
        """The content of the file; its scales become those of later checkpoints.

        Raises:
            RestartError: the file is damaged, or belongs to a fit of other data or parameters.
        """
        try:
            with np.load(self.path, allow_pickle=False) as file:
                content = {name: file[name] for name in ("unknowns", "names", "scales", "loss", "spread", "fit")}
        # NumPy raises any of these on a damaged file.
        except (ValueError, KeyError, OSError, EOFError, NotImplementedError, RecursionError, zipfile.BadZipFile):
            raise RestartError(f"{self.path} is damaged, or not the file of a fit. {_CURE}") from None
        if tuple(content["names"]) != self.space.names:
            raise RestartError(
                f"{self.path} holds the parameters of another fit: {', '.join(content['names'][:8])}; expected "
                f"{', '.join(self.space.names[:8])}. {_CURE}"
            )
        for (name, own), other in zip(self.fit.items(), content["fit"], strict=True):
            if own != other:
                raise RestartError(f"{self.path} holds another fit: its {name} differ. {_CURE}")
        scales = tuple(
            jnp.asarray(value, scale.dtype) for value, scale in zip(content["scales"], self.space.scales, strict=True)
        )
        self.space = dataclasses.replace(self.space, scales=scales)
        z = jnp.asarray(content["unknowns"], scales[0].dtype)
        return Interrupted(self.space, z, float(content["loss"]), content["spread"])

    def refuse_other(self, loss: float, loss_in_file: float, spread: np.ndarray) -> None:
        """Raise `RestartError` if the model gives another loss than the one in the file."""
        norm, norm_in_file = np.sqrt(2 * loss), np.sqrt(2 * loss_in_file)
        values = np.asarray(self.data.values, np.float64)
        noise = spread * (1.0 if self.data.noise is None else np.asarray(self.data.noise, np.float64))
        data_norm = np.linalg.norm(np.sqrt(values) if self.data.is_count else values / noise)
        if not abs(norm - norm_in_file) <= _SAME * (norm_in_file + data_norm):
            raise RestartError(
                f"{self.path} holds another fit: its loss was {loss_in_file:.6g} and the loss of this model is "
                f"{loss:.6g}. {_CURE}"
            )
