"""Makes docs/imaging.png: an image denoised, a field's lines, a vector carried, scans made clean, ridges.

python docs/imaging.py
"""

import warnings
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import pyvista  # noqa: E402
from PIL import Image  # noqa: E402

import ltljax as ltl  # noqa: E402

HERE = Path(__file__).parent
MESHES = HERE.parents[1] / "shared" / "meshes"
SIZE = 440
VIEW, COW = (0.55, 0.35, 1.0), (0.6, 0.35, -1.0)


def main():
    warnings.simplefilter("ignore")
    panels = [*painted(), lines(), carried(), *scan(), relief()]
    rows = [np.concatenate(panels[start : start + 4], axis=1) for start in (0, 4)]
    sheet = Image.fromarray(np.concatenate(rows))
    sheet.convert("P", palette=Image.Palette.ADAPTIVE, colors=192).save(HERE / "imaging.png", optimize=True)


def drawn(vertices, faces, values=None, limits=None, colormap="magma", view=VIEW, smooth=True):
    """A surface as an image (SIZE, SIZE, 3)."""
    plotter = pyvista.Plotter(off_screen=True, window_size=[SIZE, SIZE])
    plotter.set_background("white")
    surface = pyvista.PolyData.from_regular_faces(np.asarray(vertices), np.asarray(faces))
    how = dict(color="#c9c3b4", ambient=0.1) if values is None else dict(
        scalars=np.asarray(values), clim=limits, cmap=colormap, ambient=0.3, show_scalar_bar=False
    )  # fmt: skip
    plotter.add_mesh(surface, smooth_shading=smooth, **how)
    plotter.view_vector(view, viewup=(0, 1, 0))
    plotter.camera.zoom(1.25)
    with pyvista.vtk_verbosity("error"):
        image = np.array(plotter.screenshot(return_img=True))
    plotter.close()
    return image


def painted():
    """A noisy cartoon on Spot, and the denoised one."""
    mesh = ltl.load_mesh(MESHES / "spot.obj")
    surface = ltl.Surface.from_mesh(mesh)
    x, y, z = surface.vertices.T
    clean = 0.15 + 0.7 * (jnp.sin(9 * x + 2 * y) * jnp.sin(8 * y) * jnp.cos(7 * z) > 0.02) + 0.15 * (y > 0.3)
    noisy = clean + 0.2 * jnp.asarray(np.random.default_rng(0).normal(size=clean.shape))
    found = ltl.imaging.denoise(surface, noisy, noise=0.2)
    return [drawn(mesh.vertices, mesh.faces, u, (-0.2, 1.2), view=COW) for u in (noisy, found)]


def lines():
    """The direction of the smaller curvature on Spot."""
    surface = ltl.Surface.from_mesh(ltl.load_mesh(MESHES / "spot.obj"))
    bent = ltl.curvature(surface)
    guide = bent.directions[:, 1] * (bent.principal[:, :1] - bent.principal[:, 1:])
    field = ltl.vectors.direction_field(surface, 2, guide=guide, time=1e-3)
    picture, _ = ltl.imaging.lic_picture(surface, field, view=COW, resolution=SIZE, is_directed=False)
    return np.stack([picture] * 3, axis=2)


def carried():
    """One vector carried over a torus, as arrows."""
    mesh = ltl.shapes.torus(n_major=96, n_minor=48)
    surface = ltl.Surface.from_mesh(mesh)
    source = int(jnp.argmax(surface.vertices @ jnp.array([0.0, -0.4, 1.0])))
    X = np.asarray(ltl.vectors.transport_vectors(surface, source, surface.geometry.frames[source, 0]))
    plotter = pyvista.Plotter(off_screen=True, window_size=[SIZE, SIZE])
    plotter.set_background("white")
    plotter.add_mesh(
        pyvista.PolyData.from_regular_faces(mesh.vertices, mesh.faces), color="#dcd8ce", smooth_shading=True
    )
    some = np.arange(0, mesh.num_vertices, 13)
    for which, color, factor in ((some, "#3b528b", 0.34), (np.array([source]), "#d1495b", 0.6)):
        points = pyvista.PolyData(mesh.vertices[which] + 0.01 * np.asarray(surface.normals)[which])
        points["X"] = X[which]
        plotter.add_mesh(points.glyph(orient="X", scale=False, factor=factor), color=color)
    plotter.view_vector((0.1, -0.9, 1.4), viewup=(0, 0, 1))
    plotter.camera.zoom(1.3)
    with pyvista.vtk_verbosity("error"):
        image = np.array(plotter.screenshot(return_img=True))
    plotter.close()
    return image


def scan():
    """A rabbit with noise of a fifth of an edge on its vertices, without it, and by the flow that rounds."""
    mesh = ltl.load_mesh(MESHES / "bunny_closed.obj")
    edge = np.linalg.norm(mesh.vertices[mesh.faces] - mesh.vertices[np.roll(mesh.faces, 1, axis=1)], axis=-1).mean()
    noise = 0.25 * edge * np.random.default_rng(0).normal(size=(mesh.num_vertices, 3))
    surface = ltl.Surface.from_mesh(ltl.Mesh(mesh.vertices + noise, mesh.faces))
    found = ltl.imaging.filter_normals(surface)
    rounded = ltl.imaging.mean_curvature_flow(surface, 0.6 * edge**2, keep_volume=True)
    return [drawn(vertices, mesh.faces, smooth=False) for vertices in (surface.vertices, found, rounded)]


def relief():
    """Ridges in red and valleys in blue."""
    mesh = ltl.load_mesh(MESHES / "armadillo.obj")
    found = ltl.imaging.ridges(ltl.Surface.from_mesh(mesh))
    return drawn(mesh.vertices, mesh.faces, found.ridge - found.valley, (-1, 1), "coolwarm", view=(0.3, 0.1, -1.0))


if __name__ == "__main__":
    main()
