"""The conformance kit: small checks with stable ids that hold a plugin to its interface.

It needs no pytest. Each interface has its list of checks (`hoigs.testing.rasterizer.CHECKS`), each
check says by tags, never by names, what it needs; `hoigs.testing.checks.run_checks` runs a list and
counts every outcome.
"""
