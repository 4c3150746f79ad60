"""MuJoCo models: poses, footprints and heights of free bodies, from recorded states.

A recorded model names meshes on the disk of its recorder. Elements without influence on the kinematics are
removed before a model is compiled. MuJoCo itself never reads a file.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any, Final, NamedTuple
from xml.etree import ElementTree

import numpy as np

from spatial_replay.errors import LogError, importing
from spatial_replay.geometry.arrays import Floats, starts_from_counts
from spatial_replay.geometry.footprint import FootprintBatch
from spatial_replay.geometry.outline import normalise_polygons
from spatial_replay.logs.formats.episodes import Body

LARGEST_MODEL: Final = 2**24
"""Longest model, characters of XML."""
LARGEST_ASSET: Final = 2**27
"""Largest mesh, bytes."""
DEEPEST: Final = 200
"""Deepest nesting of elements."""
MOST_COPIES: Final = 10_000
"""Maximum number of copies of elements that a model may generate by `count`."""
RIM_CORNERS: Final = 32
"""Number of corners of each rim of a tilted cylinder."""
ELLIPSE_CORNERS: Final = 64
UPRIGHT_COSINE: Final = math.cos(math.radians(5.6))
"""Cosine of the largest tilt at which a cylinder is drawn as a rounded segment.

