"""Commands on mesh files as a person uses them, and images on the UV map of a surface."""

import json

import numpy as np
import pytest
import trimesh

import ltljax as ltl
from ltljax import imaging
from ltljax._mesh.columns import read_colors, read_columns
from ltljax._output import files, pictures, texture
from ltljax.app import process
from ltljax.app.cli import main
from ltljax.app.process import images, results, subject

COLORS = np.array([[0.9, 0.6, 0.2], [0.2, 0.4, 0.8]])
NOISE = 0.1


@pytest.fixture(scope="module")
def sphere():
    return ltl.shapes.jittered_sphere(3, 0.3, seed=0)


@pytest.fixture(scope="module")
def noisy(sphere):
    """A field of two colours, and the same field with noise."""
    clean = COLORS[(sphere.vertices[:, 2] > 0.2).astype(int)]
    return clean, np.clip(clean + NOISE * np.random.default_rng(0).normal(size=clean.shape), 0, 1)


@pytest.fixture
def ball(tmp_path, sphere, noisy):
    """A mesh file with noisy colours."""
    path = tmp_path / "ball.ply"
    files.write_ply(path, sphere.vertices, sphere.faces, np.round(255 * noisy[1]).astype(np.uint8))
    return path


@pytest.fixture
def undrawn(monkeypatch):
    monkeypatch.setattr(pictures, "can_draw", lambda: False)


def mapped(n=24):
    """A square with a UV map of two charts that lie apart in the image."""
    plane = ltl.shapes.square(n=n)
    vertices, faces = plane.vertices, plane.faces
    places = vertices[:, :2][faces]
    is_right = places[:, :, 0].mean(axis=1) > 0.5
    uv = 0.9 * places + np.where(is_right, 0.08, 0.02)[:, None, None] * [1, 0] + [0, 0.05]
    return ltl.Mesh(vertices, faces, uv=uv)


def decibels(u, clean):
    return -10 * np.log10(np.mean((u - clean) ** 2))


def fails(capsys, *arguments):
    """The exit code and the standard error of a command that fails, which is one line."""
    try:
        code = main([str(argument) for argument in arguments])
    except SystemExit as stop:
        code = stop.code
    error = capsys.readouterr().err
    assert len(error.strip().splitlines()) == 1
    assert "Traceback" not in error
    return code, error


def call(*arguments):
    assert main([str(argument) for argument in arguments]) == 0


def test_a_smooth_function_is_the_same_to_two_percent_after_baking_and_sampling():
    mesh = mapped()
    x, y, _ = mesh.vertices.T
    u = np.stack([np.sin(3 * x) * np.cos(2 * y), x * y], axis=1)
    errors = [np.abs(imaging.from_texture(mesh, imaging.to_texture(mesh, u, size)) - u).max() for size in (256, 1024)]
    assert errors[0] < 0.02
    assert errors[1] < 0.35 * errors[0]
    image = imaging.to_texture(mesh, (u[:, 1]), 256, fill=1.0, as_bytes=True)
    assert image.dtype == np.uint8
    assert image[0, 0] == 255
    assert np.abs(imaging.from_texture(mesh, image) - u[:, 1]).max() < 0.01
    reordered = mesh.reordered()
    sampled = imaging.from_texture(reordered, image)[reordered.source_order]
    np.testing.assert_allclose(sampled, imaging.from_texture(mesh, image), atol=1e-14)


def test_an_image_is_read_with_v_upwards_and_between_pixel_centres():
    mesh = mapped(4)
    rows = np.arange(8.0)[::-1, None] * np.ones((1, 6))
    places = np.zeros(mesh.num_vertices)
    places[mesh.faces] = mesh.uv[..., 1]
    np.testing.assert_allclose(imaging.from_texture(mesh, rows), np.clip(8 * places - 0.5, 0, 7), atol=1e-12)
    with pytest.raises(ValueError, match=r"no UV map.*project_image"):
        imaging.from_texture(ltl.shapes.icosphere(1), rows)
    with pytest.raises(ValueError, match=r"found \(3,\)"):
        imaging.from_texture(mesh, np.zeros(3))
    with pytest.raises(ValueError, match="Convert them"):
        imaging.from_texture(mesh, np.zeros((3, 3), int))


