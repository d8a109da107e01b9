"""The room: `room.build_room` furnishes it; `textures`, `designs` and `meshes` make its parts."""