The segment is too long by at most 0.5 % of the radius.
"""

_UNUSED: Final = frozenset(
    [
        "actuator",
        "camera",
        "contact",
        "custom",
        "deformable",
        "equality",
        "extension",
        "hfield",
        "keyframe",
        "light",
        "material",
        "model",
        "plugin",
        "sensor",
        "size",
        "skin",
        "statistic",
        "tendon",
        "texture",
        "visual",
    ]
)
"""Elements that do not influence the poses of bodies, or that load code or files."""
_FOLDERS: Final = ("meshdir", "texturedir", "assetdir")
_LOST: Final = "spatial-replay lost mesh "
"""Name prefix of geoms whose mesh is missing."""


@dataclass(frozen=True, slots=True)
class _Geom:
    """A geom in the frame of its body: its type, size, position (3,), rotation (3, 3) and vertices (v, 3)."""

    kind: int
    size: Floats
    position: Floats
    rotation: Floats
    vertices: Floats


class SceneModel:
    """A compiled model.

    Attributes:
        names: names of the free bodies.
        nq, nv: lengths of qpos and qvel.
        remarks: remarks on meshes that are left out, and on mocap bodies.
    """

    def __init__(self, model: Any, place: str, remarks: Sequence[str]) -> None:
        with importing("models of MuJoCo need mujoco", extra="mujoco"):
            import mujoco
        self._mujoco, self._model, self._place = mujoco, model, place
        self.nq, self.nv = int(model.nq), int(model.nv)
        free_joints = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
        self._bodies: dict[str, int] = {
            model.body(body).name or f"body {body}": body for body in model.jnt_bodyid[free_joints].tolist()
        }
        self.names = tuple(self._bodies)
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        # poses in the default state give the geoms in the frames of their bodies
        self._geoms = {name: self._geoms_of(body, data) for name, body in self._bodies.items()}
        mocap_names = [model.body(body).name for body in np.flatnonzero(model.body_mocapid >= 0).tolist()]
        self.remarks = tuple(remarks)
        if mocap_names:
            self.remarks += (
                f"mocap bodies are not in the states of the model: {', '.join(mocap_names)}; name such goals"
                " by `features:`, from observations",
            )

    def _geoms_of(self, body: int, data: Any) -> tuple[_Geom, ...]:
        """Return the geoms of a body's footprint; () if the mesh of a geom is missing."""
        model, types = self._model, self._mujoco.mjtGeom
        geoms = np.flatnonzero(model.body_weldid[model.geom_bodyid] == body)
        geoms = geoms[~np.isin(model.geom_type[geoms], (types.mjGEOM_PLANE, types.mjGEOM_HFIELD))]
        # geoms for display count only if no geom collides
        collides = (model.geom_contype[geoms] != 0) | (model.geom_conaffinity[geoms] != 0)
        footprint_geoms = (geoms[collides] if collides.any() else geoms).tolist()
        if any(model.geom(index).name.startswith(_LOST) for index in footprint_geoms):
            return ()
        body_from_world = data.xmat[body].reshape(3, 3).T
        return tuple(
            _Geom(
                kind=int(model.geom_type[index]),
                size=model.geom_size[index].copy(),
                position=body_from_world @ (data.geom_xpos[index] - data.xpos[body]),
                rotation=body_from_world @ data.geom_xmat[index].reshape(3, 3),
                vertices=self._vertices_of(index),
            )
            for index in footprint_geoms
        )

    def _vertices_of(self, geom_index: int) -> Floats:
        """Return the vertices (v, 3) of a geom's mesh, or of its convex hull if MuJoCo computed one."""
        model = self._model
        mesh_index = int(model.geom_dataid[geom_index])
        if model.geom_type[geom_index] != self._mujoco.mjtGeom.mjGEOM_MESH or mesh_index < 0:
            return np.empty((0, 3))
        first_vertex, vertex_count = int(model.mesh_vertadr[mesh_index]), int(model.mesh_vertnum[mesh_index])
        vertices = np.asarray(model.mesh_vert[first_vertex : first_vertex + vertex_count], np.float64)
        graph = int(model.mesh_graphadr[mesh_index])
        if graph < 0:
            return vertices
        # a graph holds numvert, numface, vert_edgeadr[numvert], vert_globalid[numvert], edges and faces
        hull_count = int(model.mesh_graph[graph])
        return np.asarray(vertices[model.mesh_graph[graph + 2 + hull_count : graph + 2 + 2 * hull_count]])

    def states(self, states: Floats, place: str) -> tuple[Floats, list[Body]]:
        """Return times (n,), in seconds, and free bodies of states (n, 1 + nq + nv): time, qpos, qvel.

        Raises:
            LogError: states do not have 1 + nq + nv numbers, or the model has no free body.
        """
        expected_width = 1 + self.nq + self.nv
        if states.ndim != 2 or states.shape[1] != expected_width:
            raise LogError(
                f"{place} has the shape {states.shape}, but a state of {self._place} has"
                f" {expected_width} numbers: time, {self.nq} of qpos, {self.nv} of qvel;"
                " give the model that recorded these states"
            )
        return np.asarray(states[:, 0], np.float64), self.bodies(states[:, 1 : 1 + self.nq], place)

    def bodies(self, qpos: Floats, place: str) -> list[Body]:
        """Return the free bodies at positions (n, nq) of the joints.

        Raises:
            LogError: positions do not have nq numbers, or the model has no free body.
        """
        if qpos.ndim != 2 or qpos.shape[1] != self.nq:
            raise LogError(
                f"{place} has the shape {qpos.shape}, but {self._place} has {self.nq} numbers of qpos;"
                " give the model that recorded it"
            )
        if not self._bodies:
            raise LogError(f"{self._place} has no body with a free joint; name objects by `features:`")
        positions, quaternions = self._kinematics(np.ascontiguousarray(qpos, np.float64))
        return [
            Body(
                name,
                positions[:, body_index],
                quaternions[:, body_index][:, [1, 2, 3, 0]],
                footprints_of(self._geoms[name], positions[:, body_index], quaternions[:, body_index]),
            )
            for body_index, name in enumerate(self._bodies)
        ]

    def _kinematics(self, qpos: Floats) -> tuple[Floats, Floats]:
        """Return positions (n, b, 3) and quaternions (n, b, 4), w x y z; NaN where a state is not finite."""
        mujoco, model = self._mujoco, self._model
        data, body_indices = mujoco.MjData(model), list(self._bodies.values())
        positions = np.full((len(qpos), len(body_indices), 3), np.nan)
        quaternions = np.full((len(qpos), len(body_indices), 4), np.nan)
        state_kind = int(mujoco.mjtState.mjSTATE_QPOS)
        for row in np.flatnonzero(np.isfinite(qpos).all(axis=1)).tolist():
            mujoco.mj_setState(model, data, qpos[row], state_kind)
            mujoco.mj_kinematics(model, data)
            positions[row], quaternions[row] = data.xpos[body_indices], data.xquat[body_indices]
        return positions, quaternions


