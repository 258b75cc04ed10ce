"""A surface is loaded bit for bit as it was saved, and no other file becomes one."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ltljax as ltl


def cube():
    """A shape with creases, so that all tables are there."""
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


@pytest.mark.parametrize("scheme", [ltl.Monotone(), ltl.Polynomial(4), ltl.Paper()])
@pytest.mark.parametrize("make", [lambda: ltl.shapes.icosphere(2), lambda: ltl.shapes.disk(rings=4), cube])
def test_a_surface_is_loaded_bit_for_bit(tmp_path, scheme, make):
    surface = ltl.Surface.from_mesh(make(), scheme)
    surface.save(tmp_path / "a.npz")
    loaded = ltl.Surface.load(tmp_path / "a.npz")
    assert jax.tree.structure(loaded) == jax.tree.structure(surface)
    for one, other in zip(jax.tree.leaves(loaded), jax.tree.leaves(surface), strict=True):
        assert (one.dtype, type(one)) == (other.dtype, type(other))
        np.testing.assert_array_equal(one, other)
    assert str(loaded.report) == str(surface.report)
    u = surface.vertices[:, 0]
    np.testing.assert_array_equal(ltl.laplacian(loaded, u), ltl.laplacian(surface, u))


def test_a_loaded_surface_carries_derivatives_and_moves(tmp_path):
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(2), dtype=jnp.float32)
    surface.save(tmp_path / "a.npz")
    loaded = ltl.Surface.load(tmp_path / "a.npz")
    moved = loaded.with_vertices(1.1 * loaded.vertices)
    np.testing.assert_array_equal(moved.normals, surface.with_vertices(1.1 * surface.vertices).normals)
    gradient = jax.grad(lambda d: ltl.solve(ltl.Diffusion(d), loaded, loaded.vertices[:, 0], 0.1).u_end.sum())(1.0)
    assert np.isfinite(gradient)


def test_other_files_are_refused(tmp_path):
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


def test_a_damaged_file_is_a_surface_or_one_error(tmp_path):
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
