"""Names of the built-in parts; filled by the plugin machinery."""