# ------------------------------------------------------------------------------------------------ footprints


def footprints_of(geoms: Sequence[_Geom], positions: Floats, quaternions: Floats) -> FootprintBatch | None:
    """Return the projections of a body's geoms onto the plane; None without geoms.

    Args:
        positions: (n, 3), positions of the body.
        quaternions: (n, 4), orientations of the body, w x y z.
    """
    if not geoms:
        return None
    is_finite = np.asarray(np.isfinite(np.hstack([positions, quaternions])).all(axis=1))
    rotations, centres = _rotations(quaternions[is_finite]), positions[is_finite]
    state_count = len(centres)
    projections = FootprintBatch.concatenate(
        [_projection(geom, centres + rotations @ geom.position, rotations @ geom.rotation) for geom in geoms]
    )
    # the order of the rows changes from (geom, state) to (state, geom)
    state_order = np.arange(len(geoms) * state_count).reshape(len(geoms), state_count).T.reshape(-1)
    sorted_projections = projections.select(state_order)
    merged = replace(
        sorted_projections,
        part_start=np.arange(state_count + 1, dtype=np.int64) * len(geoms),
        bottom=projections.bottom.reshape(len(geoms), state_count).min(axis=0),
        top=projections.top.reshape(len(geoms), state_count).max(axis=0),
    )
    if is_finite.all():
        return merged
    source_rows = np.where(is_finite, np.cumsum(is_finite) - 1, state_count)
    return FootprintBatch.concatenate([merged, FootprintBatch.unknown(1)]).select(source_rows)


def _rotations(quaternions: Floats) -> Floats:
    """Return the rotation matrices (n, 3, 3) of unit quaternions (n, 4), w x y z."""
    w, x, y, z = quaternions.T
    matrix_rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(matrix_rows).reshape(3, 3, -1), 2, 0)


def _projection(geom: _Geom, centres: Floats, turns: Floats) -> FootprintBatch:
    """Return n footprints of one part each: projections of a geom at centres (n, 3), rotated by (n, 3, 3)."""
    from mujoco import mjtGeom

    size, height = geom.size, centres[:, 2]
    axis = turns[:, :, 2]
    if geom.kind == mjtGeom.mjGEOM_SPHERE:
        return _hulls(centres[:, None, :2], size[0], height - size[0], height + size[0])
    if geom.kind == mjtGeom.mjGEOM_CAPSULE:
        half_height = size[0] + size[1] * np.abs(axis[:, 2])
        return _hulls(_ends(centres, axis * size[1]), size[0], height - half_height, height + half_height)
    if geom.kind == mjtGeom.mjGEOM_CYLINDER:
        return _cylinders(size, centres, turns)
    if geom.kind == mjtGeom.mjGEOM_ELLIPSOID:
        half_height = np.linalg.norm(turns[:, 2] * size, axis=1)
        outline = centres[:, None, :2] + _ellipses(turns[:, :2] * size)
        return _hulls(outline, 0.0, height - half_height, height + half_height)
    local_vertices = geom.vertices
    if geom.kind == mjtGeom.mjGEOM_BOX:
        local_vertices = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size
    points = centres[:, None] + local_vertices @ turns.transpose(0, 2, 1)
    return _hulls(points[..., :2], 0.0, points[..., 2].min(axis=1), points[..., 2].max(axis=1))


def _ends(centres: Floats, halves: Floats) -> Floats:
    """Return the projected ends (n, 2, 2) of segments with centres (n, 3) and half vectors (n, 3)."""
    return np.stack([centres - halves, centres + halves], axis=1)[..., :2]


