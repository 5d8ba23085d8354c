"""The points of a model as PLY files, in double precision, and models moved to where single precision is enough."""

from pathlib import Path

import numpy as np
import pycolmap

FAR_AWAY = 100.0
"""A model that is farther from the origin than this many of its own extents loses digits in single precision, in which
programs compute that train scenes: UTM coordinates keep half a metre."""

VERTEX = np.dtype([*((axis, "<f8") for axis in "xyz"), *((colour, "u1") for colour in ("red", "green", "blue"))])


def write_ply(path: Path, model: pycolmap.Reconstruction) -> None:
    """The points and their colours in the order of their ids, as a binary PLY file of doubles."""
    points = [model.points3D[point_id] for point_id in sorted(model.points3D)]
    vertices = np.array([(*point.xyz, *point.color) for point in points], VERTEX)
    types = {"<f8": "double", "|u1": "uchar"}
    properties = [f"property {types[VERTEX[name].str]} {name}" for name in VERTEX.names or ()]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *properties, "end_header"]
    with open(path, "wb") as file:
        file.write("\n".join(header).encode() + b"\n" + vertices.tobytes())


def move_to_origin(model: pycolmap.Reconstruction) -> tuple[float, float, float] | None:
    """Move a model that is far from the origin, see FAR_AWAY, to it.

    Returns what is to be added to its coordinates to have them back, in round numbers; None where it stays.
    """
    centres = np.array([image.projection_center() for image in model.images.values()]).reshape(-1, 3)
    if not len(centres):
        return None
    middle, extent = np.median(centres, axis=0), float(np.linalg.norm(np.ptp(centres, axis=0)))
    if extent == 0 or np.linalg.norm(middle) <= FAR_AWAY * extent:
        return None
    unit = 10.0 ** np.floor(np.log10(extent))
    offset = np.round(middle / unit) * unit
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), -offset))
    x, y, z = offset.tolist()
    return x, y, z
