"""Writers of mesh files: VTK and time series for ParaView, PLY and GLB with colours, OBJ, STL and 3MF."""

import base64
import json
import struct
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from .._mesh import far_middle


def write_ply(
    path: Path,
    vertices: np.ndarray,
    faces: np.ndarray,
    colors: np.ndarray,
    fields: Mapping[str, np.ndarray] | None = None,
) -> None:
    """Write a binary PLY with a colour for each vertex.

    Positions are single-precision, which all programs read. They are double-precision for a shape far from the origin.

    Args:
        path: path of the file.
        vertices: (V, 3) positions.
        faces: (F, 3) vertex indices.
        colors: (V, 3) or (V, 4) colours, unsigned bytes.
        fields: further columns (V,) or (V, C) by name; the columns of the latter are named ``name_0``, ``name_1``, ...
    """
    size, name = ("f8", "double") if np.any(far_middle(vertices)) else ("f4", "float")
    channels = ("red", "green", "blue", "alpha")[: colors.shape[1]]
    columns = scalar_columns(fields or {})
    if reserved := {"x", "y", "z", *channels} & columns.keys():
        raise ValueError(f"PLY reserves the name {min(reserved)!r} for positions or colours. Rename the field.")
    kinds = {name: _ply_type(values.dtype) for name, values in columns.items()}
    points = np.zeros(
        len(vertices),
        [
            ("position", f"<{size}", 3),
            ("color", "u1", len(channels)),
            *((f"field {name}", f"<{kind}") for name, kind in kinds.items()),
        ],
    )
    points["position"], points["color"] = vertices, colors
    for column, values in columns.items():
        points[f"field {column}"] = values
    triangles = np.zeros(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
    triangles["count"], triangles["corners"] = 3, faces
    header = [
        "ply", "format binary_little_endian 1.0", f"element vertex {len(points)}",
        *(f"property {name} {axis}" for axis in "xyz"), *(f"property uchar {channel}" for channel in channels),
        *(f"property {_PLY_TYPES[kind]} {column}" for column, kind in kinds.items()),
        f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header\n",
    ]  # fmt: skip
    path.write_bytes("\n".join(header).encode("ascii") + points.tobytes() + triangles.tobytes())


_PLY_TYPES = {
    "i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float",
    "f8": "double",
}  # fmt: skip


def _ply_type(dtype: np.dtype) -> str:
    """The NumPy type code of a column; 64-bit integers become doubles, because PLY does not support them."""
    kind = "u1" if dtype.kind == "b" else dtype.str[1:]
    return kind if kind in _PLY_TYPES else "f8"


def scalar_columns(fields: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Fields (V,) and (V, C) as columns (V,); the columns of the latter are named ``name_0``, ``name_1``, ...

    Raises:
        ValueError: two columns have the same name, or a name has spaces or characters beyond ASCII, which files of
            columns cannot store.
    """
    columns: dict[str, np.ndarray] = {}
    for name, values in fields.items():
        if not name.isascii() or " " in name or "end_header" in name:
            raise ValueError(f"Expected field names in ASCII and without spaces, found {name!r}. Rename the field.")
        parts = {name: values} if values.ndim == 1 else {f"{name}_{i}": part for i, part in enumerate(values.T)}
        if duplicates := parts.keys() & columns.keys():
            raise ValueError(f"Two columns would have the name {min(duplicates)!r}. Rename the fields.")
        columns |= parts
    return columns


def write_stl(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Write a binary STL in float32; positions of a shape far from the origin are relative to its middle."""
    vertices = vertices - far_middle(vertices)
    triangles = np.zeros(len(faces), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    triangles["normal"] = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
    triangles["corners"] = corners
    path.write_bytes(b"ltljax".ljust(80) + struct.pack("<I", len(faces)) + triangles.tobytes())


def write_3mf(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Write a 3MF file for 3D printing, with the millimetre as unit.

    Source: 3D Manufacturing Format, core specification 1.3, chapters 2 (the package) and 4 (meshes).
    """
    points = "".join(f'<vertex x="{x:.17g}" y="{y:.17g}" z="{z:.17g}"/>' for x, y, z in vertices.tolist())
    triangles = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in faces.tolist())
    head = '<?xml version="1.0" encoding="UTF-8"?>\n'
    schema = "http://schemas.openxmlformats.org/package/2006"
    maker = "http://schemas.microsoft.com/3dmanufacturing"
    parts = {
        "[Content_Types].xml": f'<Types xmlns="{schema}/content-types">'
        '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
        '<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>',
        "_rels/.rels": f'<Relationships xmlns="{schema}/relationships">'
        f'<Relationship Target="/3D/3dmodel.model" Id="r0" Type="{maker}/2013/01/3dmodel"/></Relationships>',
        "3D/3dmodel.model": f'<model unit="millimeter" xmlns="{maker}/core/2015/02">'
        '<resources><object id="1" type="model"><mesh>'
        f"<vertices>{points}</vertices><triangles>{triangles}</triangles></mesh></object></resources>"
        '<build><item objectid="1"/></build></model>',
    }
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in parts.items():
            archive.writestr(name, head + text)


def write_obj(
    path: Path,
    vertices: np.ndarray,
    faces: np.ndarray,
    uv: np.ndarray | None = None,
    material: str | None = None,
    colors: np.ndarray | None = None,
) -> None:
    """Write an OBJ.

    Args:
        path: path of the file.
        vertices: (V, 3) positions.
        faces: (F, 3) vertex indices.
        uv: (F, 3, 2) texture coordinates of the corners of every face.
        material: name of the MTL file that defines the material ``surface`` of the faces.
        colors: (V, 3) vertex colours from 0 to 1, which not all programs read.
    """
    lines = [] if material is None else [f"mtllib {material}", "usemtl surface"]
    rows = vertices if colors is None else np.concatenate([vertices, colors], axis=1)
    lines += ["v " + " ".join(f"{number:.12g}" for number in row) for row in rows.tolist()]
    if uv is None:
        lines += ["f {} {} {}".format(*face) for face in (faces + 1).tolist()]
    else:
        unique_uv, index = np.unique(uv.reshape(-1, 2), axis=0, return_inverse=True)
        corners = np.stack([faces + 1, index.reshape(faces.shape) + 1], axis=2)
        lines += [f"vt {u:.9g} {v:.9g}" for u, v in unique_uv.tolist()]
        lines += ["f " + " ".join(f"{vertex}/{texture}" for vertex, texture in face) for face in corners.tolist()]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def write_glb(
    path: Path, vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray, normals: np.ndarray | None = None
) -> None:
    """Write a binary glTF with a colour for each vertex, which browsers and Blender open.

    Positions of a shape far from the origin are relative to its middle, and the node has the corresponding translation.

    Args:
        path: path of the file.
        vertices: (V, 3) positions.
        faces: (F, 3) vertex indices.
        colors: (V, 4) sRGB colours, unsigned bytes.
        normals: (V, 3) normals for smooth shading.

    Source: glTF 2.0 specification, sections 3.7 (attributes) and 4.4 (the container).
    """
    middle = far_middle(vertices)
    # glTF stores linear colours. The conversion from sRGB is defined in IEC 61966-2-1.
    srgb = colors[:, :3] / 255.0
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    parts = {
        "POSITION": np.asarray(vertices - middle, "<f4"),
        "COLOR_0": np.concatenate([linear, colors[:, 3:] / 255.0], axis=1).astype("<f4"),
    }
    if normals is not None:
        parts["NORMAL"] = np.asarray(normals, "<f4")
    data = [*parts.values(), np.asarray(faces, "<u4").ravel()]
    ends = np.cumsum([part.nbytes for part in data])
    views = [
        dict(buffer=0, byteOffset=int(end) - part.nbytes, byteLength=part.nbytes)
        for end, part in zip(ends, data, strict=True)
    ]
    kinds = [f"VEC{part.shape[1]}" for part in parts.values()] + ["SCALAR"]
    accessors: list[dict] = [
        dict(bufferView=index, componentType=5126 if part.dtype.kind == "f" else 5125, count=len(part), type=kind)
        for index, (part, kind) in enumerate(zip(data, kinds, strict=True))
    ]
    accessors[0] |= dict(min=data[0].min(axis=0).tolist(), max=data[0].max(axis=0).tolist())
    appearance = dict(baseColorFactor=[1, 1, 1, 1], metallicFactor=0, roughnessFactor=0.9)
    primitive = dict(attributes={name: i for i, name in enumerate(parts)}, indices=len(parts), material=0)
    tree = dict(
        asset=dict(version="2.0", generator="ltljax"),
        scene=0,
        scenes=[dict(nodes=[0])],
        nodes=[dict(mesh=0, **(dict(translation=middle.tolist()) if middle.any() else {}))],
        materials=[dict(pbrMetallicRoughness=appearance, doubleSided=True)],
        meshes=[dict(primitives=[primitive])],
        accessors=accessors,
        bufferViews=views,
        buffers=[dict(byteLength=int(ends[-1]))],
    )  # fmt: skip
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(part.tobytes() for part in data)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    path.write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks)


def write_vtp(
    path: Path,
    vertices: np.ndarray,
    faces: np.ndarray,
    fields: Mapping[str, np.ndarray],
    unstructured: bool = False,
) -> None:
    """Write a VTK PolyData file (``.vtp``) or unstructured grid (``.vtu``) in XML with compressed arrays.

    This does not need VTK.

    Args:
        path: path of the file.
        vertices: (V, 3) positions.
        faces: (F, 3) vertex indices.
        fields: (V,) or (V, C) fields by name.
        unstructured: whether to write an unstructured grid.

    Source: VTK file formats, section XML.
    """
    offsets = 3 * np.arange(1, len(faces) + 1)
    point_data = "".join(_array(name, np.asarray(values)) for name, values in fields.items())
    cells = f"{_array('connectivity', faces.ravel().astype(np.int64))}{_array('offsets', offsets)}"
    if unstructured:
        kind, counts = "UnstructuredGrid", f'NumberOfCells="{len(faces)}"'
        triangle = 5  # VTK's number for this type of cell
        cells = f"<Cells>\n{cells}{_array('types', np.full(len(faces), triangle, np.uint8))}</Cells>\n"
    else:
        kind = "PolyData"
        counts = f'NumberOfPolys="{len(faces)}" NumberOfVerts="0" NumberOfLines="0" NumberOfStrips="0"'
        cells = f"<Polys>\n{cells}</Polys>\n"
    path.write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<VTKFile type="{kind}" version="1.0" byte_order="LittleEndian" header_type="UInt64" '
        'compressor="vtkZLibDataCompressor">\n'
        f'<{kind}><Piece NumberOfPoints="{len(vertices)}" {counts}>\n'
        f"<PointData>\n{point_data}</PointData>\n"
        f"<Points>\n{_array('Points', vertices)}</Points>\n"
        f"{cells}"
        f"</Piece></{kind}>\n</VTKFile>\n",
        encoding="utf-8",
    )


def write_series(path: Path, times: np.ndarray, files: list[str]) -> None:
    """Write a ParaView collection (``.pvd``) of times and files; file names are relative to the collection."""
    entries = "".join(
        f'<DataSet timestep="{time:.17g}" file={quoteattr(file)}/>\n' for time, file in zip(times, files, strict=True)
    )
    path.write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<VTKFile type="Collection" version="0.1" byte_order="LittleEndian">\n'
        f"<Collection>\n{entries}</Collection>\n</VTKFile>\n",
        encoding="utf-8",
    )


_VTK_TYPES = {
    "f4": "Float32", "f8": "Float64", "i1": "Int8", "u1": "UInt8", "i2": "Int16", "u2": "UInt16", "i4": "Int32",
    "u4": "UInt32", "i8": "Int64", "u8": "UInt64",
}  # fmt: skip


def _array(name: str, values: np.ndarray) -> str:
    values = values.astype(np.uint8) if values.dtype.kind == "b" else values
    values = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
    kind = _VTK_TYPES[values.dtype.str[1:]]
    components = values.shape[1] if values.ndim == 2 else 1
    compressed = zlib.compress(values.tobytes(), level=4)
    # The number of blocks, the size of a block, the size of the last partial block, and the compressed size of each
    # block. The header is encoded separately from the block.
    header = np.array([1, values.nbytes, 0, len(compressed)], "<u8").tobytes()
    data = (base64.b64encode(header) + base64.b64encode(compressed)).decode("ascii")
    return (
        f'<DataArray type="{kind}" Name={quoteattr(name)} NumberOfComponents="{components}" format="binary">'
        f"{data}</DataArray>\n"
    )