def _cylinders(size: Floats, centres: Floats, turns: Floats) -> FootprintBatch:
    radius, half_length = float(size[0]), float(size[1])
    axis, height = turns[:, :, 2], centres[:, 2]
    half_height = half_length * np.abs(axis[:, 2]) + radius * np.sqrt(np.maximum(0.0, 1.0 - axis[:, 2] ** 2))
    angles = np.arange(RIM_CORNERS) * (2 * np.pi / RIM_CORNERS)
    x, y = radius * np.cos(angles), radius * np.sin(angles)
    rims = np.concatenate(
        [np.stack([x, y, np.full(RIM_CORNERS, z)], axis=1) for z in (half_length, -half_length)]
    )
    is_upright = np.abs(axis[:, 2]) > UPRIGHT_COSINE
    is_tilted = ~is_upright
    rim_points = centres[is_tilted][:, None] + rims @ turns[is_tilted].transpose(0, 2, 1)
    bottom, top = height - half_height, height + half_height
    batches = [
        _hulls(
            _ends(centres[is_upright], axis[is_upright] * half_length),
            radius,
            bottom[is_upright],
            top[is_upright],
        ),
        _hulls(rim_points[..., :2], 0.0, bottom[is_tilted], top[is_tilted]),
    ]
    input_order = np.argsort(np.concatenate([np.flatnonzero(is_upright), np.flatnonzero(is_tilted)]))
    return FootprintBatch.concatenate(batches).select(input_order)


def _ellipses(axes: Floats) -> Floats:
    """Return outlines (n, k, 2) of ellipses, the projections of the unit ball by matrices (n, 2, 3)."""
    # the Cholesky factor of A A^T maps the unit circle to the outline of the projection by A
    shape_matrices = axes @ axes.transpose(0, 2, 1)
    factor_xx = np.sqrt(shape_matrices[:, 0, 0])
    factor_yx = shape_matrices[:, 0, 1] / factor_xx
    factor_yy = np.sqrt(np.maximum(0.0, shape_matrices[:, 1, 1] - factor_yx**2))
    angles = np.arange(ELLIPSE_CORNERS) * (2 * np.pi / ELLIPSE_CORNERS)
    cosines, sines = np.cos(angles), np.sin(angles)
    return np.stack(
        [factor_xx[:, None] * cosines, factor_yx[:, None] * cosines + factor_yy[:, None] * sines], axis=-1
    )


def _hulls(points: Floats, radius: float, bottom: Floats, top: Floats) -> FootprintBatch:
    """Return n footprints, hulls of k points each (n, k, 2), rounded by a radius."""
    import shapely

    hull_count, point_count, _ = points.shape
    starts, vertices = np.arange(hull_count + 1) * point_count, np.ascontiguousarray(points).reshape(-1, 2)
    if point_count > 2 and hull_count:
        # lines instead of polygons, because the points may be on one line
        lines = shapely.linestrings(vertices, indices=np.repeat(np.arange(hull_count), point_count))
        vertices, hull_indices = shapely.get_coordinates(shapely.convex_hull(lines), return_index=True)
        starts = starts_from_counts(np.bincount(hull_indices, minlength=hull_count))
    outlines = normalise_polygons(starts, vertices)
    return FootprintBatch(
        part_start=np.arange(hull_count + 1, dtype=np.int64),
        vertex_start=outlines.vertex_start,
        vertices=outlines.vertices,
        radius=np.full(hull_count, float(radius)),
        bottom=bottom,
        top=top,
    )


# ---------------------------------------------------------------------------------------------------- models


def model_from_file(path: Path, assets: Path | None = None) -> SceneModel:
    """Return the model in a file, with meshes from a folder; by default, from the folder of the file.

    Raises:
        LogError: the model cannot be read or compiled.
    """
    return model_from_xml(_text_of(path), path.name, assets or path.absolute().parent)


def _text_of(path: Path) -> str:
    try:
        if path.stat().st_size > LARGEST_MODEL:
            raise LogError(f"{path.name} has over {LARGEST_MODEL >> 20} MiB; give the XML of a MuJoCo model")
        return path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise LogError(f"the model {path} cannot be read ({error}); give the XML of a MuJoCo model") from None


def model_from_xml(text: str, place: str, assets: Path | None = None) -> SceneModel:
    """Compile a model from its XML, reduced to the kinematics. The last four models are cached.

    Args:
        place: name of the model in messages.
        assets: folder of meshes and included files, which are found by the ends of their paths; no other
            folder is read.

    Raises:
        LogError: the XML is broken, too large, or no model of MuJoCo.
    """
    return _compile(_source_without_files(text, place) if assets is None else _source(text, place, assets))