def test_a_projected_image_covers_the_box_and_meets_the_side_that_faces_it(sphere):
    # The first row is at the top.
    row, column = np.meshgrid(np.arange(64), np.arange(32), indexing="ij")
    image = np.stack([(column + 0.5) / 32, 1 - (row + 0.5) / 64], axis=2)
    values, faces_it = imaging.project_image(sphere, image, direction=(0, 0, 1))
    projected = sphere.vertices[:, :2]
    expected = (projected - projected.min(axis=0)) / np.ptp(projected, axis=0)
    inner = (np.abs(expected - 0.5) < 0.48).all(axis=1)
    np.testing.assert_allclose(values[inner], expected[inner], atol=1e-12)
    height = sphere.vertices[:, 2]
    assert faces_it[height > 0.15].all()
    assert not faces_it[height < -0.15].any()
    from_vertices, everywhere = imaging.project_image(sphere.vertices, image)
    np.testing.assert_array_equal(from_vertices, values)
    assert everywhere.all()
    with pytest.raises(ValueError, match="not along up"):
        imaging.project_image(sphere, image, direction=(0, 1, 0))


def test_colours_of_a_mesh_file_are_denoised_and_pictures_drawn(tmp_path, ball, sphere, noisy, capsys):
    if not pictures.can_draw():
        pytest.skip("pictures are not installed")
    out = tmp_path / "out"
    call("denoise", ball, "--out", out)
    assert {path.name for path in out.iterdir()} == {
        ".ltljax", "denoise.json", "denoise.ply", "denoise.vtp", "denoise-before.png", "denoise-after.png",
    }  # fmt: skip
    clean, before = noisy
    saved = trimesh.load(out / "denoise.ply", process=False)
    after = saved.visual.vertex_colors[:, :3] / 255
    assert decibels(after, clean) > decibels(before, clean) + 3
    np.testing.assert_allclose(saved.vertices, sphere.vertices, atol=1e-6)
    record = json.loads((out / "denoise.json").read_text())
    # The edge between the colours, and the clipping of colours at one, add a little to the estimate.
    assert record["measured"]["noise"] == pytest.approx(NOISE, rel=0.15)
    assert record["measured"]["removed_root_mean_square"] == pytest.approx(record["measured"]["noise"], rel=1e-3)
    printed = capsys.readouterr().out
    assert "the noise is estimated" in printed
    assert "denoise.vtp" in printed
    # The command may replace its own results.
    call("denoise", ball, "--out", out, "--strength", "0.05")


# The heat equation removes edges together with the noise.
@pytest.mark.parametrize(("method", "gain"), [("heat", 0.5), pytest.param("perona-malik", 2, marks=pytest.mark.slow)])
def test_numbers_of_a_file_are_denoised_until_the_noise_is_gone(tmp_path, sphere, noisy, method, gain, undrawn, capsys):
    np.savez(tmp_path / "data.npz", u=noisy[1][:, 0], other=np.zeros(sphere.num_vertices))
    path, out = tmp_path / "ball.obj", tmp_path / "out"
    files.write_obj(path, sphere.vertices, sphere.faces)
    named = ("--data", tmp_path / "data.npz", "--name", "u", "--noise", NOISE)
    call("denoise", path, *named, "--method", method, "--out", out)
    assert json.loads((out / "denoise.json").read_text())["measured"]["removed_root_mean_square"] == pytest.approx(
        NOISE, rel=0.02
    )
    assert 'pictures need the extra "viz"' in capsys.readouterr().out
    assert not list(out.glob("*.png"))
    pytest.importorskip("pyvista")
    columns = read_columns(out / "denoise.vtp")
    np.testing.assert_allclose(columns["before"], noisy[1][:, 0], atol=1e-12)
    np.testing.assert_allclose(columns["before"] - columns["after"], columns["removed"], atol=1e-12)
    assert decibels(columns["after"], noisy[0][:, 0]) > decibels(columns["before"], noisy[0][:, 0]) + gain


def test_an_image_on_a_uv_map_comes_back_as_a_textured_mesh(tmp_path):
    iio = pytest.importorskip("imageio.v3")
    if not pictures.can_draw():
        pytest.skip("pictures are not installed")
    mesh = mapped()
    path, out = tmp_path / "plane.obj", tmp_path / "out"
    files.write_obj(path, mesh.vertices, mesh.faces, mesh.uv)
    clean = COLORS[(mesh.vertices[:, 0] > 0.4).astype(int)]
    noisy = clean + NOISE * np.random.default_rng(0).normal(size=clean.shape)
    iio.imwrite(tmp_path / "noisy.png", imaging.to_texture(mesh, noisy, 512, as_bytes=True))
    call("denoise", path, "--image", tmp_path / "noisy.png", "--out", out)
    written = ltl.load_mesh(out / "textured" / "denoise.obj")
    after = imaging.from_texture(written, iio.imread(out / "textured" / "denoise.png"))
    assert decibels(after, clean) > decibels(noisy, clean) + 4
    # A file that was changed since is not replaced.
    (out / "denoise.json").write_text("{}")
    assert main(["denoise", str(path), "--image", str(tmp_path / "noisy.png"), "--out", str(out)]) == 2


