"""Where the body fit begins.

- `torso`: orientation and place by closed forms. `limbs`: knees, hips, shoulders and elbows.
- `flat`: from landmarks in the image alone. `placing`: where a body is.
"""