def identity_of_model(model: Path | None, assets: Path | None) -> str:
    """Return a hash of the content of a mapping's model, with the files that the model uses.

    Without a model, the hash covers the names, sizes and modification times of all files in `assets`.

    Raises:
        LogError: the files cannot be read.
    """
    if model is not None:
        source = _source(_text_of(model), model.name, assets or model.absolute().parent)
        contents = [source.xml.encode(), *(content for _, content in source.files)]
    else:
        # the models in a data set may name any file of the folder as a mesh
        files = sorted(file for file in assets.rglob("*") if file.is_file()) if assets is not None else []
        states = [(str(file), state.st_size, state.st_mtime_ns) for file in files for state in [file.stat()]]
        contents = [repr(states).encode("utf-8", "surrogatepass")]
    digest = hashlib.sha256()
    for data in contents:
        digest.update(hashlib.sha256(data).digest())
    return digest.hexdigest()


class _ModelSource(NamedTuple):
    """The source of a model: XML, contents of files by name, and remarks on meshes that are left out."""

    place: str
    xml: str
    files: tuple[tuple[str, bytes], ...]
    remarks: tuple[str, ...]


def _source(text: str, place: str, assets: Path | None) -> _ModelSource:
    root = _element(text, place)
    folder = _Folder(assets)
    _include(root, folder, place, depth=0)
    _refuse_many(root, place)
    # MuJoCo searches meshes in meshdir, or else in assetdir
    directories = [compiler.get(key, "") for compiler in root.iter("compiler") for key in _FOLDERS[::2]]
    files = _strip(root, folder, next((name for name in directories if name), ""))
    xml = ElementTree.tostring(root, encoding="unicode")
    return _ModelSource(place, xml, tuple(files.items()), tuple(folder.remarks()))


@lru_cache(maxsize=4)
def _source_without_files(text: str, place: str) -> _ModelSource:
    return _source(text, place, None)


@lru_cache(maxsize=4)
def _compile(source: _ModelSource) -> SceneModel:
    with importing("models of MuJoCo need mujoco", extra="mujoco"):
        import mujoco
    try:
        model = mujoco.MjModel.from_xml_string(source.xml, dict(source.files))
    except (ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())[:300]
        raise LogError(f"MuJoCo {mujoco.__version__} does not compile {source.place}: {reason}") from None
    return SceneModel(model, source.place, source.remarks)


