"""How bodies and objects move.

- `object_motions`: one class for each way an object moves.
- `object_script`: the script of poses that each of them makes.
- `walking`: steps of the feet. `ik`: forward and inverse kinematics of a joint tree.
"""
