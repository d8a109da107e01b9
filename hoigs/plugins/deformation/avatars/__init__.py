"""Humans that a body model poses.

- `hexplane_skinning`: deformation:hexplane-skinning, the human of HOIGS.
- `triplane_avatar`: deformation:triplane-avatar, the humans of ExAvatar and HUGS.
- `lbs`: deformation:lbs, linear blend skinning and nothing else.
- `body`: their base classes.
"""