@pytest.mark.parametrize(
    ("method", "more"),
    [
        pytest.param("mean-curvature-flow", ["--keep-volume", "--steps", "3"], marks=pytest.mark.slow),
        ("fair", []),
        ("filter_normals", ["--steps", "3"]),
    ],
)
def test_a_smoothed_mesh_keeps_its_faces_and_its_kind_of_file(tmp_path, sphere, noisy, method, more, undrawn):
    rough = sphere.vertices + 0.15 * sphere.mesh_size * np.random.default_rng(1).normal(size=sphere.vertices.shape)
    kind = "obj" if method == "fair" else "ply"
    path, out = tmp_path / f"rough.{kind}", tmp_path / "out"
    if kind == "obj":
        files.write_obj(path, rough, sphere.faces)
    else:
        files.write_ply(path, rough, sphere.faces, np.round(255 * noisy[1]).astype(np.uint8))
    call("smooth", path, "--method", method, *more, "--out", out)
    written = ltl.load_mesh(out / f"smooth.{kind}")
    np.testing.assert_array_equal(written.faces, sphere.faces)
    roughness = [np.std(np.linalg.norm(x, axis=1)) for x in (rough, written.vertices)]
    assert roughness[1] < 0.75 * roughness[0]
    measured = json.loads((out / "smooth.json").read_text())["measured"]
    if method == "mean-curvature-flow":
        assert measured["volume_after"] == pytest.approx(measured["volume_before"], rel=1e-6)
        colors = trimesh.load(out / "smooth.ply", process=False).visual.vertex_colors[:, :3]
        np.testing.assert_array_equal(colors, np.round(255 * noisy[1]).astype(np.uint8))


def test_curvature_and_distance_of_a_sphere_are_written_in_the_order_of_the_file(tmp_path, undrawn):
    pytest.importorskip("pyvista")
    sphere = ltl.shapes.icosphere(3)
    order = np.random.default_rng(0).permutation(sphere.num_vertices)
    path, out = tmp_path / "shuffled.obj", tmp_path / "out"
    files.write_obj(path, sphere.vertices[order], np.argsort(order)[sphere.faces])
    call("curvature", path, "--out", out)
    columns = read_columns(out / "curvature.vtp")
    np.testing.assert_allclose(columns["mean"], 1, atol=0.05)
    np.testing.assert_allclose(columns["gauss"], 1, atol=0.1)
    assert {"largest", "smallest", "ridge", "valley", "shape_index"} <= columns.keys()
    call("distance", path, "--from", 7, "--out", out)
    exact = np.arccos(np.clip(sphere.vertices[order] @ sphere.vertices[order[7]], -1, 1))
    np.testing.assert_allclose(read_columns(out / "distance.vtp")["distance"], exact, atol=0.15)
    measured = json.loads((out / "distance.json").read_text())["measured"]
    assert measured["largest_distance"] == pytest.approx(np.pi, abs=0.15)
    assert measured["width_of_a_band"] == 0.2


@pytest.mark.parametrize(
    "field", ["cross", *(pytest.param(field, marks=pytest.mark.slow) for field in ("smallest", "rotation"))]
)
def test_lines_of_a_field_are_drawn(tmp_path, sphere, field):
    if not pictures.can_draw():
        pytest.skip("pictures are not installed")
    out, egg = tmp_path / field, tmp_path / "egg.obj"
    files.write_obj(egg, sphere.vertices * [1, 1.5, 0.8], sphere.faces)
    call("lic", egg, "--field", field, "--resolution", "64", "--out", out)
    assert {path.name for path in out.iterdir()} == {".ltljax", "lic.json", "lic.ply", "lic.vtp", "lic.png"}
    image = pytest.importorskip("imageio.v3").imread(out / "lic.png")
    assert image.shape == (64, 128)
    assert image.std() > 20


