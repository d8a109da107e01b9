"""Names of components, and the plugins that offer them.

- `registry.default_registry`: the registry of this process; `Registry.get` imports a component.
- `component.Component`: what a plugin declares. `hookspecs.hookimpl`: the marker of its hook.
- `manager.PluginManager`: finds and checks plugins; `import_watch` measures their imports, `extras`
  finds requirements that are not installed.
- `settings.describe_settings`: the settings of a component as a table.
"""
