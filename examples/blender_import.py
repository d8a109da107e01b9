"""A run in Blender: people with skeletons, objects, the video's camera and, behind it, the video.

    hoigs export RUN --format gltf-body --out body.glb
    blender --python examples/blender_import.py -- body.glb --video film.mp4 --save run.blend

In the background (`blender --background --python …`), `--fbx body.fbx` writes people and objects
for programs that read FBX. With the `bpy` package it runs without Blender:
`python blender_import.py body.glb --fbx body.fbx`.
"""

import argparse
import json
import sys
from pathlib import Path

import bpy


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("glb", type=Path, help="as hoigs export --format gltf-body writes it")
    parser.add_argument("--video", type=Path, help="shown behind the scene")
    parser.add_argument("--height", type=int, default=1080, help="pixels of a rendered picture")
    parser.add_argument("--save", type=Path, help="a .blend")
    parser.add_argument("--fbx", type=Path, help="an .fbx of all but the camera")
    own = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    given = parser.parse_args(own)
    sheet = json.loads(Path(f"{given.glb}.json").read_text(encoding="utf-8"))

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps = max(1, round(sheet["fps"]))  # before: the times of glTF become frames by it
    scene.render.fps_base = scene.render.fps / sheet["fps"]
    bpy.ops.import_scene.gltf(filepath=str(given.glb.resolve()))
    scene.frame_start, scene.frame_end = 0, len(sheet["frames"]) - 1
    cameras = [thing for thing in scene.objects if thing.type == "CAMERA"]
    if cameras:
        scene.camera = cameras[0]
        _film(scene, cameras[0].data, given)
    if given.fbx is not None:
        for thing in scene.objects:
            thing.select_set(thing.type != "CAMERA")
        bpy.ops.export_scene.fbx(
            filepath=str(given.fbx.resolve()), use_selection=True, path_mode="COPY",
            embed_textures=True, add_leaf_bones=False,
        )  # fmt: skip
    if given.save is not None:
        bpy.ops.wm.save_as_mainfile(filepath=str(given.save.resolve()))
    for thing in scene.objects:
        print(f"{thing.name}: {thing.type.lower()}")


def _film(scene: "bpy.types.Scene", lens: "bpy.types.Camera", given: argparse.Namespace) -> None:
    """The picture's shape, and the video behind it."""
    scene.render.resolution_y = given.height
    document = _document(given.glb)
    aspect = document["cameras"][0]["perspective"]["aspectRatio"]
    scene.render.resolution_x = round(given.height * aspect)
    if given.video is None:
        return
    plate = lens.background_images.new()
    plate.source = "MOVIE_CLIP"
    plate.clip = bpy.data.movieclips.load(str(given.video.resolve()))
    plate.clip.frame_start = 0
    lens.show_background_images = True


def _document(path: Path) -> dict:
    """The JSON of a binary glTF."""
    data = path.read_bytes()
    return json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])


if __name__ == "__main__":
    main()