def test_no_file_of_the_user_is_replaced(tmp_path, ball, capsys, undrawn):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "curvature.ply").write_text("mine")
    code, error = fails(capsys, "curvature", ball, "--out", tmp_path / "out")
    assert code == 2
    assert "curvature.ply, which ltljax did not write" in error
    assert (tmp_path / "out" / "curvature.ply").read_text() == "mine"
    renamed = ball.rename(tmp_path / "smooth.ply")
    code, error = fails(capsys, "smooth", renamed, "--out", tmp_path)
    assert code == 2
    assert "which is read" in error


@pytest.mark.parametrize("kind", ["csv", "npz", "obj", "ply"])
def test_noisy_colours_above_one_are_not_taken_for_bytes(tmp_path, kind):
    noisy = np.random.default_rng(0).uniform(-0.1, 1.1, size=(50, 3))
    assert noisy.max() > 1
    assert noisy.min() < 0
    names = ("red", "green", "blue")
    bytes_ = np.round(255 * noisy.clip(0, 1)).astype(np.uint8)
    for values, expected in ((noisy, noisy), (bytes_, bytes_ / 255)):
        path = tmp_path / f"colors.{kind}"
        if kind == "csv":
            path.write_text("\n".join([",".join(names), *(",".join(map(str, row)) for row in values.tolist())]))
        elif kind == "npz":
            np.savez(path, **dict(zip(names, values.T, strict=True)))
        elif kind == "obj":
            path.write_text("\n".join("v 0 0 0 {} {} {}".format(*row) for row in values.tolist()))
        else:
            number = "uchar" if values is bytes_ else "double"
            head = ["ply", "format ascii 1.0", f"element vertex {len(values)}"]
            head += [*(f"property {number} {name}" for name in names), "end_header"]
            path.write_text("\n".join([*head, *(" ".join(map(str, row)) for row in values.tolist()), ""]))
        colors = images._column(path, None)[0] if kind in ("csv", "npz") else read_colors(path)
        np.testing.assert_allclose(colors, expected, atol=1e-12)


def test_vectors_by_name_keep_their_units(tmp_path):
    velocity = np.random.default_rng(0).normal(size=(50, 3))
    shades = np.random.default_rng(0).integers(0, 255, (50, 3))
    np.savez(tmp_path / "data.npz", velocity=10 * velocity, whole=np.round(1000 * velocity), shades=shades)
    for name, expected in dict(velocity=10 * velocity, whole=np.round(1000 * velocity), shades=shades / 255).items():
        np.testing.assert_array_equal(images._column(tmp_path / "data.npz", name)[0], expected)


def test_a_later_run_replaces_the_results_of_earlier_ones_and_nothing_else(tmp_path, ball, sphere, undrawn, capsys):
    out, plain = tmp_path / "out", tmp_path / "plain.obj"
    files.write_obj(plain, sphere.vertices, sphere.faces)
    fair = ("--method", "fair", "--out", out)
    call("smooth", ball, *fair)
    (out / "smooth.obj").write_text("mine")
    code, error = fails(capsys, "smooth", plain, *fair)
    assert code == 2
    assert "smooth.obj, which ltljax did not write" in error
    assert (out / "smooth.obj").read_text() == "mine"
    (out / "smooth.obj").unlink()
    call("smooth", plain, *fair)
    assert json.loads((out / "smooth.json").read_text())["files"] == ["smooth.obj", "smooth.vtp"]
    # The earlier results are gone.
    assert not (out / "smooth.ply").exists()
    call("smooth", ball, *fair)
    assert not (out / "smooth.obj").exists()


def test_an_interrupted_command_leaves_earlier_results_as_they_are(tmp_path, monkeypatch):
    mesh, out = mapped(4), tmp_path / "out"
    path = tmp_path / "plane.obj"
    files.write_obj(path, mesh.vertices, mesh.faces, mesh.uv)
    monkeypatch.setattr(pictures, "can_draw", lambda: True)

    def write(value):
        command = results.Results("denoise", subject.load(str(path), False), out, ())
        command.numbers({"u": np.full(mesh.num_vertices, value)})
        command.textured(np.zeros((4, 4, 3), np.uint8))
        command.finish({}, {})

    monkeypatch.setattr(texture, "write_textured_obj", lambda path, *_: path.write_text("texture"))
    write(1.0)
    before = {entry.name: entry.read_bytes() for entry in out.rglob("*") if entry.is_file()}

    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(texture, "write_textured_obj", stop)
    with pytest.raises(KeyboardInterrupt):
        write(2.0)
    assert {entry.name: entry.read_bytes() for entry in out.rglob("*") if entry.is_file()} == before


