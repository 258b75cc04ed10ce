"""Fields as colours and textures that other programs open again."""

import numpy as np
import pytest
import trimesh

import ltljax as ltl
from ltljax.cli import main
from ltljax.output import colors, files, texture


def in_light(colours):
    screen = colours[:, :3] / 255
    return np.where(screen <= 0.04045, screen / 12.92, ((screen + 0.055) / 1.055) ** 2.4)


def test_a_glb_opens_again_with_its_colours(tmp_path):
    mesh = ltl.shapes.icosphere(2)
    colours = colors.vertex_colors(mesh.vertices[:, 0], colormap="magma")
    files.write_glb(tmp_path / "ball.glb", mesh.vertices, mesh.faces, colours, mesh.vertices)
    (opened,) = trimesh.load(tmp_path / "ball.glb", process=False).geometry.values()
    np.testing.assert_array_equal(opened.faces, mesh.faces)
    np.testing.assert_allclose(opened.vertices, mesh.vertices, atol=1e-6)
    np.testing.assert_allclose(opened.visual.vertex_attributes["color"][:, :3], in_light(colours), atol=0.005)
    assert ltl.load_mesh(tmp_path / "ball.glb").num_vertices == mesh.num_vertices


def test_colours_end_where_their_map_does_and_gaps_are_grey():
    found = colors.vertex_colors(np.array([0.0, 1.0, np.nan]), colormap="gray")
    np.testing.assert_array_equal(found, [[0, 0, 0, 255], [255, 255, 255, 255], [128, 128, 128, 255]])
    with pytest.raises(ValueError, match="did you mean plasma"):
        colors.vertex_colors(np.zeros(2), colormap="plasna")


def square_with_map(n=8):
    """A square whose UV map is the square itself, in one chart."""
    mesh = ltl.shapes.square(1.0, n)
    flat = mesh.vertices[:, :2] - mesh.vertices[:, :2].min(axis=0)
    return ltl.Mesh(mesh.vertices, mesh.faces, uv=flat[mesh.faces])


def test_a_linear_field_is_baked_exactly():
    mesh = square_with_map()
    flat = mesh.vertices[:, :2] - mesh.vertices[:, :2].min(axis=0)
    image = texture.bake(mesh.uv, mesh.faces, flat[:, 0] + 10 * flat[:, 1], 64)
    centre = (np.arange(64) + 0.5) / 64
    np.testing.assert_allclose(image, centre[None] + 10 * centre[::-1, None], atol=1e-9)


def test_places_follow_welding_repair_turning_and_reordering(tmp_path):
    mesh = square_with_map(4)
    lines = [f"v {x} {y} {z}" for x, y, z in mesh.vertices]
    lines += [f"vt {u} {v}" for u, v in mesh.uv.reshape(-1, 2)]
    # Every second face turned over, one with a corner twice.
    for index, (a, b, c) in enumerate(mesh.faces + 1):
        corners = [(a, 3 * index + 1), (b, 3 * index + 2), (c, 3 * index + 3)]
        lines.append("f " + " ".join(f"{v}/{t}" for v, t in (corners if index % 2 else corners[::-1])))
    lines.append("f 1/1 1/1 2/2")
    (tmp_path / "sheet.obj").write_text("\n".join(lines))
    loaded = ltl.load_mesh(tmp_path / "sheet.obj", repair=True).reordered().scaled(2.0)
    assert loaded.report.reoriented_faces > 0
    shift = mesh.vertices[:, :2].min(axis=0)
    np.testing.assert_allclose(loaded.uv, loaded.vertices[loaded.faces][..., :2] / 2 - shift)
    with pytest.raises(ltl.MeshError, match="Expected uv of shape"):
        ltl.Mesh(mesh.vertices, mesh.faces, uv=mesh.uv[1:])


def torus_with_map():
    """A torus whose angles are its places: across the seams they go on beyond one."""
    mesh = ltl.shapes.torus(n_major=60, n_minor=30)
    x, y, z = mesh.vertices.T
    turns = np.stack([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y) - 2)], axis=1) / (2 * np.pi) % 1
    uv = turns[mesh.faces]
    uv += uv.max(axis=1, keepdims=True) - uv > 0.5
    return ltl.Mesh(mesh.vertices, mesh.faces, uv=uv)


