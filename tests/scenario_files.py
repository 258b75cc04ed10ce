"""A small scenario file, and files of measurements of its run."""

import functools

import numpy as np
import trimesh

import ltljax as ltl
from ltljax._output import files
from ltljax.app import scenario

SPHERE = 'shape = "sphere"\nsubdivisions = 1'
START = 'u = "1 + 0.1*noise"\nv = 0.9'
REACTION = '[kinetics]\nname = "schnakenberg"\nrate = 30.0'
PLAIN = f"""
[mesh]
{SPHERE}
{REACTION}
[diffusivity]
u = 1.0
v = 10.0
[initial]
{START}
[time]
end = 0.1
frames = 2
"""
NUM_VERTICES = 42

FIT = """
[fit]
free = ["kinetics.a", "diffusivity.v"]
noise = 0.002
[[fit.data]]
file = "early.npz"
time = 0.05
[[fit.data]]
file = "late.npz"
time = 0.1
"""
# The scenario with a first guess for the unknowns.
GUESS = PLAIN.replace("rate = 30.0", "rate = 30.0\na = 0.13").replace("v = 10.0", "v = 8.0")


def changed(old, new, text=PLAIN):
    assert old in text
    return text.replace(old, new)


def write_ball(path):
    """Write a mesh of 200 vertices."""
    path.parent.mkdir(parents=True, exist_ok=True)
    ball = ltl.shapes.random_sphere(200, seed=0)
    trimesh.Trimesh(ball.vertices, ball.faces, process=False).export(path)


@functools.cache
def measured():
    """The mesh of the plain scenario, and its noisy states at two times, in the order of the mesh file."""
    example = scenario.read(PLAIN, "measured", ".")
    surface = ltl.Surface.from_mesh(example.mesh)
    us = np.asarray(ltl.solve(example.make_equation(surface), surface, example.u0, 0.1, ts=[0.05, 0.1], rtol=1e-6).us)
    noise = 0.002 * np.random.default_rng(0).normal(size=us.shape)
    return example.mesh, (us + noise)[:, np.asarray(example.mesh.source_order)]


def write_measured(folder, kind="npz"):
    """Write the measured states to files ``early`` and ``late`` of a kind."""
    mesh, states = measured()
    for name, state in zip(("early", "late"), states, strict=True):
        _write_state(folder / f"{name}.{kind}", state, mesh)


def _write_state(path, state, mesh):
    if path.suffix == ".npz":
        np.savez(path, u=state[:, 0], v=state[:, 1])
    elif path.suffix == ".csv":
        vertices = np.arange(0, len(state), 2)
        rows = np.column_stack([vertices, state[vertices]])
        # Spreadsheets begin a file with a byte-order mark.
        head = "\ufeffvertex,u,v"
        np.savetxt(path, rows, delimiter=",", header=head, comments="", fmt=["%d", "%.9g", "%.9g"], encoding="utf-8")
    elif path.suffix == ".vtp":
        files.write_vtp(path, mesh.vertices, mesh.faces, dict(u=state[:, 0], v=state[:, 1]))
    else:
        rows = "\n".join(
            " ".join(f"{value:.9g}" for value in (*x, *u)) for x, u in zip(mesh.vertices, state, strict=True)
        )
        head = f"ply\nformat ascii 1.0\nelement vertex {len(state)}\n"
        head += "".join(f"property double {axis}\n" for axis in ("x", "y", "z", "u", "v")) + "end_header\n"
        path.write_text(head + rows + "\n")