@pytest.mark.parametrize(
    ("command", "options", "expected"),
    [
        (process.denoise, dict(method="typo"), "method one of tv, heat, perona-malik, found 'typo'"),
        (process.denoise, dict(noise=-1.0), "noise to be positive"),
        (process.denoise, dict(noise=1.0, strength=1.0), "noise or strength, not both"),
        (process.smooth, dict(method="typo"), "method one of mean-curvature-flow, fair, filter-normals, found 'typo'"),
        (process.smooth, dict(time=0.0), "time to be positive and finite, found 0"),
        (process.smooth, dict(steps=0), "steps to be positive and finite, found 0"),
        (process.smooth, dict(method="fair", strength=0.0), "strength to be positive"),
        (process.lic, dict(field="typo"), "field one of smallest, largest, cross, rotation, found 'typo'"),
    ],
)
def test_options_from_python_are_checked_as_on_the_command_line(tmp_path, command, options, expected):
    with pytest.raises(ValueError, match=expected):
        command("sphere", tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("field", ["smallest", "largest"])
def test_a_sphere_has_no_directions_of_curvature(tmp_path, sphere, field, capsys):
    # Other programs write positions with six digits.
    path, out = tmp_path / "round.obj", tmp_path / "out"
    files.write_obj(path, np.round(sphere.vertices, 6), sphere.faces)
    code, error = fails(capsys, "lic", path, "--field", field, "--out", out)
    assert code == 2
    assert f"no direction of {field} curvature: the surface bends alike in all directions everywhere" in error
    assert "--field cross" in error
    assert not out.exists()


def test_colours_of_an_obj_are_kept_by_smoothing(tmp_path, sphere, noisy, undrawn):
    path, out = tmp_path / "painted.obj", tmp_path / "out"
    files.write_obj(path, sphere.vertices, sphere.faces, colors=noisy[1])
    call("smooth", path, "--method", "fair", "--out", out)
    np.testing.assert_allclose(read_colors(out / "smooth.obj"), noisy[1], atol=1e-8)
    np.testing.assert_array_equal(ltl.load_mesh(out / "smooth.obj").faces, sphere.faces)


def test_mistakes_are_one_line_and_leave_nothing_behind(tmp_path, ball, sphere, capsys, undrawn):
    plain, out = tmp_path / "plain.obj", tmp_path / "out"
    files.write_obj(plain, sphere.vertices, sphere.faces)
    (tmp_path / "image.png").write_text("")
    rows = "\n".join(f"{u},{v}" for u, v in np.random.default_rng(0).normal(size=(sphere.num_vertices, 2)))
    (tmp_path / "data.csv").write_text("u,v\n" + rows)
    (tmp_path / "few.csv").write_text("u\n1\n2\n")
    data = tmp_path / "data.csv"
    wrong = {
        "there is no file at": ["curvature", tmp_path / "none.obj"],
        "has no colours to denoise": ["denoise", plain],
        "sphere has no colours": ["denoise", "sphere"],
        "has no UV map": ["denoise", plain, "--image", tmp_path / "image.png"],
        "expected a column named w, found u, v": ["denoise", plain, "--data", data, "--name", "w"],
        "Choose by --name": ["denoise", plain, "--data", data],
        "give --data FILE too": ["denoise", ball, "--name", "u"],
        "expected 642 values": ["denoise", plain, "--data", tmp_path / "few.csv"],
        "none at": ["denoise", plain, "--data", tmp_path / "none.csv"],
        "explains all of": ["denoise", plain, "--data", data, "--name", "u", "--noise", "5"],
        "not allowed with argument": ["denoise", plain, "--noise", "1", "--strength", "1"],
        "found 642": ["distance", plain, "--from", "642"],
        "required: --from": ["distance", plain],
        "--time does not belong to --method fair": ["smooth", plain, "--method", "fair", "--time", "1"],
        "invalid choice": ["lic", plain, "--field", "magnetic"],
    }
    for expected, arguments in wrong.items():
        code, error = fails(capsys, *arguments, "--out", out)
        assert code == 2, expected
        assert expected in error
    code, error = fails(
        capsys, "denoise", plain, "--data", data, "--name", "u", "--noise", "5", "--method", "heat", "--out", out
    )
    assert code == 2
    assert "explains all of" in error
    assert not out.exists()


def test_old_names_of_methods_still_work(tmp_path, capsys):
    # The option --time does not belong to the method, so nothing is computed.
    assert main(["smooth", "sphere", "--method", "features", "--time", "1", "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert "the method features is now called filter-normals" in error
    assert "--time does not belong to --method filter-normals" in error
