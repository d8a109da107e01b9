"""Warp and its flags; the other modules take `wp` from here."""

from hoigs.core.machine.quiet_warp import wp

__all__ = ["CPU_FLAGS", "wp"]

# -ffp-contract=fast: multiply-adds in one instruction, which is not Warp's default on CPUs
CPU_FLAGS = f"{wp.config.cpu_compiler_flags or '-march=native'} -ffp-contract=fast"
