"""What estimators need and hoigs fetches: environments of tools that need their own, and networks.

- `managed`: `ManagedEnvironment`, the entry: its state, installing, removing.
- `interpreters`: a Python of a version that the tool supports.
- `npm_file`: one file out of a package of the npm registry.
- `hub`: networks of the Hugging Face hub, which lie in its own cache.
- `cache`: the folder for all of this.
"""
