"""A loaded surface is identical to the saved surface, and other files raise an error."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ltljax as ltl


def cube():
    """A shape with creases, whose surface has every kind of table."""
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    n, corners = 4, np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], float)
    points, faces = [], []
    for quad in quads:
        a, b, _, d = corners[quad]
        base = len(points)
        points += [a + (b - a) * i / n + (d - a) * j / n for i in range(n + 1) for j in range(n + 1)]
        for i in range(n):
            for j in range(n):
                p = base + i * (n + 1) + j
                faces += [[p, p + n + 1, p + 1], [p + 1, p + n + 1, p + n + 2]]
    return ltl.Mesh(np.array(points), np.array(faces), weld=True)


SCHEMES = {"monotone": ltl.Monotone(), "polynomial": ltl.Polynomial(4), "paper": ltl.Paper()}
SHAPES = {"sphere": lambda: ltl.shapes.icosphere(2), "disk": lambda: ltl.shapes.disk(rings=4), "cube": cube}
QUICK = [("monotone", "cube"), ("monotone", "disk"), ("polynomial", "sphere"), ("paper", "disk")]
PAIRS = [(scheme, shape) for scheme in SCHEMES for shape in SHAPES]


@pytest.mark.parametrize(
    ("scheme", "shape"), [*QUICK, *(pytest.param(*pair, marks=pytest.mark.slow) for pair in PAIRS if pair not in QUICK)]
)
def test_a_loaded_surface_is_identical_to_the_saved_surface(tmp_path, scheme, shape):
    surface = ltl.Surface.from_mesh(SHAPES[shape](), SCHEMES[scheme])
    surface.save(tmp_path / "a.npz")
    loaded = ltl.Surface.load(tmp_path / "a.npz")
    assert jax.tree.structure(loaded) == jax.tree.structure(surface)
    for leaf, expected in zip(jax.tree.leaves(loaded), jax.tree.leaves(surface), strict=True):
        assert (leaf.dtype, type(leaf)) == (expected.dtype, type(expected))
        np.testing.assert_array_equal(leaf, expected)
    assert str(loaded.report) == str(surface.report)
    u = surface.vertices[:, 0]
    np.testing.assert_array_equal(ltl.laplacian(loaded, u), ltl.laplacian(surface, u))


def test_a_loaded_surface_can_be_moved_and_differentiated(tmp_path):
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(2), dtype=jnp.float32)
    surface.save(tmp_path / "a.npz")
    loaded = ltl.Surface.load(tmp_path / "a.npz")
    moved = loaded.with_vertices(1.1 * loaded.vertices)
    np.testing.assert_array_equal(moved.normals, surface.with_vertices(1.1 * surface.vertices).normals)

    def heat(diffusivity):
        equation, u0 = ltl.Diffusion(diffusivity), loaded.vertices[:, 0]
        return ltl.solve(equation, loaded, u0, 0.1, solver=ltl.RKL1(), dt=0.05).u_end.sum()

    assert np.isfinite(jax.grad(heat)(1.0))


def test_other_files_are_rejected(tmp_path):
    with pytest.raises(ValueError, match="there is none at"):
        ltl.Surface.load(tmp_path / "missing.npz")
    (tmp_path / "text.npz").write_text("hello")
    np.savez(tmp_path / "arrays.npz", a=np.zeros(3))
    tree = dict(ltljax=1, record={"record": "os:system", "fields": {}})
    np.savez(tmp_path / "code.npz", tree=np.array(json.dumps(tree)))
    tree["record"] = {"record": "ltljax._lifting.schemes:Monotone", "fields": {}}
    np.savez(tmp_path / "scheme.npz", tree=np.array(json.dumps(tree)))
    np.savez(tmp_path / "later.npz", tree=np.array(json.dumps(dict(tree, ltljax=99))))
    for name in ("text", "arrays", "code", "scheme", "later"):
        with pytest.raises(ValueError, match=r"Expected a file that Surface\.save wrote, found"):
            ltl.Surface.load(tmp_path / f"{name}.npz")


def test_a_damaged_file_gives_a_surface_or_a_value_error(tmp_path):
    ltl.Surface.from_mesh(ltl.shapes.icosphere(1)).save(tmp_path / "a.npz")
    data, random = (tmp_path / "a.npz").read_bytes(), np.random.default_rng(5)
    for _ in range(100):
        changed = bytearray(data)
        changed[random.integers(len(data))] ^= 1 << random.integers(8)
        length = len(data) if random.random() < 0.7 else random.integers(len(data))
        (tmp_path / "b.npz").write_bytes(changed[:length])
        messages = []
        try:
            ltl.Surface.load(tmp_path / "b.npz")
        except ValueError as error:
            messages.append(str(error))
        assert all(message.startswith("Expected a file that Surface.save wrote") for message in messages)
