"""What packages that know nothing of hoigs read in its files: one line a file.

    python -m venv readers
    readers/bin/pip install 'plyfile<1.1' trimesh pygltflib bvh bpy
    readers/bin/python benchmarks/read_back.py mine.ply body.glb walk.bvh …

For `benchmarks/wants.py`. Nothing of hoigs is imported: it runs in an environment without it.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable
from pathlib import Path


def ply(path: Path) -> str:
    from plyfile import PlyData

    (vertices,) = PlyData.read(str(path)).elements
    numbers = [vertices[name] for name in ("x", "y", "z", "opacity", "scale_0", "rot_0")]
    finite = all(abs(values).max() < 1e6 for values in numbers)
    return (
        f"plyfile: {vertices.count} vertices of {len(vertices.properties)} properties, "
        f"{'all finite' if finite else 'NOT FINITE'}"
    )


def bvh(path: Path) -> str:
    from bvh import Bvh

    motion = Bvh(path.read_text())
    return (
        f"bvh: {len(motion.get_joints_names())} joints, {motion.nframes} frames at "
        f"{1 / motion.frame_time:.3g} a second"
    )


def glb(path: Path) -> str:
    import trimesh
    from pygltflib import GLTF2

    scene = trimesh.load(path)
    closed = []
    for name, mesh in scene.geometry.items():
        if isinstance(mesh, trimesh.Trimesh):
            mesh.merge_vertices(merge_tex=True, merge_norm=True)  # the seams of the texture
            if mesh.is_watertight:
                closed.append(f"{name} of {mesh.volume * 1000:.1f} litres")
    document = GLTF2().load(str(path))
    bones = [len(skin.joints) for skin in document.skins]
    tracks = sum(len(animation.channels) for animation in document.animations)
    return (
        f"trimesh: watertight {', '.join(closed) or 'nothing'}; pygltflib: skins of {bones} "
        f"joints, {tracks} animated channels"
    )


def fbx(path: Path) -> str:
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.fbx(filepath=str(path))
    things = bpy.context.scene.objects
    bones = [len(thing.data.bones) for thing in things if thing.type == "ARMATURE"]
    meshes = ", ".join(thing.name for thing in things if thing.type == "MESH")
    last = max((action.frame_range[1] for action in bpy.data.actions), default=0)
    version = bpy.app.version_string
    return f"Blender {version}: skeletons of {bones} bones, meshes {meshes}, {last:.0f} frames"


def table(path: Path) -> str:
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return f"csv: {len(rows)} rows of {', '.join(list(rows[0])[:8]) if rows else 'nothing'}"


READERS: dict[str, Callable[[Path], str]] = {
    ".ply": ply, ".bvh": bvh, ".glb": glb, ".fbx": fbx, ".csv": table,
}  # fmt: skip


def main() -> None:
    for name in sys.argv[1:]:
        path = Path(name)
        print(READERS[path.suffix](path))


if __name__ == "__main__":
    main()
