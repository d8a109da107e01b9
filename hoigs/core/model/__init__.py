"""From a spec and a clip to a model that renders.

- `compose`: compose and compose_density.
- `scene`: SceneModel, the forward pass. `entity`: Entity, one part of it.
- `object_placement`: scale and place of a generated shape (HOIGS, Sec. "Object Initialization").
- `smpl_params`: parameters of the SMPL family as BodyPose, and back.
- `camera_refinement`: learned corrections of a clip's cameras.
- `knot_refit`, `on_host`: other knots for a motion, and work on the CPU for a while.
- `exporter`: Exporter, the contract of export formats.
"""
