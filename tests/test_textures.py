"""Fields as colours and textures that other programs open again."""

import tomllib

import numpy as np
import pytest
import trimesh
from PIL import Image

import ltljax as ltl
from ltljax._output import colors, files, texture
from ltljax.app import scenario
from ltljax.app.cli import main


def linear(colours):
    """Linear colours from sRGB bytes."""
    srgb = colours[:, :3] / 255
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def test_a_glb_opens_with_its_colours(tmp_path):
    mesh = ltl.shapes.icosphere(2)
    colours = colors.vertex_colors(mesh.vertices[:, 0], colormap="magma")
    files.write_glb(tmp_path / "ball.glb", mesh.vertices, mesh.faces, colours, mesh.vertices)
    (opened,) = trimesh.load(tmp_path / "ball.glb", process=False).geometry.values()
    np.testing.assert_array_equal(opened.faces, mesh.faces)
    np.testing.assert_allclose(opened.vertices, mesh.vertices, atol=1e-6)
    np.testing.assert_allclose(opened.visual.vertex_attributes["color"][:, :3], linear(colours), atol=0.005)
    assert ltl.load_mesh(tmp_path / "ball.glb").num_vertices == mesh.num_vertices


def test_limits_have_the_end_colours_of_the_map_and_nan_is_grey():
    colours = colors.vertex_colors(np.array([0.0, 1.0, np.nan]), colormap="gray")
    np.testing.assert_array_equal(colours, [[0, 0, 0, 255], [255, 255, 255, 255], [128, 128, 128, 255]])
    with pytest.raises(ValueError, match="did you mean plasma"):
        colors.vertex_colors(np.zeros(2), colormap="plasna")


def square_with_map(n=8):
    """A square whose texture coordinates are its own coordinates."""
    mesh = ltl.shapes.square(1.0, n)
    flat = mesh.vertices[:, :2] - mesh.vertices[:, :2].min(axis=0)
    return ltl.Mesh(mesh.vertices, mesh.faces, uv=flat[mesh.faces])


def test_a_linear_field_is_baked_exactly():
    mesh = square_with_map()
    flat = mesh.vertices[:, :2] - mesh.vertices[:, :2].min(axis=0)
    image = texture.bake(mesh.uv, mesh.faces, flat[:, 0] + 10 * flat[:, 1], 64)
    centre = (np.arange(64) + 0.5) / 64
    np.testing.assert_allclose(image, centre[None] + 10 * centre[::-1, None], atol=1e-9)


def test_texture_coordinates_follow_welding_repair_reorientation_and_reordering(tmp_path):
    mesh = square_with_map(4)
    lines = [f"v {x} {y} {z}" for x, y, z in mesh.vertices]
    lines += [f"vt {u} {v}" for u, v in mesh.uv.reshape(-1, 2)]
    # Every second face is reversed, and the last face repeats a corner.
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


def torus_with_map(n_major=60, n_minor=30):
    """A torus whose texture coordinates are its angles; at the seams they exceed one."""
    mesh = ltl.shapes.torus(n_major=n_major, n_minor=n_minor)
    x, y, z = mesh.vertices.T
    angles = np.stack([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y) - 2)], axis=1) / (2 * np.pi) % 1
    uv = angles[mesh.faces]
    uv += uv.max(axis=1, keepdims=True) - uv > 0.5
    return ltl.Mesh(mesh.vertices, mesh.faces, uv=uv)


def test_a_textured_mesh_opens_with_the_field_in_its_texture(tmp_path):
    pytest.importorskip("imageio")
    mesh = torus_with_map()
    u = np.sin(4 * mesh.vertices[:, 0])
    image = texture.bake(mesh.uv, mesh.faces, u, 512)
    assert np.isfinite(image).all()
    flat = colors.vertex_colors(image.ravel(), (-1.0, 1.0), "gray")[:, :3].reshape(512, 512, 3)
    written = texture.write_textured_obj(tmp_path / "torus.obj", mesh.vertices, mesh.faces, mesh.uv, flat)
    assert [file.suffix for file in written] == [".obj", ".mtl", ".png"]
    opened = trimesh.load(tmp_path / "torus.obj", force="mesh", process=False)
    centres = opened.visual.uv[opened.faces].mean(axis=1)
    values = np.asarray(opened.visual.material.to_color(centres))[:, 0] / 255 * 2 - 1
    expected = np.sin(4 * opened.vertices[opened.faces][..., 0]).mean(axis=1)
    assert np.abs(values - expected).mean() < 0.03
    np.testing.assert_allclose(ltl.load_mesh(tmp_path / "torus.obj").uv, mesh.uv, atol=1e-8)


