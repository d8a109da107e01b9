"""Compression of trained models: quantised, zlib-compressed safetensors, never pickle.

- `compact.write_compact`: writes a checkpoint in few bytes. `compact.read_compact`: reads it.
- `packed.pack`: a set of tensors as compressed streams. `packed.unpack`: the reverse.
- `levels.quantise`: a tensor as integers of 8 or 16 bits. `levels.restore`: the reverse.
"""