def test_a_textured_mesh_opens_again_with_the_field_in_its_texture(tmp_path):
    pytest.importorskip("imageio")
    mesh = torus_with_map()
    u = np.sin(4 * mesh.vertices[:, 0])
    image = texture.bake(mesh.uv, mesh.faces, u, 512)
    assert np.isfinite(image).all()
    flat = colors.vertex_colors(image.ravel(), (-1, 1), "gray")[:, :3].reshape(512, 512, 3)
    written = texture.write_textured_obj(tmp_path / "torus.obj", mesh.vertices, mesh.faces, mesh.uv, flat)
    assert [file.suffix for file in written] == [".obj", ".mtl", ".png"]
    opened = trimesh.load(tmp_path / "torus.obj", force="mesh", process=False)
    places = opened.visual.uv[opened.faces].mean(axis=1)
    found = np.asarray(opened.visual.material.to_color(places))[:, 0] / 255 * 2 - 1
    expected = np.sin(4 * opened.vertices[opened.faces][..., 0]).mean(axis=1)
    assert np.abs(found - expected).mean() < 0.03
    np.testing.assert_allclose(ltl.load_mesh(tmp_path / "torus.obj").uv, mesh.uv, atol=1e-8)


def test_without_a_map_or_with_wrong_shapes_baking_says_so():
    mesh = ltl.shapes.icosphere(1)
    with pytest.raises(ValueError, match="no UV map"):
        texture.bake(mesh.uv, mesh.faces, np.zeros(mesh.num_vertices))
    sheet = square_with_map(2)
    with pytest.raises(ValueError, match="Expected values"):
        texture.bake(sheet.uv, sheet.faces, np.zeros(2))
    with pytest.raises(ValueError, match="Expected uv"):
        texture.bake(sheet.uv[1:], sheet.faces, np.zeros(sheet.num_vertices))


def test_a_map_that_is_tiled_or_not_finite_is_refused():
    sheet = square_with_map(4)
    values = np.zeros(sheet.num_vertices)
    with pytest.raises(ValueError, match="found others in face 0"):
        texture.bake(np.full_like(sheet.uv, np.inf), sheet.faces, values)
    with pytest.raises(ValueError, match="The map is tiled"):
        texture.bake(1e6 * sheet.uv, sheet.faces, values)
    with pytest.raises(ValueError, match="16 images in all"):
        texture.bake(4 * sheet.uv, sheet.faces, values)


def test_a_map_far_outside_is_repeated():
    sheet = square_with_map(4)
    values = sheet.vertices[:, 0]
    np.testing.assert_allclose(
        texture.bake(sheet.uv + 1000, sheet.faces, values, 64),
        texture.bake(sheet.uv, sheet.faces, values, 64),
        atol=1e-9,
    )


def test_letters_beyond_ascii_do_not_reach_the_names_inside_an_obj(tmp_path):
    pytest.importorskip("imageio")
    sheet = square_with_map(2)
    image = np.zeros((4, 4, 3), np.uint8)
    texture.write_textured_obj(tmp_path / "塗.obj", sheet.vertices, sheet.faces, sheet.uv, image)
    opened = trimesh.load(tmp_path / "塗.obj", force="mesh")
    assert opened.visual.material.image.size == (4, 4)


def test_a_surface_takes_a_field_as_its_relief():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(2))
    z = np.asarray(surface.vertices[:, 2])
    raised = ltl.displaced(surface, z, 0.5)
    np.testing.assert_allclose(np.linalg.norm(raised.vertices, axis=1).max(), 1.5, atol=1e-3)
    with pytest.raises(ValueError, match="finite values"):
        ltl.displaced(surface, np.full_like(z, np.nan))


def test_displacement_follows_the_normals():
    mesh = ltl.shapes.icosphere(2)
    moved = texture.displaced(mesh.vertices, mesh.vertices, mesh.vertices[:, 2], 0.5)
    height = np.linalg.norm(moved, axis=1)
    np.testing.assert_allclose(height, 1 + 0.25 * (1 + mesh.vertices[:, 2] / mesh.vertices[:, 2].max()), atol=1e-9)


def test_a_run_on_a_mesh_with_a_map_writes_its_texture(tmp_path):
    pytest.importorskip("pyvista")
    mesh = torus_with_map()
    texture.write_textured_obj(
        tmp_path / "donut.obj", mesh.vertices, mesh.faces, mesh.uv, np.zeros((4, 4, 3), np.uint8)
    )
    arguments = ["--mesh", str(tmp_path / "donut.obj"), "--t1", "0.1", "--frames", "1", "--out", str(tmp_path / "out")]
    assert main(["run", "allen-cahn", *arguments]) == 0
    opened = trimesh.load(tmp_path / "out" / "textured" / "allen-cahn.obj", force="mesh")
    assert opened.visual.material.image.size == (1024, 1024)
