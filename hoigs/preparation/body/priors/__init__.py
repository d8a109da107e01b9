"""What is known of bodies before they are seen.

- `pose`, `joint_limits`: how a body rests and how far its joints bend.
- `motion`, `acceleration_spread`: how it moves. `noise`: how far landmarks are off.
"""