class _Folder:
    """Files of a folder, read by paths of another machine; the longest end of a path that exists is read."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = None if folder is None else folder.resolve()
        self._too_large_names: list[str] = []

    def read(self, name: str, directory: str = "") -> bytes | None:
        """Return the content of a file; None for a missing or too large file."""
        if self._folder is None:
            return None
        path = PurePosixPath(directory.replace("\\", "/")) / name.replace("\\", "/")
        path_parts = [part for part in path.parts if part not in ("/", ".", "..")]
        for begin in range(len(path_parts)):
            file = self._folder.joinpath(*path_parts[begin:]).resolve()
            if not file.is_relative_to(self._folder) or not file.is_file():
                continue
            if file.stat().st_size > LARGEST_ASSET:
                self._too_large_names.append(file.name)
                return None
            return file.read_bytes()
        return None

    def remarks(self) -> list[str]:
        return [
            f"the mesh {name} has over {LARGEST_ASSET >> 20} MiB, and is left out"
            for name in self._too_large_names
        ]


def _element(text: str, place: str) -> ElementTree.Element:
    if len(text) > LARGEST_MODEL:
        raise LogError(f"{place} has {len(text):,} characters; a model has at most {LARGEST_MODEL:,}")
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise LogError(f"{place} declares a document type, which no model of MuJoCo needs; remove it")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise LogError(f"the XML of {place} is broken ({error}); give a model of MuJoCo") from None
    level_elements, depth = [root], 0
    while level_elements:
        level_elements, depth = [child for element in level_elements for child in element], depth + 1
    if depth > DEEPEST:
        raise LogError(f"{place} has elements nested more than {DEEPEST} deep; give a model of MuJoCo")
    if root.tag != "mujoco":
        raise LogError(f"{place} is not a model of MuJoCo: its root is <{root.tag}>; give one with <mujoco>")
    return root


def _include(parent: ElementTree.Element, folder: _Folder, place: str, depth: int) -> None:
    """Replace each include by the content of its file; remove includes of missing files."""
    for index, child in reversed(list(enumerate(parent))):
        if child.tag != "include":
            _include(child, folder, place, depth)
            continue
        parent.remove(child)
        # the depth is limited, because a file may include itself
        content = folder.read(child.get("file", "")) if depth < 8 else None
        if content is not None:
            included = _element(content.decode("utf-8", "replace"), f"{place}, {child.get('file')}")
            _include(included, folder, place, depth + 1)
            for offset, element in enumerate(list(included)):
                parent.insert(index + offset, element)


def _refuse_many(root: ElementTree.Element, place: str) -> None:
    """Refuse a model that would generate more elements than memory holds."""

    def copies(element: ElementTree.Element) -> float:
        counts = (_number(text) for text in element.get("count", "1").split())
        return math.prod(counts) * max([1.0, *map(copies, element)])

    if copies(root) > MOST_COPIES:
        raise LogError(f"{place} copies elements more than {MOST_COPIES:,} times; give a smaller model")


def _number(text: str) -> float:
    try:
        return max(1.0, float(text))
    except ValueError:
        return 1.0


def _strip(root: ElementTree.Element, folder: _Folder, directory: str) -> dict[str, bytes]:
    """Remove elements without influence on kinematics; return the meshes in the folder, by new names."""
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag in _UNUSED or "hfield" in child.attrib:
                parent.remove(child)
    files: dict[str, bytes] = {}
    missing_meshes: set[str] = set()
    for asset in root.findall("asset"):
        for mesh in asset.findall("mesh"):
            if not _has_content(mesh, folder, directory, files):
                asset.remove(mesh)
                missing_meshes.add(mesh.get("name", PurePosixPath(mesh.get("file", "")).stem))
    for number, geom in enumerate(root.iter("geom")):
        if geom.get("mesh") in missing_meshes:
            _lose_mesh(geom, number)
    for element in root.iter():
        element.attrib.pop("material", None)
        if element.tag != "mesh":
            element.attrib.pop("file", None)
    _set_compiler(root)
    return files


def _has_content(mesh: ElementTree.Element, folder: _Folder, directory: str, files: dict[str, bytes]) -> bool:
    """Return whether a mesh has vertices in the XML or in the folder; add the mesh's file to `files`."""
    name = mesh.attrib.pop("file", None)
    if name is None:
        return "vertex" in mesh.attrib or "builtin" in mesh.attrib
    content = folder.read(name, directory)
    if content is None:
        mesh.set("file", name)
        return False
    mesh.set("name", mesh.get("name", PurePosixPath(name).stem))
    mesh.set("file", f"{len(files)}{PurePosixPath(name).suffix.lower()}")
    files[mesh.attrib["file"]] = content
    return True


def _lose_mesh(geom: ElementTree.Element, number: int) -> None:
    """Replace a geom whose mesh is missing by a small sphere with the name prefix `_LOST`."""
    for attribute in ("mesh", "fromto", "fitscale"):
        geom.attrib.pop(attribute, None)
    geom.attrib |= {"type": "sphere", "size": "0.001", "name": f"{_LOST}{number}"}


_COMPILER: Final[Mapping[str, str]] = {
    # bodies whose meshes are missing have no mass
    "boundmass": "1e-6",
    "boundinertia": "1e-9",
    "balanceinertia": "true",
    # all bodies and geoms stay in the model
    "fusestatic": "false",
    "discardvisual": "false",
}


def _set_compiler(root: ElementTree.Element) -> None:
    if root.find("compiler") is None:
        root.insert(0, ElementTree.Element("compiler"))
    for compiler in root.iter("compiler"):
        for key in _FOLDERS:
            compiler.attrib.pop(key, None)
        compiler.attrib |= _COMPILER