def test_baking_without_a_map_or_with_wrong_shapes_raises():
    mesh = ltl.shapes.icosphere(1)
    with pytest.raises(ValueError, match="no UV map"):
        texture.bake(mesh.uv, mesh.faces, np.zeros(mesh.num_vertices))
    sheet = square_with_map(2)
    with pytest.raises(ValueError, match="Expected values"):
        texture.bake(sheet.uv, sheet.faces, np.zeros(2))
    with pytest.raises(ValueError, match="Expected uv"):
        texture.bake(sheet.uv[1:], sheet.faces, np.zeros(sheet.num_vertices))


def test_a_map_that_is_tiled_or_not_finite_is_rejected():
    sheet = square_with_map(4)
    values = np.zeros(sheet.num_vertices)
    with pytest.raises(ValueError, match="found others in face 0"):
        texture.bake(np.full_like(sheet.uv, np.inf), sheet.faces, values)
    with pytest.raises(ValueError, match="The map is tiled"):
        texture.bake(1e6 * sheet.uv, sheet.faces, values)
    with pytest.raises(ValueError, match="16 images in all"):
        texture.bake(4 * sheet.uv, sheet.faces, values)


def test_texture_coordinates_are_periodic():
    sheet = square_with_map(4)
    values = sheet.vertices[:, 0]
    np.testing.assert_allclose(
        texture.bake(sheet.uv + 1000, sheet.faces, values, 64),
        texture.bake(sheet.uv, sheet.faces, values, 64),
        atol=1e-9,
    )


def test_the_names_inside_an_obj_are_ascii(tmp_path):
    pytest.importorskip("imageio")
    sheet = square_with_map(2)
    image = np.zeros((4, 4, 3), np.uint8)
    texture.write_textured_obj(tmp_path / "塗.obj", sheet.vertices, sheet.faces, sheet.uv, image)
    opened = trimesh.load(tmp_path / "塗.obj", force="mesh")
    assert opened.visual.material.image.size == (4, 4)


def test_the_relief_of_a_field_displaces_the_surface():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(2))
    z = np.asarray(surface.vertices[:, 2])
    raised = ltl.imaging.displaced(surface, z, 0.5)
    np.testing.assert_allclose(np.linalg.norm(raised.vertices, axis=1).max(), 1.5, atol=1e-3)
    with pytest.raises(ValueError, match="finite values"):
        ltl.imaging.displaced(surface, np.full_like(z, np.nan))


def test_displacement_follows_the_normals():
    mesh = ltl.shapes.icosphere(2)
    moved = texture.displaced(mesh.vertices, mesh.vertices, mesh.vertices[:, 2], 0.5)
    height = np.linalg.norm(moved, axis=1)
    np.testing.assert_allclose(height, 1 + 0.25 * (1 + mesh.vertices[:, 2] / mesh.vertices[:, 2].max()), atol=1e-9)


def test_a_run_on_a_mesh_with_a_map_writes_its_texture(tmp_path):
    pytest.importorskip("pyvista")
    mesh = torus_with_map(24, 12)
    texture.write_textured_obj(
        tmp_path / "donut.obj", mesh.vertices, mesh.faces, mesh.uv, np.zeros((4, 4, 3), np.uint8)
    )
    arguments = ["--mesh", str(tmp_path / "donut.obj"), "--t1", "0.1", "--frames", "1", "--out", str(tmp_path / "out")]
    assert main(["run", "allen-cahn", *arguments]) == 0
    opened = trimesh.load(tmp_path / "out" / "textured" / "allen-cahn.obj", force="mesh")
    assert opened.visual.material.image.size == (1024, 1024)


