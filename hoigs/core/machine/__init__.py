"""What the machine offers: `cpus` counts processors, `quiet_warp` starts Warp."""
