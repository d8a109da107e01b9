"""Python environments that hoigs makes itself, for tools that cannot share its own.

- `managed`: `ManagedEnvironment`, the entry: its state, installing, removing.
- `interpreters`: a Python of a version that the tool supports.
- `npm_file`: one file out of a package of the npm registry.
- `cache`: the folder for all of this.
"""
