"""estimator:object-tracker: an object's masks from clicks, or from its motion.

Entry point: `estimator`. In the order in which they work:

- `footage`: the frames. `scene`: how its picture moves, and what single pixels say.
- `proposal`: what moves and is not the person, where nothing was clicked, by `likeness`.
- `prompts`: the mask in a clicked frame; `outlined`: by a network, which runs in a process of its
  own (`outlines`).
- `path`: where the object is in each frame. `propagation`: its masks there. `tracker`: both, and
  again by what is `behind` it, or from `anchors`, frames in which it was found best.
- `verified`: the masks that are proven; `refined`: outlined by the network, too. `states`: where
  the object is in the other frames.
- `alike`: objects of which two tracks claim the same pixels. `together`: objects that look the same
  where they were clicked, all in one search for joint paths through the `places` of each frame.
"""
