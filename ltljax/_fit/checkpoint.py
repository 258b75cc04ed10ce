"""An interrupted fit on disk: its unknowns, and the checks that only the same fit goes on from them."""

import dataclasses
import io
import zipfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._base.folder import Folder
from .._solve.fingerprint import fingerprint
from .._solve.restart import RestartError
from .observations import Observations
from .unknowns import Unknowns

# Residuals that differ by less than this share, of themselves and of the data, are those of the same model.
_SAME = 1e-4
_ANEW = "Fit without resume, or give another checkpoint."


class Checkpoint:
    """The unknowns on disk, whole or not at all, and what a fit must be to go on from them.

    Args:
        path: the file.
        space: the unknowns.
        data: what is fitted.
    """

    def __init__(self, path: Path, space: Unknowns, data: Observations):
        self.path, self.space, self.data = path, space, data
        self.folder = Folder(path.parent)
        self.fit = {"data": fingerprint(data), "ranges of parameters": fingerprint(space.transforms)}

    def keep(self, z: Array, loss: float, spread: np.ndarray) -> None:
        """Write a step: the unknowns, the loss there, and the spread of the misfit that it was computed with."""
        scales = np.array([float(scale) for scale in self.space.scales])
        content = io.BytesIO()
        np.savez(
            content, unknowns=np.asarray(z), names=np.array(self.space.names), scales=scales, loss=loss,
            spread=np.asarray(spread), fit=np.array(list(self.fit.values())),
        )  # fmt: skip
        with self.folder.locked(waits=True):
            self.folder.write(self.path.name, content.getvalue())

    def read(self) -> tuple[Unknowns, Array, float, np.ndarray]:
        """The unknowns with the scales they were left with, their vector, the loss there, and the spread."""
        try:
            with np.load(self.path, allow_pickle=False) as file:
                kept = {name: file[name] for name in ("unknowns", "names", "scales", "loss", "spread", "fit")}
        # NumPy meets damaged files with any of these.
        except (ValueError, KeyError, OSError, EOFError, NotImplementedError, RecursionError, zipfile.BadZipFile):
            raise RestartError(f"{self.path} is damaged, or no file of a fit. {_ANEW}") from None
        if tuple(kept["names"]) != self.space.names:
            raise RestartError(
                f"{self.path} holds the parameters of another fit: {', '.join(kept['names'][:8])}; expected "
                f"{', '.join(self.space.names[:8])}. {_ANEW}"
            )
        for (what, mine), theirs in zip(self.fit.items(), kept["fit"], strict=True):
            if mine != theirs:
                raise RestartError(f"{self.path} holds another fit: its {what} differ. {_ANEW}")
        scales = tuple(jnp.asarray(k, s.dtype) for k, s in zip(kept["scales"], self.space.scales, strict=True))
        space = dataclasses.replace(self.space, scales=scales)
        self.space = space
        return space, jnp.asarray(kept["unknowns"], scales[0].dtype), float(kept["loss"]), kept["spread"]

    def refuse_other(self, loss: float, left: float, spread: np.ndarray) -> None:
        """Raise where the model gives another loss than the one that was left."""
        here, there = np.sqrt(2 * loss), np.sqrt(2 * left)
        values = np.asarray(self.data.values, np.float64)
        noise = spread * (1.0 if self.data.noise is None else np.asarray(self.data.noise, np.float64))
        size = np.linalg.norm(np.sqrt(values) if self.data.is_count else values / noise)
        if not abs(here - there) <= _SAME * (there + size):
            raise RestartError(
                f"{self.path} holds another fit: its loss was {left:.6g} where this model's is {loss:.6g}. {_ANEW}"
            )
