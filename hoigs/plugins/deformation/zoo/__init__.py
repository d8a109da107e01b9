"""Deformations of other methods, which hoigs is compared with."""
