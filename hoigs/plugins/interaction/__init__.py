"""What couples the entities of a scene (HOIGS, Sec. "Cross-Attention Interaction Module").

- `cross_attention`: interaction:cross-attention, the HOI module.
- `none`: interaction:none, the ablation "w/o HOI".
"""