def unwrapped(path, mesh):
    """Write an OBJ whose texture coordinates put each face into a cell of its own."""
    side = int(np.ceil(np.sqrt(mesh.num_faces)))
    column, row = np.arange(mesh.num_faces) % side, np.arange(mesh.num_faces) // side
    corner = np.array([[0.15, 0.15], [0.85, 0.15], [0.15, 0.85]])
    uv = (np.stack([column, row], axis=1)[:, None] + corner) / side
    texture.write_textured_obj(path, mesh.vertices, mesh.faces, uv, np.zeros((4, 4, 3), np.uint8))


# A scenario for each surface, and the settings that differ from its defaults.
SURFACES = {
    "spot": ("turing-ridges", ["--t1", "20", "--set", 'kinetics.decay="11 + 0.1*noise"']),
    "bunny": ("barrio-spots", ["--set", 'diffusivity.u="0.516*0.006"', "--set", "diffusivity.v=0.006"]),
    "disk": ("fitzhugh-nagumo", ["--set", "diffusivity.u=5e-4", "--set", "diffusivity.v=5e-2"]),
    "torus": ("spirals", ["--t1", "10", "--set", "mesh.n_major=96", "--set", "mesh.n_minor=48"]),
    "hand": ("rings", ["--t1", "600", "--set", 'diffusivity.u="0.516*0.012"', "--set", "diffusivity.v=0.012"]),
}
FILES = {"spot": "spot.obj", "bunny": "bunny_closed.obj", "hand": "hand_open.obj"}


@pytest.mark.slow
@pytest.mark.parametrize("name", SURFACES)
def test_the_pattern_of_a_scenario_appears_in_its_picture_and_files(name, tmp_path, real_mesh):
    pytest.importorskip("pyvista")
    kind, changes = SURFACES[name]
    mesh = name
    if name in FILES:
        mesh = str(tmp_path / f"{name}.obj")
        unwrapped(tmp_path / f"{name}.obj", ltl.load_mesh(real_mesh(FILES[name])))
    if name == "disk":
        changes = [*changes, "--set", "mesh.rings=36"]
    out = tmp_path / "out"
    assert main(["run", kind, "--mesh", mesh, "--frames", "2", *changes, "--out", str(out)]) == 0

    # The picture shows a surface on a white background, with colours from both ends of the colour map.
    picture = np.asarray(Image.open(out / f"{kind}.png"))[..., :3].astype(float)
    surface = (picture < 250).any(axis=2)
    assert 0.1 < surface.mean() < 0.7
    brightness = picture.mean(axis=2)[surface]
    assert np.ptp(np.quantile(brightness, [0.05, 0.95])) > 50

    shown = tomllib.loads(scenario.library()[kind]).get("output", {}).get("show", "u")
    columns = pyvista_columns(out / "series" / f"{kind}_0002.vtp")
    u = columns[shown]
    assert u.std() > 0.1 * np.ptp(u)
    (glb,) = trimesh.load(out / f"{kind}.glb", process=False).geometry.values()
    colours = np.asarray(glb.visual.vertex_attributes["color"])
    assert len(np.unique(colours[:, :3], axis=0)) > 100
    ply = ltl.load_mesh(out / f"{kind}.ply")
    np.testing.assert_array_equal(ply.faces, glb.faces)
    if name not in FILES:
        return
    opened = trimesh.load(out / "textured" / f"{kind}.obj", force="mesh", process=False)
    # At the centre of each face, the texture has the mean colour of the vertices.
    centres = opened.visual.uv[opened.faces].mean(axis=1)
    baked = np.asarray(opened.visual.material.to_color(centres))[:, :3] / 255.0
    screen = trimesh.load(out / f"{kind}.ply", process=False).visual.vertex_colors[:, :3] / 255.0
    means = screen[glb.faces].mean(axis=1)
    is_even = np.ptp(screen[glb.faces], axis=1).max(axis=1) < 0.1
    assert is_even.sum() > 100
    assert np.abs(baked - means)[is_even].mean() < 0.05


def pyvista_columns(path):
    import pyvista

    return dict(pyvista.read(path).point_data)
