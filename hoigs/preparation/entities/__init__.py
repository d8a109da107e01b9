"""Everybody and every object of a clip.

- `choose_people`: who is followed. `fit_people`, `person`: their bodies. `nobody`: none.
- `entity_masks`, `final_masks`: masks without common pixels.
- `place_objects`: the track of every object.
"""
